"""Evaluation results as files: metrics.json, a CSV of rows, Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import csv
import io
import json
import math
from pathlib import Path
from typing import Any

from mtv_world_ros.evaluation.scores import FRAME_FIELDS, ScoreRow
from mtv_world_ros.evaluation.statistics import Estimate

#: columns of the Markdown tables: key -> heading
COLUMNS = {
    'j_object_mean': 'J objects',
    'j_union': 'J union',
    'j_moving': 'J moving',
    'j_copy_moving': 'persistence',
    'j_shuffled_moving': 'shuffled actions',
    'margin_moving': 'margin over persistence',
    'skill': 'skill',
    'j_ceiling': 'ceiling',
}


def write_text(path: Path, text: str) -> None:
    """Writes a file beside its name and renames it, so that no half file is left."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f'.{path.name}.part')
    beside.write_text(text, encoding='utf-8')
    beside.replace(path)


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Writes a JSON file; NaN becomes null."""
    write_text(path, json.dumps(plain(values), indent=1, allow_nan=False) + '\n')


def plain(value: Any) -> Any:
    """Returns what JSON can hold: NaN as None, tuples as lists, floats to 6 digits."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value


def estimates_json(estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    """Returns the values by name, and `intervals` and `num_episodes_with` beside them.

    `fid` and `fvd` are null: they need feature weights.
    """
    return {
        **{name: estimate.value for name, estimate in estimates.items()},
        'fid': None,
        'fvd': None,
        'intervals': {name: estimate.interval for name, estimate in estimates.items()},
        'num_episodes_with': {name: e.num_episodes for name, e in estimates.items()},
    }


def rows_csv(rows: Iterable[tuple[str, str, ScoreRow]]) -> str:
    """Returns a CSV of (episode, task, row): one line per stretch, view and object."""
    stream = io.StringIO()
    writer: csv.DictWriter[str] | None = None
    for episode, task, row in rows:
        values = {'episode': episode, 'task': task, **row.as_json()}
        for field in FRAME_FIELDS:
            values.pop(field)
        values['name'] = row.name or '(union)'
        if writer is None:
            writer = csv.DictWriter(stream, list(values), lineterminator='\n')
            writer.writeheader()
        writer.writerow(values)
    return stream.getvalue()


def markdown_table(lines: Sequence[tuple[str, Mapping[str, Estimate]]], first: str) -> str:
    """Returns a table of (label, estimates) with 95 % intervals in brackets."""
    head = [first, *COLUMNS.values()]
    body = [[label, *(_cell(found.get(key)) for key in COLUMNS)] for label, found in lines]
    widths = [max(len(row[i]) for row in [head, *body]) for i in range(len(head))]
    rule = ['-' * width for width in widths]
    return '\n'.join(
        '| ' + ' | '.join(cell.ljust(n) for cell, n in zip(row, widths, strict=True)) + ' |'
        for row in [head, rule, *body]
    )


def _cell(estimate: Estimate | None) -> str:
    if estimate is None or not math.isfinite(estimate.value):
        return '–'
    low, high = estimate.interval
    return f'{estimate.value:.3f} [{low:.3f}, {high:.3f}]'
