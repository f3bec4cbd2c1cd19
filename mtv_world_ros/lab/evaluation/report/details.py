"""The page's tables: success, episodes, provenance; those of numbers are of `tables`."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import Any

from markupsafe import Markup

from mtv_world_ros.lab.documents import DASH, number, Table
from mtv_world_ros.lab.evaluation.metrics.success_agreement import reliability_bins
from mtv_world_ros.lab.evaluation.report.charts import reliability_chart
from mtv_world_ros.lab.evaluation.report.comparison import lines, method_table, task_tables
from mtv_world_ros.lab.evaluation.report.evaluation_summary import EvaluationSummary
from mtv_world_ros.lab.evaluation.report.headline import Marked, views_of
from mtv_world_ros.lab.evaluation.report.read_back import scores

#: parts of metrics.json that have sections of their own
_SHOWN = {'name', 'label', 'provenance', 'failed', 'notes', 'episodes', 'success'}
_SHOWN |= {'views', 'overall', 'tasks', 'zero_shot'}


def paper_tables(evaluations: Sequence[Marked]) -> list[Table]:
    """Returns method by view and method by task and view: the paper's tables 1 and 3."""
    views = views_of(evaluations)
    rows = lines([one.found for one in evaluations], [one.title for one in evaluations])
    return [method_table(rows, views), *task_tables(rows, views)]


def success(evaluations: Sequence[Marked]) -> dict[str, Any] | None:
    """Returns how well the success estimates agree with the outcomes; None if none is known."""
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


def episodes(found: EvaluationSummary) -> Table:
    """Returns a line per episode, the worst first."""
    keys = ('j_moving', 'j_copy_moving', 'j_shuffled_moving', 'j_object_mean')
    head = ['Episode', 'Task', 'Outcome', 'J moving', 'held', 'shuffled', 'J objects', 'Success']
    by_key = {key: scores(found, key) for key in keys}
    worst_first = sorted(
        found.results, key=lambda r: (by_key['j_moving'].get(r.episode, 2.0), r.episode)
    )
    rows = []
    for result in worst_first:
        numbers = [number(by_key[key].get(result.episode)) for key in keys]
        estimate = number(result.probability) if isfinite(result.probability) else 'abstains'
        rows.append([result.episode, result.task, result.outcome, *numbers, estimate])
    return Table(head=head, rows=rows, num_labels=3)


def provenance(found: EvaluationSummary) -> dict[str, str]:
    """Returns how the numbers came about, by heading."""
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
