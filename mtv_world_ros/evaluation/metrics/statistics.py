"""Means over episodes with confidence intervals that hold for few episodes.

An episode is one observation: frames, objects and views of the same episode are averaged first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, nan

import numpy as np
from scipy.special import ndtri, stdtrit

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.evaluation.metrics.jaccard_scores import BOTH, MARGINS, MEANS, QUALITY

Interval = tuple[float, float]
UNKNOWN: Interval = (nan, nan)

#: fewer episodes than this have no interval, and nothing is concluded from them
MIN_EPISODES = 3
#: fewer scenes than this have no interval of r, MMRV or a prediction-powered rate
MIN_SCENES = 4
#: explanation of the intervals in tables and pages
METHOD = (
    f'95 % t intervals over episodes, none below {MIN_EPISODES} episodes or where all are equal'
)
#: (J - J_copy) / (1 - J_copy) of two means
SKILLS = {
    'skill': ('j_object_mean', 'j_copy_mean'),
    'skill_moving': ('j_moving', 'j_copy_moving'),
}
#: least and greatest value, where it is not that of J, 0 and 1
_RANGES = {
    'psnr': (-inf, inf),
    'ssim': (-1.0, 1.0),
    'lpips': (0.0, inf),
    **dict.fromkeys(MARGINS, (-1.0, 1.0)),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Mean over the episodes that have the value, and its 95 % interval; NaN = not known."""

    value: float
    interval: Interval
    num_episodes: int


def t_quantile(degrees: FloatArray | float) -> FloatArray:
    """Return the factor of the standard error in a 95 % interval, NaN below one degree."""
    with np.errstate(invalid='ignore'):
        return np.where(np.asarray(degrees) >= 1, stdtrit(np.maximum(degrees, 1), 0.975), nan)


def mean_interval(
    sums: FloatArray, counts: FloatArray, *, low: float = 0.0, high: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """Return the means of columns and their 95 % t intervals over the rows.

    A row is an episode, which is drawn as a whole; it brings the sum of several values, so the
    mean is a ratio of sums, whose variance is that of the episodes' residuals (linearised). With
    one value an episode it is the ordinary t interval of a mean.

    Args:
        sums: (E, M) sums of the values of each episode.
        counts: (E, M) number of these values, or what else the sums are divided by; both 0 =
            the episode has none.
        low: least possible value.
        high: greatest possible value.

    Returns:
        (M,) means, NaN where there is no value; (2, M) ends of the intervals, NaN where fewer
        than `MIN_EPISODES` have a value or all have the same.
    """
    total, num = counts.sum(0), ((counts > 0) | (sums != 0)).sum(0)
    with np.errstate(invalid='ignore', divide='ignore'):
        means = sums.sum(0) / total
        residuals = sums - means * counts
        error = np.sqrt((residuals**2).sum(0) * num / (num - 1)) / np.abs(total)
        half = t_quantile(num - 1) * error
    half[(num < MIN_EPISODES) | ~(error > 1e-9)] = nan
    return means, np.clip(np.stack([means - half, means + half]), low, high)


def summarise(episodes: Sequence[dict[str, float]]) -> dict[str, Estimate]:
    """Return the mean over episodes of every number, and the skills, with 95 % intervals.

    The interval of a margin is that of differences paired within each episode, over the episodes
    that have all margins: some may have no rollout with other commands. Episodes are given
    by their `episode_means`, and `QUALITY` where it was measured.
    """
    names = [*MEANS, *BOTH, *MARGINS, *QUALITY]
    rows = [[means.get(name, nan) for name in names] for means in episodes]
    columns = dict(zip(names, np.array(rows, np.float64).reshape(-1, len(names)).T, strict=True))
    compared = np.isfinite(columns['margin_over_shuffled'])
    if compared.any():
        for name in MARGINS:
            columns[name] = np.where(compared, columns[name], nan)
    found = {
        name: _estimate(values, np.ones_like(values), _RANGES.get(name, (0.0, 1.0)))
        for name, values in columns.items()
    }
    for name, (score, copy) in SKILLS.items():
        lack = _estimate(1 - columns[score], 1 - columns[copy], (0.0, inf))
        low, high = lack.interval
        found[name] = Estimate(
            value=1 - lack.value,
            interval=(1 - high, 1 - low),
            num_episodes=found[score].num_episodes,
        )
    return found


def _estimate(values: FloatArray, weights: FloatArray, limits: Interval) -> Estimate:
    """Return ratio of the sums of (E,) values and weights, over the episodes that have both."""
    known = np.isfinite(values) & np.isfinite(weights)
    sums, counts = (np.where(known, found, 0.0)[:, None] for found in (values, weights))
    mean, ends = mean_interval(sums, counts, low=limits[0], high=limits[1])
    return Estimate(
        value=float(mean[0]) if np.isfinite(mean[0]) else nan,
        interval=(float(ends[0, 0]), float(ends[1, 0])),
        num_episodes=int(known.sum()),
    )


def wilson(hits: float, count: float, quantile: float = float(ndtri(0.975))) -> Interval:
    """Return the 95 % Wilson score interval of a share of independent trials; NaN without any.

    `quantile` is the factor of the standard error.
    """
    if count <= 0:
        return UNKNOWN
    share, square = hits / count, quantile**2
    centre = share + square / (2 * count)
    half = quantile * np.sqrt(share * (1 - share) / count + square / (4 * count**2))
    scale = 1 + square / count
    low, high = (centre - half) / scale, (centre + half) / scale
    return max(float(low), 0.0), min(float(high), 1.0)


def clustered_wilson(hits: FloatArray, counts: FloatArray) -> Interval:
    """Return the 95 % interval of a share of trials that come in clusters.

    Wilson's interval of the effective number of trials, with the t quantile of the clusters
    (Korn and Graubard, 1998). Rollouts that share a scene are a cluster. NaN for fewer than
    `MIN_EPISODES` clusters.

    Args:
        hits: (C,) successes of each cluster.
        counts: (C,) trials of each.
    """
    hits, counts = (np.asarray(part, np.float64)[counts > 0] for part in (hits, counts))
    num, total = len(counts), counts.sum()
    if num < MIN_EPISODES:
        return UNKNOWN
    share = hits.sum() / total
    simple = share * (1 - share) / total
    variance = num / (num - 1) * ((hits - share * counts) ** 2).sum() / total**2
    # all alike: nothing says how much the trials of a cluster have in common
    effective = num if simple == 0 else min(total, total * simple / max(variance, 1e-12))
    return wilson(share * effective, effective, float(t_quantile(num - 1)))
