"""Evaluations as one HTML file that needs nothing else: numbers, charts, videos, failures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mtv_world_ros.errors import ConfigError
from mtv_world_ros.files import write_whole
from mtv_world_ros.lab.documents import DASH, number, render
from mtv_world_ros.lab.evaluation.metrics.statistics import METHOD
from mtv_world_ros.lab.evaluation.report import details
from mtv_world_ros.lab.evaluation.report.episode_cards import episode_cards
from mtv_world_ros.lab.evaluation.report.headline import cell, compared, headline, horizon, mark
from mtv_world_ros.lab.evaluation.report.read_back import (
    Evaluated,
    has_objects,
    read_evaluations,
)


def write_report(folders: Sequence[Path], path: Path) -> Path:
    """Writes the report of one or more evaluations beside its name and renames it.

    Args:
        folders: what `mtv-world evaluate --out` wrote; the first one sets the clock of the plots.
        path: of the HTML file.

    Returns:
        The path.

    Raises:
        ConfigError: none is given, or one holds no evaluation.
    """
    evaluations = [found for folder in folders for found in read_evaluations(folder)]
    if not evaluations:
        raise ConfigError('a report needs at least one evaluation; give the folders of them')
    write_whole(path, page(evaluations))
    return path


def page(evaluations: Sequence[Evaluated]) -> str:
    """Returns the whole page."""
    marks = [mark(index, evaluations) for index in range(len(evaluations))]
    marked = list(zip(marks, evaluations, strict=True))
    return render(
        'evaluation.html.j2',
        title=f'Evaluation of {", ".join(found.name for found in evaluations)}',
        method=METHOD,
        header=[{'mark': letter, **_header(found)} for letter, found in marked],
        headline=headline(evaluations),
        horizon=horizon(evaluations),
        compared=compared(evaluations),
        cards=episode_cards(evaluations),
        has_objects=any(map(has_objects, evaluations)),
        pictures=details.pictures(evaluations),
        paper=details.paper_tables(evaluations),
        tasks=details.task_tables(evaluations),
        success=details.success(evaluations),
        statuses=details.statuses(evaluations),
        failures=[(m, f.metrics['failed'], f.metrics.get('notes', {})) for m, f in marked],
        episodes=details.episodes(evaluations),
        made=[(letter, found.name, details.provenance(found)) for letter, found in marked],
        folders=[str(found.folder) for found in evaluations],
    )


def _header(found: Evaluated) -> dict[str, Any]:
    made = found.metrics['provenance']
    about = [part for key in ('dataset', 'date') if (part := made.get(key, ''))]
    return {'name': found.name, 'about': ' · '.join(about), 'tiles': _tiles(found)}


def _tiles(found: Evaluated) -> list[tuple[str, str, str]]:
    """Name, number and what is below it."""
    metrics, shown = found.metrics, {
        'j_moving': 'J, objects that move',
        'margin_moving': 'margin over first frame held',
        'margin_over_shuffled': 'margin over shuffled actions',
    }  # fmt: skip
    tiles = []
    for key, name in shown.items() if has_objects(found) else ():
        text, bracket, rest = cell(metrics['overall'], key).partition(' [')
        below = 'not measured' if text == DASH else f'[{rest}' if bracket else ''
        tiles.append((name, text, below))
    for suffix, name in {'': 'PSNR, imagined', '_held': 'PSNR, first frame held'}.items():
        psnr = metrics.get('pictures', {}).get('overall', {}).get(f'psnr{suffix}')
        if psnr and not has_objects(found):
            tiles.append((name, number(psnr['value'], 1), 'dB'))
    failed = f'{len(metrics["failed"])} failed'
    tiles.append(('episodes scored', str(len(found.results)), failed))
    factor = metrics.get('real_time_factor')
    if factor is not None:
        seconds = number(metrics.get('seconds_per_chunk'), 2)
        tiles.append(('real-time factor', number(factor, 1), f'{seconds} s a chunk'))
    return tiles
