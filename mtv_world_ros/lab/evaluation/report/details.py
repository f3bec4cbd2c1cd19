"""The page's tables: the paper's, by task, success, statuses, episodes, provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite, nan
from typing import Any, NamedTuple

from markupsafe import Markup

from mtv_world_ros.lab.documents import number, Table, with_interval
from mtv_world_ros.lab.evaluation.metrics.picture_scores import KINDS, MEASURES
from mtv_world_ros.lab.evaluation.metrics.success_agreement import Judgement, reliability_bins
from mtv_world_ros.lab.evaluation.report.charts import reliability_chart
from mtv_world_ros.lab.evaluation.report.headline import all_views, cell, hue, letter, Mark, mark
from mtv_world_ros.lab.evaluation.report.read_back import Evaluated, scores
from mtv_world_ros.lab.evaluation.report.tables import COLUMNS

#: parts of metrics.json that have sections of their own
_SHOWN = {'name', 'label', 'provenance', 'failed', 'notes', 'episodes', 'success'}
_SHOWN |= {'views', 'overall', 'tasks', 'zero_shot'}
#: key -> heading
QUALITY = {
    'fid': 'FID ↓',
    'fvd': 'FVD ↓',
    'psnr': 'PSNR [dB] ↑',
    'ssim': 'SSIM ↑',
    'lpips': 'LPIPS ↓',
}


class _Row(NamedTuple):
    """A row of the paper's tables: numbers by view, and which of them."""

    label: str
    views: Mapping[str, Mapping[str, Any]]
    keys: Sequence[str]


#: FID, FVD, J of all objects and of those that move; of a model, and of the first frame held
_MODEL = ('fid', 'fvd', 'j_union', 'j_moving')
_HELD = ('', '', 'j_copy_union', 'j_copy_moving')
#: the zero-shot set that is none
_SEEN = 'seen'


def paper_tables(evaluations: Sequence[Evaluated]) -> list[Table]:
    """Returns method by view and task by view in the form of the paper's tables 1 and 3."""
    views = all_views(evaluations)
    columns = ('FID ↓', 'FVD ↓', 'J ↑', 'J moving ↑')
    head = ['Method', *(f'{view} {what}' for view in views for what in columns)]
    rows = []
    for row in _rows(evaluations):
        cells = [row.views.get(view, {}).get(key) for view in views for key in row.keys]
        rows.append([row.label, *map(number, cells)])
    methods = Table(head=head, rows=rows, caption='Method × view')
    found = [methods, _quality(evaluations), _task_by_view(evaluations, views)]
    return [table for table in found if table is not None]


def _rows(evaluations: Sequence[Evaluated]) -> list[_Row]:
    """A row per evaluation and zero-shot set; then the held first frame of each set."""
    rows, held = [], {}
    for index, found in enumerate(evaluations):
        for name, group in (found.metrics.get('zero_shot') or {_SEEN: found.metrics}).items():
            suffix = '' if name == _SEEN else f', zero-shot {name}'
            rows.append(_Row(f'{_name(index, evaluations)}{suffix}', group['views'], _MODEL))
            held.setdefault(name, _Row(f'First frame held{suffix}', group['views'], _HELD))
    return [*rows, *held.values()]


def _quality(evaluations: Sequence[Evaluated]) -> Table | None:
    """How good the pictures are; None where it was not measured."""
    rows = []
    for index, found in enumerate(evaluations):
        for view, numbers in found.metrics['views'].items():
            cells = [cell(numbers, key) for key in QUALITY]
            if any(numbers.get(key) is not None for key in QUALITY):
                rows.append([_name(index, evaluations), view, *cells])
    head = ['Method', 'View', *QUALITY.values()]
    return Table(head=head, rows=rows, num_labels=2, caption='Pictures') if rows else None


def _name(index: int, evaluations: Sequence[Evaluated]) -> str:
    prefix = '' if len(evaluations) == 1 else f'{letter(index)} · '
    return f'{prefix}{evaluations[index].name}'


def _task_by_view(evaluations: Sequence[Evaluated], views: Sequence[str]) -> Table:
    tasks = list(dict.fromkeys(task for found in evaluations for task in found.metrics['tasks']))
    alone = len(evaluations) == 1
    head = ['Task'] + [
        f'{"" if alone else letter(index) + " "}{view}'
        for index in range(len(evaluations))
        for view in views
    ]
    rows = []
    for task in tasks:
        cells = [task or 'no task']
        for found in evaluations:
            by_view = found.metrics['tasks'].get(task, {}).get('views', {})
            cells += [number(by_view.get(view, {}).get('j_union')) for view in views]
        rows.append(cells)
    return Table(head=head, rows=rows, caption='J, task × view')


def task_tables(evaluations: Sequence[Evaluated]) -> list[Table]:
    """Returns every number by task and view, with intervals."""
    head = ['Task', 'View', 'Episodes', *COLUMNS.values()]
    tables = []
    for index, found in enumerate(evaluations):
        rows = []
        sets = found.metrics.get('zero_shot', {})
        groups = {**found.metrics['tasks'], **{f'set: {name}': g for name, g in sets.items()}}
        groups['all tasks'] = found.metrics
        for task, group in groups.items():
            for view, numbers in {**group['views'], 'all views': group['overall']}.items():
                cells = [cell(numbers, key) for key in COLUMNS]
                rows.append([task or 'no task', view, group['num_episodes'], *cells])
        caption = _name(index, evaluations)
        tables.append(Table(head=head, rows=rows, num_labels=2, caption=caption))
    return tables


