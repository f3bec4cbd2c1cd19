"""Evaluations as one HTML file that needs nothing else: numbers, charts, videos, failures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mtv_world_ros.errors import ConfigError
from mtv_world_ros.files import write_whole
from mtv_world_ros.lab.documents import DASH, number, render, Table
from mtv_world_ros.lab.evaluation.metrics.statistics import METHOD
from mtv_world_ros.lab.evaluation.report import details, tables
from mtv_world_ros.lab.evaluation.report.episode_cards import episode_cards
from mtv_world_ros.lab.evaluation.report.evaluation_summary import EvaluationSummary
from mtv_world_ros.lab.evaluation.report.headline import (
    compared,
    headline,
    horizon,
    Marked,
    marked,
)
from mtv_world_ros.lab.evaluation.report.read_back import read_evaluations


def write_report(folders: Sequence[Path], path: Path) -> Path:
    """Writes the report of one or more evaluations; the first one sets the clock of the plots.

    Raises:
        ConfigError: none is given, or one holds no evaluation.
    """
    evaluations = [found for folder in folders for found in read_evaluations(folder)]
    if not evaluations:
        raise ConfigError('a report needs at least one evaluation; give the folders of them')
    write_whole(path, page(evaluations))
    return path


def page(evaluations: Sequence[EvaluationSummary]) -> str:
    """Returns the whole page."""
    ones = marked(evaluations)
    return render(
        'evaluation.html.j2',
        title=f'Evaluation of {", ".join(found.title for found in evaluations)}',
        method=METHOD,
        header=[{'mark': one, **_header(one.found)} for one in ones],
        headline=headline(ones),
        horizon=horizon(ones),
        compared=compared(ones),
        cards=episode_cards(ones),
        has_objects=any(found.has_objects for found in evaluations),
        pictures=_each(ones, tables.pictures_table),
        paper=details.paper_tables(ones),
        quality=_each(ones, tables.quality_table),
        tasks=[(one, table) for one in ones for table in _tables_of_numbers(one.found)],
        success=details.success(ones),
        statuses=_each(ones, _statuses),
        failures=[(one, one.found.failed, one.found.metrics['notes']) for one in ones],
        episodes=_each(ones, details.episodes),
        made=[(one, one.found.title, details.provenance(one.found)) for one in ones],
        folders=[str(found.folder) for found in evaluations],
    )


def _each(
    ones: Sequence[Marked], table: Callable[[EvaluationSummary], Table | None]
) -> list[tuple[Marked, Table]]:
    """A table of each evaluation that has one."""
    return [(one, found) for one in ones if (found := table(one.found)) is not None]


def _tables_of_numbers(found: EvaluationSummary) -> list[Table]:
    return [tables.view_table(found), *tables.group_tables(found)]


def _statuses(found: EvaluationSummary) -> Table:
    """Counts by status, and how many rows have no score."""
    table = tables.status_table(found)
    views = found.metrics['views'].values()
    last = ['not scored, in all', *(numbers['num_not_scored'] for numbers in views)]
    return replace(table, rows=[*table.rows, last])


def _header(found: EvaluationSummary) -> dict[str, Any]:
    about = [part for key in ('dataset', 'date') if (part := found.provenance.get(key, ''))]
    return {'name': found.title, 'about': ' · '.join(about), 'tiles': _tiles(found)}


def _tiles(found: EvaluationSummary) -> list[tuple[str, str, str]]:
    """Name, number and what is below it."""
    metrics, shown = found.metrics, {
        'j_moving': 'J, objects that move',
        'margin_moving': 'margin over first frame held',
        'margin_over_shuffled': 'margin over shuffled actions',
    }  # fmt: skip
    tiles, overall = [], found.estimates(None)
    for key, name in shown.items() if found.has_objects else ():
        text, bracket, rest = tables.cell(overall[key]).partition(' [')
        below = 'not measured' if text == DASH else f'[{rest}' if bracket else ''
        tiles.append((name, text, below))
    for suffix, name in {'': 'PSNR, imagined', '_held': 'PSNR, first frame held'}.items():
        psnr = found.pictures[None].get(f'psnr{suffix}')
        if psnr and not found.has_objects:
            tiles.append((name, number(psnr.value, 1), 'dB'))
    tiles.append(('episodes scored', str(len(found.results)), f'{len(found.failed)} failed'))
    factor = metrics['real_time_factor']
    if factor is not None:
        seconds = number(metrics['seconds_per_chunk'], 2)
        tiles.append(('real-time factor', number(factor, 1), f'{seconds} s a chunk'))
    return tiles
