"""Doubts about an estimate that pictures do not show: wrong cameras, another physics."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite, nan

import numpy as np
from scipy.special import bdtrc

from mtv_world_ros.core.data_types import FloatArray, SuccessEstimate
from mtv_world_ros.success.estimator import capped, stated_probability
from mtv_world_ros.success.evidence import MAX_MARGIN

#: an object nearer than this to one of its futures moved as foreseen [m]; masks of small pictures
#: are no more exact
NEAR_M = 0.035
#: minimum object motion for evidence about contact [m]
_MIN_MOTION_M = 0.03
#: maximum fraction of chunks with unforeseen ends under the fitted physics
_MAX_UNFORESEEN_FRACTION = 0.15
#: p-value below which the fitted physics is rejected
_MAX_P_VALUE = 0.01
#: number of last chunks in the test
_NUM_CHUNKS = 24
SAYS = 'the physics here is not the one that was fitted'


def unforeseen(foreseen: FloatArray, real: FloatArray) -> float:
    """Return the distance of the real motion from the nearest future [m]; NaN = nothing moved.

    Args:
        foreseen: (K, 1 + T, O, 3) centres of objects from a chunk's start on [m].
        real: (1 + T, O, 3) where masks show them [m], NaN = not known.
    """
    ahead = foreseen[:, -1] - foreseen[:, 0]
    came = real[-1] - real[0]
    gaps = np.linalg.norm(ahead - came, axis=-1)
    known = np.isfinite(gaps).all(0)
    moved = np.maximum(np.linalg.norm(ahead, axis=-1).max(0, initial=0.0),
                       np.linalg.norm(came, axis=-1)) > _MIN_MOTION_M  # fmt: skip
    counts = known & moved
    return float(gaps.min(0)[counts].max()) if counts.any() else nan


class PhysicsWatch:
    """Tests whether executed chunks end as foreseen, by a binomial test over the last ones."""

    def __init__(self) -> None:
        self._unforeseen: deque[bool] = deque(maxlen=_NUM_CHUNKS)

    def take(self, away_m: float) -> None:
        """Add the distance of a chunk's end from the nearest future [m]; NaN = no evidence."""
        if np.isfinite(away_m):
            self._unforeseen.append(away_m > NEAR_M)

    def forget(self) -> None:
        """Begin anew: another task, or another fit."""
        self._unforeseen.clear()

    @property
    def doubt(self) -> str:
        """Reason why the fitted physics does not hold here; empty if it holds."""
        count, of = sum(self._unforeseen), len(self._unforeseen)
        if not of or bdtrc(count - 1, of, _MAX_UNFORESEEN_FRACTION) >= _MAX_P_VALUE:
            return ''
        return (
            f'{SAYS}: {count} of the last {of} executed chunks in which an object moved ended '
            'where no future foresaw it; run mtv-world fit contact on recordings of this place'
        )

    @property
    def text(self) -> str:
        """Text for `/diagnostics`."""
        of = len(self._unforeseen)
        return self.doubt or (
            f'as it was fitted, by {of} executed chunks' if of else 'not compared yet'
        )


def doubted(
    estimate: SuccessEstimate, notes: Sequence[str] = (), refusal: str = ''
) -> SuccessEstimate:
    """Return an estimate with remarks, or without a verdict.

    Args:
        estimate: estimate of pictures and foreseen motions.
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


#: shrinkage of a doubted estimate towards 0.5 [fraction of its distance from 0.5]
_SHRINKAGE = 0.5
#: minimum half width of the interval of a doubted estimate
_MIN_HALF_WIDTH = 0.35


def widened(estimate: SuccessEstimate, doubt: str) -> SuccessEstimate:
    """Return a less certain estimate, for foreseen motions under a doubtful physics.

    Args:
        estimate: estimate under the fitted physics.
        doubt: why that does not hold.
    """
    reasons = (doubt, *estimate.reasons)
    if not isfinite(estimate.probability):
        return replace(estimate, reasons=reasons)
    middle = 0.5 + (1 - _SHRINKAGE) * (estimate.probability - 0.5)
    low, high = estimate.interval
    interval = (
        max(min(low, middle - _MIN_HALF_WIDTH), 0.0),
        min(max(high, middle + _MIN_HALF_WIDTH), 1.0),
    )
    return replace(estimate, probability=middle, interval=interval, reasons=reasons)


#: commands that calibrate an estimate
_CALIBRATE = 'mtv-world fit success CHECKPOINT EPISODES on episodes of known outcome'
_FIT = 'mtv-world fit contact RECORDINGS --checkpoint CHECKPOINT on recordings of this robot'


@dataclass(frozen=True, slots=True, kw_only=True)
class Grounds:
    """Basis of an uncalibrated estimate from imagined frames.

    Attributes:
        foreseen: why foreseen motions are no ground, as their numbers of contact are guessed;
            empty = they are.
        pictures: why imagined frames alone are none; empty = they are.
    """

    foreseen: str = ''
    pictures: str = ''

    @classmethod
    def of(cls, contact: str, is_calibrated: bool) -> Grounds:
        """Return the grounds of a checkpoint.

        Args:
            contact: doubt about its numbers of contact; empty = there is none.
            is_calibrated: whether it has a calibration, of whatever task and robot.
        """
        never = '' if is_calibrated else 'the estimate was never calibrated for this checkpoint'
        return cls(
            foreseen=contact
            and f'{contact}, and the estimate is uncalibrated: run {_FIT}, or {_CALIBRATE}',
            pictures=never and f'{never}, and no motion is foreseen: run {_CALIBRATE}, or {_FIT}',
        )

    def bear(self, estimate: SuccessEstimate) -> SuccessEstimate:
        """Return an estimate of imagined frames by what it may rest on: none if by nothing.

        Where pictures are no ground, foreseen motions alone decide.
        """
        if estimate.is_calibrated or not isfinite(estimate.probability):
            return estimate
        is_foreseen = isfinite(estimate.features.get('foreseen', nan))
        if is_foreseen and self.pictures:
            estimate = _foreseen_alone(estimate)
        refusal = self.foreseen if is_foreseen else self.pictures
        if not refusal:
            return estimate
        low, high = estimate.interval
        without = f'without this doubt {estimate.probability:.2f} [{low:.2f}, {high:.2f}]'
        return doubted(estimate, refusal=f'{refusal}; {without}')


def _foreseen_alone(estimate: SuccessEstimate) -> SuccessEstimate:
    """Return an estimate by foreseen motions; its interval holds whatever pictures could show."""
    known = {name: estimate.features.get(name, nan) for name in ('foreseen', 'released')}
    low, middle, high = (
        capped(stated_probability({**known, 'margin': margin}), known)
        for margin in (-MAX_MARGIN, nan, MAX_MARGIN)
    )
    low = 0.0 if known['released'] == 0 else low
    text = 'by foreseen motions alone: imagined pictures of this checkpoint were never calibrated'
    return replace(
        estimate,
        probability=middle,
        interval=(low, high),
        reasons=(text, *estimate.reasons),
    )
