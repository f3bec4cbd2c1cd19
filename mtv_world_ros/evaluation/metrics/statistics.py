"""From rows to means per view with bootstrap intervals over episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import warnings

import numpy as np

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.evaluation.metrics.scores import ScoreRow
from mtv_world_ros.vision.jaccard import skill

Interval = tuple[float, float]

#: means over rows of one episode: name -> (field of the row, which rows)
MEANS = {
    'j_object_mean': ('j', 'object'),
    'j_visible': ('j_visible', 'object'),
    'j_copy_mean': ('j_copy', 'object'),
    'j_ceiling': ('j_ceiling', 'object'),
    'j_self': ('j_self', 'object'),
    'j_union': ('j', 'union'),
    'j_copy_union': ('j_copy', 'union'),
    'j_moving': ('j', 'moving'),
    'j_copy_moving': ('j_copy', 'moving'),
    'j_shuffled_moving': ('j_shuffled', 'moving'),
    'j_zero_moving': ('j_zero', 'moving'),
    'j_mirrored_moving': ('j_mirrored', 'moving'),
    'j_ceiling_moving': ('j_ceiling', 'moving'),
    'j_self_moving': ('j_self', 'moving'),
}
#: means over frames of one episode that are not of objects
QUALITY = ('psnr', 'ssim', 'lpips')
#: functions of the means: name -> (minuend, subtrahend); paired within each episode
MARGINS = {
    'margin_moving': ('j_moving', 'j_copy_moving'),
    'margin_over_shuffled': ('j_moving', 'j_shuffled_moving'),
    'margin_of_shuffled': ('j_shuffled_moving', 'j_copy_moving'),
}
#: (J - J_copy) / (1 - J_copy) of two means
SKILLS = {
    'skill': ('j_object_mean', 'j_copy_mean'),
    'skill_moving': ('j_moving', 'j_copy_moving'),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """A number and its 95 % bootstrap interval over episodes; NaN = not measured.

    Attributes:
        value: mean over the episodes that have it.
        interval: 2.5 and 97.5 percentiles.
        num_episodes: that have it.
    """

    value: float
    interval: Interval
    num_episodes: int


def episode_means(rows: Sequence[ScoreRow], view: str | None) -> dict[str, float]:
    """Returns the `MEANS` and `MARGINS` of one episode; frames weigh equally.

    Only rows with a J count, also in the baselines, so that the differences are paired.

    Args:
        rows: of the episode.
        view: name, or None for all views together.
    """
    kept = [row for row in rows if view in (None, row.view) and np.isfinite(row.j)]
    chosen = {
        'object': [row for row in kept if row.name],
        'union': [row for row in kept if not row.name],
        'moving': [row for row in kept if row.name and row.moving],
    }
    means = {name: _mean(chosen[which], field) for name, (field, which) in MEANS.items()}
    for name, (minuend, subtrahend) in MARGINS.items():
        means[name] = means[minuend] - means[subtrahend]
    return means


def _mean(rows: Sequence[ScoreRow], field: str) -> float:
    values = np.array([getattr(row, field) for row in rows], np.float64)
    weights = np.array([row.num_frames for row in rows], np.float64)
    known = np.isfinite(values)
    return float(np.average(values[known], weights=weights[known])) if known.any() else np.nan


def summarise(
    episodes: Sequence[dict[str, float]], *, seed: int = 0, num_resamples: int = 2000
) -> dict[str, Estimate]:
    """Returns the mean over episodes of every number, and the skills, with intervals.

    All numbers share the resamples, so the interval of a margin is that of paired differences.

    Args:
        episodes: `episode_means` of each episode, and its `QUALITY` where measured.
        seed: of the resampling.
        num_resamples: how often the episodes are drawn with replacement.
    """
    names = [*MEANS, *MARGINS, *QUALITY]
    table = np.array([[means.get(n, np.nan) for n in names] for means in episodes], np.float64)
    table = table.reshape(len(episodes), len(names))
    generator = np.random.default_rng(seed)
    draws = generator.integers(0, max(len(table), 1), (num_resamples, len(table)))
    values = dict(zip(names, _column_means(table[None])[0], strict=True))
    resampled = dict(zip(names, _column_means(table[draws]).T, strict=True))
    for name, (score, copy) in SKILLS.items():
        values[name] = skill(values[score], values[copy])
        resampled[name] = skill(resampled[score], resampled[copy])
    counts = dict(zip(names, np.isfinite(table).sum(0).tolist(), strict=True))
    return {
        name: Estimate(
            value=float(values[name]),
            interval=_percentiles(resampled[name]),
            num_episodes=counts.get(name, counts[SKILLS[name][0]] if name in SKILLS else 0),
        )
        for name in values
    }


def _column_means(tables: FloatArray) -> FloatArray:
    """(R, M) means over axis 1 of what is known; NaN where nothing is."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', RuntimeWarning)
        return np.nanmean(tables, axis=1)


def _percentiles(values: FloatArray) -> Interval:
    known = values[np.isfinite(values)]
    if not len(known):
        return (np.nan, np.nan)
    low, high = np.percentile(known, [2.5, 97.5])
    return (float(low), float(high))
