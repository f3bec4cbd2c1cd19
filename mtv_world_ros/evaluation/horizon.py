"""J against how far ahead was imagined, with bootstrap bands over episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mtv_world_ros.evaluation.scores import ScoreRow

#: frames that fewer than this share of the rollouts reach are left out of pictures
MIN_SHARE = 1 / 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """Mean J per predicted frame.

    Attributes:
        values: (T,) mean over rows of objects that move.
        band: (T,) 2.5 and 97.5 percentiles over resampled episodes.
    """

    values: tuple[float, ...]
    band: tuple[tuple[float, float], ...]


def curve(
    episodes: Sequence[Sequence[ScoreRow]],
    view: str | None,
    field: str,
    *,
    min_share: float = MIN_SHARE,
    seed: int = 0,
    num_resamples: int = 500,
) -> Curve:
    """Returns J of the moving objects of a view against the horizon; rows weigh equally.

    Args:
        episodes: rows of each episode.
        view: its name; None = all.
        field: one of `scores.FRAME_FIELDS`.
        min_share: frames that fewer than this share of the rollouts reach are left out.
        seed: of the resampling.
        num_resamples: how often the episodes are drawn with replacement.
    """
    kept = [
        [
            getattr(row, field)
            for row in rows
            if row.name and row.moving and view in (None, row.view)
        ]
        for rows in episodes
    ]
    sums, counts = _sums(kept)
    total = counts.sum(0)
    covered = int((total >= max(min_share * total.max(initial=0), 1)).sum())
    if not covered:
        return Curve(values=(), band=())
    sums, counts = sums[:, :covered], counts[:, :covered]
    share = np.full(len(kept), 1 / len(kept))
    weights = np.random.default_rng(seed).multinomial(len(kept), share, size=num_resamples)
    with np.errstate(invalid='ignore'):
        drawn = (weights @ sums) / (weights @ counts)
    low, high = np.nanpercentile(drawn, [2.5, 97.5], axis=0)
    return Curve(
        values=tuple((sums.sum(0) / counts.sum(0)).tolist()),
        band=tuple(zip(low.tolist(), high.tolist(), strict=True)),
    )


def _sums(episodes: Sequence[Sequence[Sequence[float]]]) -> tuple[np.ndarray, np.ndarray]:
    """(E, T) sums of the known values of each episode's rows, and how many they are."""
    longest = max((len(frames) for rows in episodes for frames in rows), default=0)
    sums, counts = np.zeros((len(episodes), longest)), np.zeros((len(episodes), longest))
    for index, rows in enumerate(episodes):
        for frames in rows:
            known = np.isfinite(frames)
            sums[index, : len(frames)] += np.where(known, frames, 0.0)
            counts[index, : len(frames)] += known
    return sums, counts
