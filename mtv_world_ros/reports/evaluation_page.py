"""Evaluations as one HTML file that needs nothing else: numbers, charts, videos, failures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import Any

from markupsafe import Markup

from mtv_world_ros.core.documents import DASH, number, render, Table
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.estimate_words import estimate_words
from mtv_world_ros.core.files import write_whole
from mtv_world_ros.evaluation import tables
from mtv_world_ros.evaluation.evaluation_summary import EvaluationSummary, TRAINING
from mtv_world_ros.evaluation.metrics.statistics import METHOD
from mtv_world_ros.evaluation.metrics.success_agreement import reliability_bins
from mtv_world_ros.reports.charts import reliability_chart
from mtv_world_ros.reports.comparison import lines, method_table, task_tables
from mtv_world_ros.reports.episode_cards import episode_cards
from mtv_world_ros.reports.headline import compared, headline, horizon, Marked, marked, views_of
from mtv_world_ros.reports.read_back import read_evaluations, scores

#: parts of metrics.json that have sections of their own
_SHOWN = {'name', 'label', 'provenance', 'failed', 'notes', 'episodes', 'success'}
_SHOWN |= {'views', 'overall', 'tasks', 'zero_shot'}


def write_report(folders: Sequence[Path], path: Path) -> Path:
    """Write the report of one or more evaluations; the first one sets the clock of the plots.

    Raises:
        ConfigError: none is given, or one holds no evaluation.
    """
    evaluations = [found for folder in folders for found in read_evaluations(folder)]
    if not evaluations:
        raise ConfigError('a report needs at least one evaluation; give the folders of them')
    write_whole(path, page(evaluations))
    return path


def page(evaluations: Sequence[EvaluationSummary]) -> str:
    """Return the whole page."""
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
        margins=[(one, line) for one in ones if (line := tables.compared_line(one.found))],
        paper=_paper_tables(ones),
        quality=_each(ones, tables.quality_table),
        tasks=[(one, table) for one in ones for table in _tables_of_numbers(one.found)],
        success=_success(ones),
        statuses=_each(ones, _statuses),
        failures=[(one, one.found.failed, one.found.metrics['notes']) for one in ones],
        episodes=_each(ones, _episodes),
        made=[(one, one.found.title, _provenance(one.found)) for one in ones],
        folders=[str(found.folder) for found in evaluations],
    )


def _each(
    ones: Sequence[Marked], table: Callable[[EvaluationSummary], Table | None]
) -> list[tuple[Marked, Table]]:
    """Return a table of each evaluation that has one."""
    return [(one, found) for one in ones if (found := table(one.found)) is not None]


def _tables_of_numbers(found: EvaluationSummary) -> list[Table]:
    return [tables.view_table(found), tables.dreams_table(found), *tables.group_tables(found)]


def _statuses(found: EvaluationSummary) -> Table:
    """Return the counts by status, and how many rows have no score."""
    table = tables.status_table(found)
    views = found.metrics['views'].values()
    last = ['not scored, in all', *(numbers['num_not_scored'] for numbers in views)]
    return replace(table, rows=[*table.rows, last])


def _header(found: EvaluationSummary) -> dict[str, Any]:
    keys = ('dataset', TRAINING, 'date')
    about = [part for key in keys if (part := found.provenance.get(key, ''))]
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


def _paper_tables(ones: Sequence[Marked]) -> list[Table]:
    """Return the method by view and method by task and view: the paper's tables 1 and 3."""
    views = views_of(ones)
    rows = lines([one.found for one in ones], [one.title for one in ones])
    return [method_table(rows, views), *task_tables(rows, views)]


def _success(evaluations: Sequence[Marked]) -> dict[str, Any] | None:
    """Return the agreement of success estimates with outcomes; None if no outcome is known."""
    found = [(one, one.found.metrics['success']) for one in evaluations]
    known = [(one, numbers) for one, numbers in found if numbers['num_outcomes_known']]
    if not known:
        return None
    rows = [[_words(key), *(_plain(numbers[key]) for _, numbers in known)] for key in known[0][1]]
    charts = [(one, chart) for one, _ in known if (chart := _reliability(one)) is not None]
    head = ['', *(one.letter or 'Value' for one, _ in known)]
    return {'table': Table(head=head, rows=rows), 'charts': charts}


def _plain(value: float | None) -> str:
    return number(value) if isinstance(value, float | None) else str(value)


def _words(key: str) -> str:
    return key.removeprefix('num_').replace('_', ' ').capitalize()


def _reliability(one: Marked) -> Markup | None:
    bins = reliability_bins(one.found.judgements)
    if not bins:
        return None
    return reliability_chart('Share of real successes against the estimate', bins, one.colour)


def _episodes(found: EvaluationSummary) -> Table:
    """Return a line per episode, the worst first."""
    keys = ('j_moving', 'j_copy_moving', 'j_shuffled_moving', 'j_object_mean')
    head = ['Episode', 'Task', 'Outcome', 'J moving', 'held', 'shuffled', 'J objects', 'Success']
    by_key = {key: scores(found, key) for key in keys}
    worst_first = sorted(
        found.results, key=lambda r: (by_key['j_moving'].get(r.episode, 2.0), r.episode)
    )
    rows = []
    for result in worst_first:
        numbers = [number(by_key[key].get(result.episode)) for key in keys]
        estimate = estimate_words(result.probability, result.reasons)
        rows.append([result.episode, result.task, result.outcome, *numbers, estimate])
    return Table(head=head, rows=rows, num_labels=3)


def _provenance(found: EvaluationSummary) -> dict[str, str]:
    """Return the provenance of the numbers, by heading."""
    lines = {'checkpoint': found.name, **found.provenance, 'results': str(found.folder)}
    lines |= {key: _flat(v) for key, v in found.metrics.items() if key not in _SHOWN}
    return {key.replace('_', ' '): value for key, value in lines.items()}


def _flat(value: Any) -> str:
    if isinstance(value, dict):
        return ', '.join(f'{key} {_flat(item)}' for key, item in value.items())
    if isinstance(value, list | tuple):
        return ', '.join(map(_flat, value))
    if isinstance(value, float):
        return f'{value:.6g}' if isfinite(value) else DASH
    return DASH if value is None else str(value)
