"""Estimates of several rollouts of one plan as one."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, nan, sqrt

import numpy as np

from mtv_world_ros.data_types import SuccessEstimate

#: 97.5 % quantiles of Student's t for 1 ... 9 degrees of freedom; 2 bounds it from there on
_T = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262)


def combine(estimates: Sequence[SuccessEstimate]) -> SuccessEstimate:
    """Returns the mean over rollouts that differ in their seeds alone.

    `spread` is their standard deviation; the interval is Student's of the mean: where more
    rollouts of this world model would put it, not where reality lies. Abstains where most of them
    do. J and features are those of the first.
    """
    first = estimates[0]
    known = [e.probability for e in estimates if isfinite(e.probability)]
    num = len(estimates)
    if num == 1:
        return first
    if 2 * len(known) <= num:
        reasons = next(e.reasons for e in estimates if not isfinite(e.probability))
        text = f'abstains: {num - len(known)} of {num} seeds do; {reasons[0]}'
        return _with(first, nan, (nan, nan), nan, num, (text, *reasons[1:]))
    mean = float(np.mean(known))
    spread = float(np.std(known, ddof=1)) if len(known) > 1 else nan
    degrees = len(known) - 1
    quantile = _T[degrees - 1] if 0 < degrees <= len(_T) else 2.262
    half = quantile * spread / sqrt(len(known)) if degrees else 1.0
    text = (
        f'mean of {len(known)} of {num} seeds, spread {spread:.2f}; '
        'the interval is of the mean, given the world model'
    )
    interval = (max(mean - half, 0.0), min(mean + half, 1.0))
    return _with(first, mean, interval, spread, num, (text, *first.reasons))


def _with(
    first: SuccessEstimate,
    probability: float,
    interval: tuple[float, float],
    spread: float,
    num_seeds: int,
    reasons: tuple[str, ...],
) -> SuccessEstimate:
    return SuccessEstimate(
        probability=probability,
        interval=interval,
        jaccard=first.jaccard,
        reasons=reasons,
        features=first.features,
        is_calibrated=first.is_calibrated,
        num_seeds=num_seeds,
        spread=spread,
    )
