"""Doubts about an estimate that pictures do not show: wrong cameras, another physics."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isfinite, log, nan

import numpy as np

from mtv_world_ros.core.data_types import BoolArray, FloatArray, SuccessEstimate
from mtv_world_ros.success.trust import not_fitted_here, with_trust, without_verdict

#: an object nearer than this to one of its futures moved as foreseen [m]; masks of small pictures
#: are no more exact
NEAR_M = 0.035
#: minimum object motion for evidence about contact [m]
_MIN_MOTION_M = 0.03


@dataclass(frozen=True, slots=True)
class WatchSettings:
    """Settings of the sequential test of the fitted physics.

    Attributes:
        max_unforeseen_fraction: largest fraction of comparisons with an unforeseen end under the
            fitted physics.
        other_unforeseen_fraction: fraction under another physics, for which the test is fastest.
        run_length: mean number of comparisons to a false alarm is at least this.
    """

    max_unforeseen_fraction: float = 0.05
    other_unforeseen_fraction: float = 0.4
    run_length: int = 200


WATCH = WatchSettings()
SAYS = 'the physics here is not the one that was fitted'


@dataclass(frozen=True, slots=True, kw_only=True)
class ChunkEnd:
    """End of an executed chunk, compared with its futures.

    Attributes:
        away_m: distance of the real motion from the nearest future [m], the largest over the
            objects that moved; NaN = none that moved was seen.
        moved: (O,) objects that moved in a future or in the masks.
        lost: (O,) objects that moved and whose motion the masks do not show.
        hidden: (O,) objects that the masks do not show at the end.
    """

    away_m: float
    moved: BoolArray
    lost: BoolArray
    hidden: BoolArray


def chunk_end(foreseen: FloatArray, real: FloatArray) -> ChunkEnd:
    """Return how a chunk ended.

    Args:
        foreseen: (K, 1 + T, O, 3) centres of objects from a chunk's start on [m].
        real: (1 + T, O, 3) positions that masks show [m], NaN = not known.
    """
    ahead = foreseen[:, -1] - foreseen[:, 0]
    came = real[-1] - real[0]
    gaps = np.linalg.norm(ahead - came, axis=-1)
    known = np.isfinite(gaps).all(0)
    longest = np.nan_to_num(np.linalg.norm(ahead, axis=-1)).max(0, initial=0.0)
    moved = np.maximum(longest, np.nan_to_num(np.linalg.norm(came, axis=-1))) > _MIN_MOTION_M
    counts = known & moved
    return ChunkEnd(
        away_m=float(gaps.min(0)[counts].max()) if counts.any() else nan,
        moved=moved,
        lost=moved & ~known,
        hidden=~np.isfinite(real[-1]).all(-1),
    )


def unforeseen(foreseen: FloatArray, real: FloatArray) -> float:
    """Return the distance of the real motion from the nearest future [m]; NaN = nothing moved.

    See `chunk_end`.
    """
    return chunk_end(foreseen, real).away_m


class PhysicsWatch:
    """Sequential test whether executed chunks end as simulated, over all rollouts.

    A cumulative sum of e-values (CUSUM; Shin, Ramdas and Rinaldo, "E-detectors", 2022): each
    comparison multiplies the evidence by the ratio of its likelihoods under another and under the
    fitted physics, never below 1. If at most `max_unforeseen_fraction` of comparisons end
    unforeseen under the fitted physics, a false alarm comes after `run_length` comparisons or more
    in the mean. After an unforeseen end, the rest of a rollout does not count: it follows from it.
    """

    _log_evidence: float
    _is_alarm: bool
    _num_compared: int
    _num_unforeseen: int
    _diverged: int | None

    def __init__(self) -> None:
        self.forget()

    def take(self, away_m: float, rollout: int) -> None:
        """Add the end of a chunk.

        Args:
            away_m: distance from the nearest future [m]; NaN = no evidence.
            rollout: number of the rollout.
        """
        if not np.isfinite(away_m) or rollout == self._diverged:
            return
        is_unforeseen = bool(away_m > NEAR_M)
        if is_unforeseen:
            self._diverged = rollout
        self._num_compared += 1
        self._num_unforeseen += is_unforeseen
        fitted, other = WATCH.max_unforeseen_fraction, WATCH.other_unforeseen_fraction
        ratio = other / fitted if is_unforeseen else (1 - other) / (1 - fitted)
        limit = log(WATCH.run_length)
        self._log_evidence = min(max(self._log_evidence + log(ratio), 0.0), limit)
        if self._log_evidence == limit:
            self._is_alarm = True
        elif self._log_evidence == 0.0:
            self._is_alarm = False

    def forget(self) -> None:
        """Begin anew: another task, or another fit."""
        self._log_evidence, self._is_alarm = 0.0, False
        self._num_compared = self._num_unforeseen = 0
        self._diverged = None

    @property
    def doubt(self) -> str:
        """Reason why the fitted physics does not hold here; empty if it holds."""
        if not self._is_alarm:
            return ''
        return (
            f'{SAYS}: {self._num_unforeseen} of {self._num_compared} executed chunks in which an '
            'object moved ended where no future foresaw it; run mtv-world fit contact on '
            'recordings of this place'
        )

    @property
    def text(self) -> str:
        """Text for `/diagnostics`."""
        of = self._num_compared
        return self.doubt or (
            f'as it was fitted, by {of} executed chunks' if of else 'not compared yet'
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactTrust:
    """Trust in contact parameters that were fitted in another robot cell.

    Attributes:
        is_confirmed: whether executed plans confirmed them in this robot cell, for this task.
        text: evidence for the reader of an estimate; empty = nothing was compared.
    """

    is_confirmed: bool = False
    text: str = ''


#: shrinkage of a doubted estimate towards 0.5 [fraction of its distance from 0.5]
_SHRINKAGE = 0.5
#: minimum half width of the interval of a doubted estimate
_MIN_HALF_WIDTH = 0.35


def shrunk(probability: float, interval: tuple[float, float]) -> tuple[float, tuple[float, float]]:
    """Return a probability nearer to 0.5, and a wider interval."""
    middle = 0.5 + (1 - _SHRINKAGE) * (probability - 0.5)
    low, high = interval
    return middle, (
        max(min(low, middle - _MIN_HALF_WIDTH), 0.0),
        min(max(high, middle + _MIN_HALF_WIDTH), 1.0),
    )


def widened(estimate: SuccessEstimate, doubt: str) -> SuccessEstimate:
    """Return a less certain estimate, for foreseen motions under a doubtful physics.

    Args:
        estimate: estimate under the fitted physics.
        doubt: reason why the fitted physics does not hold.
    """
    if not isfinite(estimate.probability):
        return replace(estimate, reasons=(*estimate.reasons, doubt))
    middle, interval = shrunk(estimate.probability, estimate.interval)
    return replace(
        estimate,
        probability=middle,
        interval=interval,
        reasons=with_trust(estimate.reasons, not_fitted_here(doubt)),
        is_calibrated=False,
    )


#: commands that calibrate an estimate
_CALIBRATE = 'mtv-world fit success CHECKPOINT EPISODES on episodes of known outcome'
_FIT = (
    'mtv-world fit contact RECORDINGS --checkpoint CHECKPOINT on recordings of this robot in '
    'which fingers stop at objects, held and not held'
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Grounds:
    """Basis of an uncalibrated estimate from imagined frames.

    Attributes:
        foreseen: reason why no verdict rests on foreseen motions, e.g. guessed contact parameters;
            empty = none.
        pictures: reason why no verdict rests on imagined frames alone; empty = none.
    """

    foreseen: str = ''
    pictures: str = ''

    @classmethod
    def of(cls, contact: str, is_calibrated: bool) -> Grounds:
        """Return the grounds of a checkpoint.

        Args:
            contact: doubt about the contact parameters; empty = there is none.
            is_calibrated: whether it has a calibration, of whatever task and robot.
        """
        never = '' if is_calibrated else 'the estimate was never calibrated for this checkpoint'
        return cls(
            foreseen=contact
            and f'{contact}, and the estimate was not fitted here: run {_FIT}, or {_CALIBRATE}',
            pictures=never and f'{never}, and no motion is foreseen: run {_CALIBRATE}, or {_FIT}',
        )

    def bear(self, estimate: SuccessEstimate) -> SuccessEstimate:
        """Return an estimate of imagined frames, or an abstention if it rests on nothing."""
        if estimate.is_calibrated or not isfinite(estimate.probability):
            return estimate
        is_foreseen = isfinite(estimate.features.get('foreseen', nan))
        refusal = self.foreseen if is_foreseen else self.pictures
        if not refusal:
            return estimate
        low, high = estimate.interval
        without = f'without this doubt {estimate.probability:.2f} [{low:.2f}, {high:.2f}]'
        return without_verdict(estimate, f'{refusal}; {without}')
