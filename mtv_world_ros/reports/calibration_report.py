"""Report of a calibration: tables in markdown, reliability before and after as one page."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mtv_world_ros.core.documents import number, render, Table
from mtv_world_ros.core.files import write_json, write_whole
from mtv_world_ros.evaluation.fit import (
    AFTER,
    AFTER_KINDS,
    AFTER_PHYSICS,
    ALWAYS,
    BEFORE,
    Calibrated,
    FITTED,
    OBSERVED,
    RESUMED,
    Sample,
    UNFORESEEN,
)
from mtv_world_ros.evaluation.metrics.success_agreement import agreement, reliability_bins
from mtv_world_ros.reports.charts import reliability_chart
from mtv_world_ros.success.calibration import HorizonCurve, Weights
from mtv_world_ros.success.estimator import FAILURE_BELOW, SUCCESS_FROM
from mtv_world_ros.success.share_fit import ShareFit

_COLUMNS = {
    'num_abstained': 'no verdict',
    'abstention_rate': 'share without a verdict',
    'brier': 'Brier',
    'ece': 'ECE',
    'auroc': 'AUROC',
    'balanced_accuracy': 'balanced accuracy',
    'accuracy': 'accuracy',
    'false_success_rate': 'false-success rate',
}
_ROWS = {
    BEFORE: 'before: stated weights, or the share of futures as it is',
    AFTER: 'after: each task left out of the fit',
    AFTER_KINDS: 'after: each fault kind left out of the fit',
    AFTER_PHYSICS: 'after: each physics left out of the fit',
    OBSERVED: 'the recorded frames, each kind or task left out of a fit to them',
    RESUMED: 'all but the last chunk seen, each kind or task left out',
    UNFORESEEN: 'the same with nothing foreseen, each kind or task left out of a fit to them',
    FITTED: 'on what it was fitted on (too good)',
    ALWAYS: 'to say "success" always',
}
_GROUP_COLUMNS = (
    'episodes', 'succeed', 'mean estimate', 'accuracy', 'false-success rate', 'no verdict',
)  # fmt: skip


def write_calibration_report(out: Path, found: Calibrated, horizon: HorizonCurve | None) -> str:
    """Write `calibration.md`, `reliability.html` and `calibration.json`; return the first."""
    text = markdown(found, horizon)
    write_whole(out / 'calibration.md', text)
    write_whole(out / 'reliability.html', reliability_page(found))
    write_json(out / 'calibration.json', _values(found))
    return text


def markdown(found: Calibrated, horizon: HorizonCurve | None) -> str:
    """Return scores before and after, by task, the weights, and the trusted horizon."""
    calibration = found.calibration
    scores = [
        [words, *(_text(calibration.scores[name].get(key)) for key in _COLUMNS)]
        for name, words in _ROWS.items()
        if name in calibration.scores
    ]
    weights = {
        'Weights': calibration,
        'Weights for frames that were seen': calibration.observed,
        'Weights where no motion is foreseen': calibration.unforeseen,
    }
    return render(
        'calibration.md.j2',
        summary=_summary(found),
        scores=Table(head=['', *_COLUMNS.values()], rows=scores),
        tasks=_groups(found, AFTER, 'task', lambda sample: (sample.task,)),
        kinds=_kinds(found),
        futures='' if calibration.futures is None else _futures(calibration.futures),
        weights={title: (_weights(w), w.bias) for title, w in weights.items() if w},
        horizon='' if horizon is None else _horizon_text(horizon),
        made=calibration.made,
    )


def _futures(fit: ShareFit) -> str:
    """Return the fit of the share of simulated futures, in words."""
    deviations = [f'{fit.covariance[k] ** 0.5:.2f}' for k in (0, 2)]
    return (
        f'logit of the probability = {fit.bias:.2f} (standard error {deviations[0]}) + '
        f'{fit.slope:.2f} ({deviations[1]}) x log odds of the share, on {fit.num_episodes} '
        f'estimates. Imagined frames contradict the drawn motion from '
        f'{1e3 * fit.max_picture_gap_m:.0f} mm on.'
    )


def _weights(found: Weights) -> Table:
    rows = zip(found.features, found.weights, found.means, found.scales, strict=True)
    return Table(
        head=['feature', 'logit per scale', 'mean', 'scale'],
        rows=[[name, *map(number, row)] for name, *row in rows],
    )


def _summary(found: Calibrated) -> str:
    calibration = found.calibration
    num_successes = sum(sample.success for sample in found.samples)
    return (
        f'{len(found.samples)} imagined episodes of {len(calibration.tasks)} tasks, of which '
        f'{num_successes} really succeed; {calibration.num_seeds} seed(s) each, masks by '
        f'`{calibration.segmenter}`, L2 {calibration.l2:g}. Scores are of the episodes with an '
        'estimate; accuracies and the false-success rate, the share of real failures that were '
        f'called a success, of those with a verdict: a success from {SUCCESS_FROM} on, a failure '
        f'below {FAILURE_BELOW}, unless the interval reaches the opposite verdict.'
    )


def _kinds(found: Calibrated) -> Table | None:
    if AFTER_KINDS not in found.judgements:
        return None
    return _groups(found, AFTER_KINDS, 'kind', lambda sample: sample.kinds or ('(no fault)',))


def _groups(
    found: Calibrated, name: str, first: str, groups: Callable[[Sample], tuple[str, ...]]
) -> Table:
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
                _text(numbers['estimated_success_rate']),
                _text(numbers['accuracy']),
                _text(numbers['false_success_rate']),
                str(numbers['num_abstained']),
            ]
        )
    return Table(head=[first, *_GROUP_COLUMNS], rows=rows)


def _horizon_text(horizon: HorizonCurve) -> str:
    rows = [
        [f'{level:.1f}', f'{horizon.trusted_seconds(level):.1f} s']
        for level in (0.5, 0.6, 0.7, 0.8, 0.9)
    ]
    return (
        f'Mean J of the objects that move, over {horizon.num_episodes} whole episodes; known up '
        f'to {len(horizon.values) * horizon.period_s:.1f} s. By the lower end of the 95 % '
        'interval, J is at least\n\n'
        + Table(head=['J', 'up to'], rows=rows).markdown(aligned=False)
    )


def reliability_page(found: Calibrated) -> str:
    """Return a page with two charts that needs no other file."""
    charts = []
    for name in (BEFORE, AFTER, AFTER_KINDS):
        if name not in found.judgements:
            continue
        title = f'Share of real successes against the estimate, {_ROWS[name]}'
        chart = reliability_chart(title, reliability_bins(found.judgements[name]), 'c0')
        charts.append((_ROWS[name], chart))
    title = 'Reliability of the success estimate'
    return render('reliability.html.j2', title=title, charts=charts)


def _values(found: Calibrated) -> dict[str, Any]:
    """Return every sample with its features and estimates, for those who fit something else."""
    return {
        'scores': found.calibration.scores,
        'samples': [
            {
                'episode': sample.episode,
                'task': sample.task,
                'kinds': list(sample.kinds),
                'success': sample.success,
                'features': list(sample.features),
                'observed': sample.observed,
                'reasons': sample.reasons,
                **{name: judged[index].probability for name, judged in found.judgements.items()},
            }
            for index, sample in enumerate(found.samples)
        ],
    }


def _text(value: float | int | None) -> str:
    return str(value) if isinstance(value, int) else number(value)
