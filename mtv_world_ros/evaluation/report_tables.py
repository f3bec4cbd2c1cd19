"""The report's tables: those of the paper, the pictures' quality, every number by task."""

from __future__ import annotations

from collections.abc import Sequence

from mtv_world_ros.evaluation.evaluated import Evaluated
from mtv_world_ros.evaluation.markup import element, join, Markup, table
from mtv_world_ros.evaluation.report_numbers import all_views, letter, number, stacked
from mtv_world_ros.evaluation.tables import COLUMNS

#: key -> heading
QUALITY = {
    'fid': 'FID ↓',
    'fvd': 'FVD ↓',
    'psnr': 'PSNR [dB] ↑',
    'ssim': 'SSIM ↑',
    'lpips': 'LPIPS ↓',
}


def paper_tables(evaluations: Sequence[Evaluated]) -> Markup:
    """Returns method by view and task by view in the form of the paper's tables 1 and 3."""
    views = all_views(evaluations)
    head = ['Method', *(f'{view} {what}' for view in views for what in ('FID ↓', 'FVD ↓', 'J ↑'))]
    rows = [
        [_name(index, evaluations), *_method_cells(found, views, 'j_union')]
        for index, found in enumerate(evaluations)
    ]
    held = [f'{_name(0, evaluations)}: first frame held']
    for view in views:
        copy = evaluations[0].metrics['views'].get(view, {}).get('j_copy_union')
        held += ['–', '–', number(copy)]
    return element(
        'section',
        element('h2', "In the form of the paper's tables"),
        element(
            'p',
            'J of the union of all objects, mean over frames and episodes (the paper prints it '
            'times 100). FID and FVD need feature weights; a dash is not measured.',
            class_='faint',
        ),
        table(head, [*rows, held], caption='Method × view'),
        _quality(evaluations),
        _task_by_view(evaluations, views),
        id='paper',
    )


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


def _method_cells(found: Evaluated, views: Sequence[str], key: str) -> list[str]:
    cells = []
    for view in views:
        numbers = found.metrics['views'].get(view, {})
        cells += [number(numbers.get('fid'), 1), number(numbers.get('fvd'), 1)]
        cells.append(number(numbers.get(key)))
    return cells


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
            'Brackets: 95 % bootstrap over episodes. J moving, persistence and shuffled actions: '
            'of the objects that really move. Skill: (J − J held) / (1 − J held).',
            class_='faint',
        ),
        join(tables),
        id='tasks',
    )
