"""The report's details: success estimates, statuses, failures, all episodes, provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any

from mtv_world_ros.evaluation.metrics.success_agreement import Judgement, reliability_bins
from mtv_world_ros.evaluation.report.charts import reliability_chart
from mtv_world_ros.evaluation.report.headline import badge, hue, letter, number
from mtv_world_ros.evaluation.report.markup import element, join, Markup, table
from mtv_world_ros.evaluation.report.read_back import Evaluated, scores

#: parts of metrics.json that have sections of their own
_SHOWN = {'name', 'label', 'provenance', 'failed', 'notes', 'episodes', 'success'}
_SHOWN |= {'views', 'overall', 'tasks', 'zero_shot'}


def success_section(evaluations: Sequence[Evaluated]) -> Markup | None:
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
        element('figure', element('h3', badge(index, evaluations), 'Reliability'), chart)
        for index, found in enumerate(evaluations)
        if (chart := _reliability(found, hue(index))) is not None
    ]
    return element(
        'section',
        element('h2', 'Success estimate'),
        element(
            'p',
            'The estimate at the end of each episode against what was recorded. False success: '
            'share of real failures that were called a success. Whiskers: 95 % Wilson intervals.',
            class_='faint',
        ),
        element('div', table(['', *columns], rows), *charts, class_='panels'),
        id='success',
    )


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


def status_section(evaluations: Sequence[Evaluated]) -> Markup:
    """Returns how often which status came up, and what could not be evaluated at all."""
    tables = []
    for index, found in enumerate(evaluations):
        views = found.metrics['views']
        words = list(dict.fromkeys(word for n in views.values() for word in n.get('status', {})))
        rows = [[w, *(str(n.get('status', {}).get(w, 0)) for n in views.values())] for w in words]
        rows.append(['not scored, in all', *(str(n['num_not_scored']) for n in views.values())])
        heading = element('h3', badge(index, evaluations), 'Objects by status and view')
        tables.append(join([heading, table(['Status', *views], rows)]))
    return element(
        'section',
        element('h2', 'Statuses and failures'),
        element(
            'p',
            'Counted per stretch and object. "predicted: …" was found in imagined frames, '
            '"true: …" in recorded ones; what cannot be scored counts neither as 0 nor as 1.',
            class_='faint',
        ),
        *tables,
        *(_failures(index, evaluations) for index in range(len(evaluations))),
        id='statuses',
    )


def _failures(index: int, evaluations: Sequence[Evaluated]) -> Markup:
    failed = evaluations[index].metrics['failed']
    heading = element('h3', badge(index, evaluations), f'Episodes that failed: {len(failed)}')
    items = [element('li', element('code', path), f' {why}') for path, why in failed.items()]
    listed = element('ul', *items, class_='failed') if items else None
    return join([heading, listed, _notes(evaluations[index].metrics.get('notes', {}))])


def _notes(notes: Mapping[str, Sequence[str]]) -> Markup | None:
    items = [
        element('li', element('code', name), f' {note}') for name in notes for note in notes[name]
    ]
    summary = element('summary', f'Notes on recordings: {len(items)}')
    return element('details', summary, element('ul', *items)) if items else None


def episodes_section(evaluations: Sequence[Evaluated]) -> Markup:
    """Returns a line per episode, the worst first."""
    parts = []
    for index, found in enumerate(evaluations):
        keys = ('j_moving', 'j_copy_moving', 'j_shuffled_moving', 'j_object_mean')
        by_key = {key: scores(found, key) for key in keys}
        order = sorted(found.results, key=lambda n: (by_key['j_moving'].get(n, 2.0), n))
        rows = []
        for name in order:
            result = found.results[name]
            numbers = [number(by_key[key].get(name)) for key in keys]
            told = number(result.probability) if isfinite(result.probability) else 'abstains'
            rows.append([name, result.task, result.outcome, *numbers, told])
        head = ['Episode', 'Task', 'Outcome', 'J moving', 'held', 'shuffled', 'J objects']
        parts.append(
            element(
                'details',
                element('summary', badge(index, evaluations), f'{len(rows)} episodes'),
                table([*head, 'Success'], rows, num_labels=3),
            )
        )
    return element('section', element('h2', 'All episodes, worst first'), *parts, id='episodes')


def provenance_section(evaluations: Sequence[Evaluated]) -> Markup:
    """Returns how the numbers came about."""
    parts = []
    for index, found in enumerate(evaluations):
        lines = {'checkpoint': found.metrics['name'], **found.metrics['provenance']}
        lines |= {'results': str(found.folder)}
        lines |= {key: _flat(v) for key, v in found.metrics.items() if key not in _SHOWN}
        items = [
            join([element('dt', key.replace('_', ' ')), element('dd', value)])
            for key, value in lines.items()
        ]
        heading = element('h3', badge(index, evaluations), found.name)
        parts.append(join([heading, element('dl', *items)]))
    folders = ' '.join(str(found.folder) for found in evaluations)
    return element(
        'section',
        element('h2', 'How this was made'),
        *parts,
        element('p', 'The page again, without the model:', class_='faint'),
        element('pre', f'mtv-world report {folders}'),
        id='made',
    )


def _flat(value: Any) -> str:
    if isinstance(value, dict):
        return ', '.join(f'{key} {_flat(item)}' for key, item in value.items())
    if isinstance(value, list):
        return ', '.join(map(_flat, value))
    if isinstance(value, float):
        return f'{value:.6g}'
    return '–' if value is None else str(value)