def pictures(evaluations: Sequence[Evaluated]) -> list[tuple[Mark | None, Table]]:
    """Returns picture scores beside the held frame and other commands, where they were made."""
    tables = []
    for index, found in enumerate(evaluations):
        rows = [
            [view, words, *(_estimate(numbers.get(f'{key}{suffix}')) for key in MEASURES)]
            for view, numbers in found.metrics.get('pictures', {}).items()
            for suffix, words in KINDS.items()
            if any(f'{key}{suffix}' in numbers for key in MEASURES)
        ]
        if rows:
            table = Table(head=['View', 'Shown', *MEASURES.values()], rows=rows, num_labels=2)
            tables.append((mark(index, evaluations), table))
    return tables


def _estimate(found: Mapping[str, Any] | None) -> str:
    low, high = (found or {}).get('interval') or (None, None)
    ends = (nan, nan) if low is None or high is None else (low, high)
    return with_interval((found or {}).get('value'), ends)


def success(evaluations: Sequence[Evaluated]) -> dict[str, Any] | None:
    """Returns how well the success estimates agree with the outcomes; None if none is known."""
    known = [found for found in evaluations if found.metrics['success'].get('num_outcomes_known')]
    if not known:
        return None
    keys = list(dict.fromkeys(key for found in known for key in found.metrics['success']))
    keys = [key for key in keys if all(_is_plain(f.metrics['success'].get(key)) for f in known)]
    columns = [_column(i, evaluations) for i, f in enumerate(evaluations) if f in known]
    rows = [
        [_words(key), *(_plain(found.metrics['success'].get(key)) for found in known)]
        for key in keys
    ]
    charts = [
        (mark(index, evaluations), chart)
        for index, found in enumerate(evaluations)
        if (chart := _reliability(found, hue(index))) is not None
    ]
    return {'table': Table(head=['', *columns], rows=rows), 'charts': charts}


def _column(index: int, evaluations: Sequence[Evaluated]) -> str:
    return 'Value' if len(evaluations) == 1 else letter(index)


def _is_plain(value: Any) -> bool:
    return value is None or isinstance(value, int | float | str)


def _plain(value: Any) -> str:
    return number(value) if isinstance(value, float | None) else str(value)


def _words(key: str) -> str:
    return key.removeprefix('num_').replace('_', ' ').capitalize()


def _reliability(found: Evaluated, style: str) -> Markup | None:
    bins = reliability_bins(
        [
            Judgement(probability=result.probability, outcome=result.outcome)
            for result in found.results.values()
        ]
    )
    if not bins:
        return None
    return reliability_chart('Share of real successes against the estimate', bins, style)


def statuses(evaluations: Sequence[Evaluated]) -> list[tuple[Mark | None, Table]]:
    """Returns how often which status came up, by view."""
    tables = []
    for index, found in enumerate(evaluations):
        views = found.metrics['views']
        words = list(dict.fromkeys(word for n in views.values() for word in n.get('status', {})))
        rows = [[w, *(n.get('status', {}).get(w, 0) for n in views.values())] for w in words]
        rows.append(['not scored, in all', *(n['num_not_scored'] for n in views.values())])
        tables.append((mark(index, evaluations), Table(head=['Status', *views], rows=rows)))
    return tables


def episodes(evaluations: Sequence[Evaluated]) -> list[tuple[Mark | None, Table]]:
    """Returns a line per episode, the worst first."""
    keys = ('j_moving', 'j_copy_moving', 'j_shuffled_moving', 'j_object_mean')
    head = ['Episode', 'Task', 'Outcome', 'J moving', 'held', 'shuffled', 'J objects', 'Success']
    tables = []
    for index, found in enumerate(evaluations):
        by_key = {key: scores(found, key) for key in keys}
        rows = []
        for name in sorted(found.results, key=lambda n: (by_key['j_moving'].get(n, 2.0), n)):
            result = found.results[name]
            numbers = [number(by_key[key].get(name)) for key in keys]
            estimate = number(result.probability) if isfinite(result.probability) else 'abstains'
            rows.append([name, result.task, result.outcome, *numbers, estimate])
        tables.append((mark(index, evaluations), Table(head=head, rows=rows, num_labels=3)))
    return tables


def provenance(found: Evaluated) -> dict[str, str]:
    """Returns how the numbers came about, by heading."""
    lines = {'checkpoint': found.metrics['name'], **found.metrics['provenance']}
    lines |= {'results': str(found.folder)}
    lines |= {key: _flat(v) for key, v in found.metrics.items() if key not in _SHOWN}
    return {key.replace('_', ' '): value for key, value in lines.items()}


def _flat(value: Any) -> str:
    if isinstance(value, dict):
        return ', '.join(f'{key} {_flat(item)}' for key, item in value.items())
    if isinstance(value, list):
        return ', '.join(map(_flat, value))
    if isinstance(value, float):
        return f'{value:.6g}'
    return '–' if value is None else str(value)
