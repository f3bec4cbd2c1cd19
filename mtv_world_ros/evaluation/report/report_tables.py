"""The report's tables: those of the paper, the pictures' quality, every number by task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from mtv_world_ros.evaluation.metrics.statistics import METHOD
from mtv_world_ros.evaluation.report.headline import all_views, letter, number, stacked
from mtv_world_ros.evaluation.report.markup import element, join, Markup, table
from mtv_world_ros.evaluation.report.read_back import Evaluated
from mtv_world_ros.evaluation.report.tables import COLUMNS

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


def paper_tables(evaluations: Sequence[Evaluated]) -> Markup:
    """Returns method by view and task by view in the form of the paper's tables 1 and 3."""
    views = all_views(evaluations)
    columns = ('FID ↓', 'FVD ↓', 'J ↑', 'J moving ↑')
    head = ['Method', *(f'{view} {what}' for view in views for what in columns)]
    rows = []
    for row in _rows(evaluations):
        cells = [row.views.get(view, {}).get(key) for view in views for key in row.keys]
        rows.append([row.label, *map(number, cells)])
    return element(
        'section',
        element('h2', "In the form of the paper's tables"),
        element(
            'p',
            'J of the union of all objects, mean over frames and episodes (the paper prints it '
            'times 100). FID and FVD need feature weights; a dash is not measured.',
            class_='faint',
        ),
        table(head, rows, caption='Method × view'),
        _quality(evaluations),
        _task_by_view(evaluations, views),
        id='paper',
    )


def _rows(evaluations: Sequence[Evaluated]) -> list[_Row]:
    """A row per evaluation and zero-shot set; then the held first frame of each set."""
    rows, held = [], {}
    for index, found in enumerate(evaluations):
        for name, group in (found.metrics.get('zero_shot') or {_SEEN: found.metrics}).items():
            suffix = '' if name == _SEEN else f', zero-shot {name}'
            rows.append(_Row(f'{_name(index, evaluations)}{suffix}', group['views'], _MODEL))
            held.setdefault(name, _Row(f'First frame held{suffix}', group['views'], _HELD))
    return [*rows, *held.values()]


def _quality(evaluations: Sequence[Evaluated]) -> Markup | None:
    """How good the pictures are; None where it was not measured."""
    rows = []
    for index, found in enumerate(evaluations):
        for view, numbers in found.metrics['views'].items():
            cells = [stacked(numbers, key) for key in QUALITY]
            if any(numbers.get(key) is not None for key in QUALITY):
                rows.append([_name(index, evaluations), view, *cells])
    head = ['Method', 'View', *QUALITY.values()]
    return table(head, rows, num_labels=2, caption='Pictures') if rows else None


def _name(index: int, evaluations: Sequence[Evaluated]) -> str:
    prefix = '' if len(evaluations) == 1 else f'{letter(index)} · '
    return f'{prefix}{evaluations[index].name}'


def _task_by_view(evaluations: Sequence[Evaluated], views: Sequence[str]) -> Markup:
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
    return table(head, rows, caption='J, task × view')


def task_section(evaluations: Sequence[Evaluated]) -> Markup:
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
                cells = [stacked(numbers, key) for key in COLUMNS]
                rows.append([task or 'no task', view, str(group['num_episodes']), *cells])
        tables.append(table(head, rows, num_labels=2, caption=_name(index, evaluations)))
    return element(
        'section',
        element('h2', 'By task'),
        element(
            'p',
            f'Brackets: {METHOD}. J moving, persistence and shuffled actions: '
            'of the objects that really move. Skill: (J − J held) / (1 − J held).',
            class_='faint',
        ),
        join(tables),
        id='tasks',
    )
