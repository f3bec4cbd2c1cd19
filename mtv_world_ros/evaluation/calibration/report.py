"""What a calibration changed: tables in markdown, reliability before and after as one page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from mtv_world_ros.evaluation.calibration.fit import (
    AFTER,
    AFTER_KINDS,
    ALWAYS,
    BEFORE,
    Calibrated,
    FITTED,
    Sample,
)
from mtv_world_ros.evaluation.metrics.success_agreement import agreement, reliability_bins
from mtv_world_ros.evaluation.report.charts import reliability_chart
from mtv_world_ros.evaluation.report.markup import element, Markup
from mtv_world_ros.files import share_path, write_json, write_whole
from mtv_world_ros.success.calibration import HorizonCurve

_COLUMNS = {
    'num_abstained': 'abstained',
    'abstention_rate': 'abstention rate',
    'brier': 'Brier',
    'ece': 'ECE',
    'auroc': 'AUROC',
    'balanced_accuracy': 'balanced accuracy',
    'accuracy': 'accuracy',
    'false_success_rate': 'false-success rate',
}
_ROWS = {
    BEFORE: 'before: stated weights',
    AFTER: 'after: each task left out of the fit',
    AFTER_KINDS: 'after: each fault kind left out of the fit',
    FITTED: 'on what it was fitted on (too good)',
    ALWAYS: 'to say "success" always',
}


_GROUP_COLUMNS = (
    'episodes', 'succeed', 'mean estimate', 'accuracy', 'false-success rate', 'abstained',
)  # fmt: skip


def write_calibration_report(out: Path, found: Calibrated, horizon: HorizonCurve | None) -> str:
    """Writes `calibration.md`, `reliability.html` and `calibration.json`; returns the first."""
    text = markdown(found, horizon)
    write_whole(out / 'calibration.md', text)
    write_whole(out / 'reliability.html', reliability_page(found))
    write_json(out / 'calibration.json', _values(found))
    return text


def markdown(found: Calibrated, horizon: HorizonCurve | None) -> str:
    """Returns scores before and after, by task, the weights, and the trusted horizon."""
    calibration = found.calibration
    scores = [
        [words, *(_number(calibration.scores[name].get(key)) for key in _COLUMNS)]
        for name, words in _ROWS.items()
        if name in calibration.scores
    ]
    weights = [
        [name, *(f'{value:.3f}' for value in row)]
        for name, *row in zip(
            calibration.features, calibration.weights, calibration.means, calibration.scales,
            strict=True,
        )
    ]  # fmt: skip
    parts = [
        '# Calibration of the success estimate',
        _summary(found),
        _table(['', *_COLUMNS.values()], scores),
        '## By task, each left out of the fit that judges it',
        _table(['task', *_GROUP_COLUMNS], _group_rows(found, AFTER, lambda s: (s.task,))),
        *_kinds(found),
        '## Weights',
        _table(['feature', 'logit per scale', 'mean', 'scale'], weights)
        + f'\n\nBias {calibration.bias:.3f}.',
    ]  # fmt: skip
    if horizon is not None:
        parts += ['## Trusted horizon', _horizon_text(horizon)]
    parts += [f'- {key}: `{value}`' for key, value in calibration.made.items()]
    return '\n\n'.join(parts) + '\n'


def _summary(found: Calibrated) -> str:
    calibration = found.calibration
    num_successes = sum(sample.success for sample in found.samples)
    return (
        f'{len(found.samples)} imagined episodes of {len(calibration.tasks)} tasks, of which '
        f'{num_successes} really succeed; {calibration.num_seeds} seed(s) each, masks by '
        f'`{calibration.segmenter}`, L2 {calibration.l2:g}. Scores are of the episodes in which '
        'the estimate did not abstain; the false-success rate is the share of real failures that '
        'were called a success.'
    )


def _kinds(found: Calibrated) -> list[str]:
    if AFTER_KINDS not in found.judgements:
        return []
    rows = _group_rows(found, AFTER_KINDS, lambda sample: sample.kinds or ('(no fault)',))
    return [
        '## By fault kind, each left out of the fit that judges it',
        _table(['kind', *_GROUP_COLUMNS], rows),
    ]


def _group_rows(
    found: Calibrated, name: str, groups: Callable[[Sample], tuple[str, ...]]
) -> list[list[str]]:
    rows = []
    for group in sorted({group for sample in found.samples for group in groups(sample)}):
        pairs = zip(found.samples, found.judgements[name], strict=True)
        judged = [judgement for sample, judgement in pairs if group in groups(sample)]
        numbers = agreement(judged)
        rows.append(
            [
                group,
                str(len(judged)),
                str(sum(item.outcome == 'success' for item in judged)),
                _number(numbers['estimated_success_rate']),
                _number(numbers['accuracy']),
                _number(numbers['false_success_rate']),
                str(numbers['num_abstained']),
            ]
        )
    return rows


def _horizon_text(horizon: HorizonCurve) -> str:
    rows = [
        [f'{level:.1f}', f'{horizon.trusted_seconds(level):.1f} s']
        for level in (0.5, 0.6, 0.7, 0.8, 0.9)
    ]
    return (
        f'Mean J of the objects that move, over {horizon.num_episodes} whole episodes; known up '
        f'to {len(horizon.values) * horizon.period_s:.1f} s. By the lower end of the 95 % '
        'interval, J is at least\n\n' + _table(['J', 'up to'], rows)
    )


def reliability_page(found: Calibrated) -> str:
    """Returns a page with two charts that needs no other file."""
    figures = []
    for name in (BEFORE, AFTER, AFTER_KINDS):
        if name not in found.judgements:
            continue
        title = f'Share of real successes against the estimate, {_ROWS[name]}'
        chart = reliability_chart(title, reliability_bins(found.judgements[name]), 'c0')
        figures.append(element('figure', element('figcaption', _ROWS[name]), chart))
    head = element(
        'head',
        element('meta', charset='utf-8'),
        element('title', 'Reliability of the success estimate'),
        element('style', Markup(share_path('resource', 'report', 'style.css').read_text('utf-8'))),
    )
    body = element('main', element('h1', 'Reliability of the success estimate'), *figures)
    return f'<!DOCTYPE html>\n{element("html", head, element("body", body), lang="en")}\n'


def _values(found: Calibrated) -> dict[str, Any]:
    """Every sample with its features and estimates, for those who fit something else."""
    return {
        'scores': found.calibration.scores,
        'samples': [
            {
                'episode': sample.episode,
                'task': sample.task,
                'kinds': list(sample.kinds),
                'success': sample.success,
                'features': list(sample.features),
                'reasons': sample.reasons,
                **{name: judged[index].probability for name, judged in found.judgements.items()},
            }
            for index, sample in enumerate(found.samples)
        ],
    }


def _number(value: float | int | None) -> str:
    if value is None or not isfinite(value):
        return '–'
    return str(value) if isinstance(value, int) else f'{value:.3f}'


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ['---'] * len(head), *rows]
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)
