"""Agreement of success estimates with true outcomes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan
from typing import Any

import numpy as np
from scipy.stats import mannwhitneyu

from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.evaluation.metrics.statistics import wilson
from mtv_world_ros.success.estimator import verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """Estimate at the end of an episode, and its outcome.

    Attributes:
        probability: probability of success; NaN = abstained.
        outcome: `success`, `failure` or `unknown`.
        interval: interval of the probability; NaN = not known.
    """

    probability: float
    outcome: str
    interval: tuple[float, float] = (nan, nan)


#: equally wide bins of the calibration error
NUM_BINS = 10
#: those of the reliability chart
NUM_CHART_BINS = 5


def agreement(judgements: Sequence[Judgement]) -> dict[str, Any]:
    """Return counts and score of the estimates; None = unknown.

    The false-success rate is the share of real failures that were called a success. It and the
    accuracies are of those with a `verdict`, the others of those with a probability.
    """
    known = [item for item in judgements if item.outcome in ('success', 'failure')]
    probability = np.array([item.probability for item in known])
    real = np.array([item.outcome == 'success' for item in known], bool)
    verdicts = np.array([verdict(item.probability, item.interval) for item in known])
    called, decided, judged = verdicts == 1, np.isfinite(verdicts), np.isfinite(probability)
    hit, avoided = _mean(called[real & decided]), _mean(~called[~real & decided])
    balanced = None if hit is None or avoided is None else (hit + avoided) / 2
    abstained, estimates, outcomes = ~decided, probability[judged], real[judged]
    return {
        'num_outcomes_known': len(known),
        'num_abstained': int(abstained.sum()),
        'abstention_rate': _mean(abstained),
        'real_success_rate': _mean(real),
        'estimated_success_rate': _mean(estimates),
        'accuracy': _mean((called == real)[decided]),
        'balanced_accuracy': balanced,
        'brier': _mean((estimates - outcomes) ** 2),
        'ece': expected_calibration_error(estimates, outcomes) if len(estimates) else None,
        'auroc': area_under_roc(estimates, outcomes),
        'false_success_rate': _mean(called[~real & decided]),
    }


def expected_calibration_error(probability: FloatArray, real: BoolArray) -> float:
    """Return the expected calibration error of estimates (N,).

    Bins weigh by how many estimates lie in them (Guo et al., 2017). An estimate is the probability
    of success, not of the likelier outcome.
    """
    bins = _binned(probability, NUM_BINS)
    return float(sum(at.mean() * abs(probability[at].mean() - real[at].mean()) for _, at in bins))


def _binned(probability: FloatArray, num_bins: int) -> list[tuple[float, BoolArray]]:
    """Middle of each of equally wide bins that hold an estimate, and which (N,) it holds."""
    place = np.minimum((probability * num_bins).astype(int), num_bins - 1)
    return [((k + 0.5) / num_bins, place == k) for k in np.unique(place)]


def area_under_roc(probability: FloatArray, real: BoolArray) -> float | None:
    """Return the AUC: probability that a success is rated above a failure; None without both."""
    gained, lost = probability[real], probability[~real]
    if not len(gained) or not len(lost):
        return None
    return float(mannwhitneyu(gained, lost).statistic / (len(gained) * len(lost)))


def _mean(values: np.ndarray) -> float | None:
    return float(np.mean(values)) if len(values) else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Bin:
    """Bin of a reliability diagram: estimates of similar probability, and their outcomes.

    Attributes:
        middle: middle of the probabilities that belong here.
        estimate: mean of the estimates.
        came_true: share of successes among these episodes.
        interval: 95 % Wilson interval of the share.
        count: number of estimates.
    """

    middle: float
    estimate: float
    came_true: float
    interval: tuple[float, float]
    count: int


def reliability_bins(judgements: Sequence[Judgement]) -> list[Bin]:
    """Return the bins that hold an estimate of known outcome; empty = there is none."""
    judged = [
        item
        for item in judgements
        if item.outcome in ('success', 'failure') and np.isfinite(item.probability)
    ]
    estimates = np.array([item.probability for item in judged])
    true = np.array([item.outcome == 'success' for item in judged], bool)
    return [
        Bin(
            middle=middle,
            estimate=float(estimates[at].mean()),
            came_true=float(true[at].mean()),
            interval=wilson(int(true[at].sum()), int(at.sum())),
            count=int(at.sum()),
        )
        for middle, at in _binned(estimates, NUM_CHART_BINS)
    ]
