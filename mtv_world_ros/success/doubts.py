"""What an estimate has to doubt beside the pictures: the cameras, the physics."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from math import isfinite, nan

import numpy as np
from scipy.special import bdtrc

from mtv_world_ros.data_types import FloatArray, SuccessEstimate

#: an object that is nearer to one of its futures went as foreseen [m]: masks of small pictures,
#: and a future in K, know no better
NEAR_M = 0.035
#: less movement says nothing of contact [m]
_MOVES_M = 0.03
#: share of chunks that end unforeseen where the physics is the fitted one, at most
_USUAL = 0.15
#: chance, where it is, below which it is taken to be another one
_SURE = 0.01
#: chunks that are remembered
_MOST = 24
SAYS = 'the physics here is not the one that was fitted'


def unforeseen(foreseen: FloatArray, real: FloatArray) -> float:
    """Returns how far what really happened is from the nearest future [m]; NaN = nothing moved.

    Args:
        foreseen: (K, 1 + T, O, 3) centres of objects from a chunk's start on [m].
        real: (1 + T, O, 3) where masks show them [m], NaN = not known.
    """
    ahead = foreseen[:, -1] - foreseen[:, 0]
    came = real[-1] - real[0]
    gaps = np.linalg.norm(ahead - came, axis=-1)
    known = np.isfinite(gaps).all(0)
    moved = np.maximum(np.linalg.norm(ahead, axis=-1).max(0, initial=0.0),
                       np.linalg.norm(came, axis=-1)) > _MOVES_M  # fmt: skip
    told = known & moved
    return float(gaps.min(0)[told].max()) if told.any() else nan


class PhysicsWatch:
    """Remembers how chunks that were executed ended, and says whether that was foreseen."""

    def __init__(self) -> None:
        self._parted: deque[bool] = deque(maxlen=_MOST)

    def take(self, away_m: float) -> None:
        """Takes how far a chunk's end was from the nearest future [m]; NaN = it tells nothing."""
        if np.isfinite(away_m):
            self._parted.append(away_m > NEAR_M)

    def forget(self) -> None:
        """Begins anew: another task, or another fit."""
        self._parted.clear()

    @property
    def doubt(self) -> str:
        """Why futures are not to be believed here; empty = nothing speaks against them."""
        count, of = sum(self._parted), len(self._parted)
        if not of or bdtrc(count - 1, of, _USUAL) >= _SURE:
            return ''
        return (
            f'{SAYS}: {count} of the last {of} executed chunks in which an object moved ended '
            'where no future foresaw it; run mtv-world fit-contact on recordings of this place'
        )

    @property
    def text(self) -> str:
        """What `/diagnostics` says."""
        of = len(self._parted)
        return self.doubt or (
            f'as it was fitted, by {of} executed chunks' if of else 'not compared yet'
        )


def doubted(
    estimate: SuccessEstimate, notes: Sequence[str] = (), refusal: str = ''
) -> SuccessEstimate:
    """Returns an estimate that says its doubts.

    Args:
        estimate: of pictures and foreseen motions.
        notes: remarks for the reader, one line each.
        refusal: why there is no verdict; empty = there may be one.
    """
    if refusal:
        return replace(
            estimate,
            probability=nan,
            interval=(nan, nan),
            reasons=(f'abstains: {refusal}', *estimate.reasons),
        )
    return replace(estimate, reasons=(*estimate.reasons, *notes)) if notes else estimate


#: an estimate that is doubted is drawn to even chances by this share, and known no better than so
_DRAWN, _HALF_WIDTH = 0.5, 0.35


def widened(estimate: SuccessEstimate, doubt: str) -> SuccessEstimate:
    """Returns an estimate of futures that are not to be believed as they are.

    Args:
        estimate: as if they were.
        doubt: why they are not.
    """
    reasons = (doubt, *estimate.reasons)
    if not isfinite(estimate.probability):
        return replace(estimate, reasons=reasons)
    middle = 0.5 + (1 - _DRAWN) * (estimate.probability - 0.5)
    low, high = estimate.interval
    interval = (
        max(min(low, middle - _HALF_WIDTH), 0.0),
        min(max(high, middle + _HALF_WIDTH), 1.0),
    )
    return replace(estimate, probability=middle, interval=interval, reasons=reasons)
