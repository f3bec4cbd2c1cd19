"""J against how far ahead was imagined, with 95 % bands over episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mtv_world_ros.evaluation.metrics.jaccard_scores import ScoreRow
from mtv_world_ros.evaluation.metrics.statistics import mean_interval

#: frames that fewer than this share of the rollouts reach are left out of pictures
MIN_SHARE = 1 / 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """Mean J per predicted frame.

    Attributes:
        values: (T,) mean over rows of objects that move.
        band: (T,) 95 % t intervals over episodes; NaN where too few reach the frame.
    """

    values: tuple[float, ...]
    band: tuple[tuple[float, float], ...]

    def at(self, index: int) -> tuple[float | None, tuple[float, float] | None]:
        """Return a value and its interval; None where the curve does not reach."""
        reached = index < len(self.values)
        return (self.values[index], self.band[index]) if reached else (None, None)


def horizon_curve(
    episodes: Sequence[Sequence[ScoreRow]],
    view: str | None,
    field: str,
    *,
    min_share: float = MIN_SHARE,
) -> Curve:
    """Return J of the moving objects of a view against the horizon; rows weigh equally.

    Args:
        episodes: rows of each episode.
        view: name of the view; None = all.
        field: name of the measure, one of `scores.FRAME_FIELDS`.
        min_share: frames that fewer than this share of the rollouts reach are left out.
    """
    sums, counts = _sums(_moving(episodes, view, field))
    total = counts.sum(0)
    covered = int((total >= max(min_share * total.max(initial=0), 1)).sum())
    return _curve(sums[:, :covered], counts[:, :covered])


def by_chunk(
    episodes: Sequence[Sequence[ScoreRow]],
    view: str | None,
    field: str,
    num_frames: int,
) -> Curve:
    """Return J of moving objects by chunk of the rollouts, which shows drift.

    All frames of a chunk, `num_frames`, weigh equally; the other arguments are those of `curve`.
    """
    sums, counts = _sums(_moving(episodes, view, field))
    missing = -sums.shape[1] % num_frames
    chunks = [
        np.pad(of_frames, ((0, 0), (0, missing))).reshape(len(episodes), -1, num_frames).sum(2)
        for of_frames in (sums, counts)
    ]
    return _curve(chunks[0], chunks[1])


def _moving(
    episodes: Sequence[Sequence[ScoreRow]], view: str | None, field: str
) -> list[list[Sequence[float]]]:
    """Return the values per frame of each episode's rows of objects that move."""
    return [
        [
            getattr(row, field)
            for row in rows
            if row.name and row.moving and view in (None, row.view)
        ]
        for rows in episodes
    ]


def _curve(sums: np.ndarray, counts: np.ndarray) -> Curve:
    """Return the mean over episodes and its interval, from sums and counts of values (E, T)."""
    values, (low, high) = mean_interval(sums, counts)
    return Curve(
        values=tuple(values.tolist()),
        band=tuple(zip(low.tolist(), high.tolist(), strict=True)),
    )


def _sums(episodes: Sequence[Sequence[Sequence[float]]]) -> tuple[np.ndarray, np.ndarray]:
    """Return sums and counts (E, T) of the known values of each episode's rows."""
    longest = max((len(frames) for rows in episodes for frames in rows), default=0)
    sums, counts = np.zeros((len(episodes), longest)), np.zeros((len(episodes), longest))
    for index, rows in enumerate(episodes):
        for frames in rows:
            known = np.isfinite(frames)
            sums[index, : len(frames)] += np.where(known, frames, 0.0)
            counts[index, : len(frames)] += known
    return sums, counts
