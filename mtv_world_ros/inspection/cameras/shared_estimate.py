"""Estimated cameras of one view in several recordings: stated errors, doubts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2
from scipy.stats import f as f_distribution

from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.inspection.cameras.seen_points import SeenPoint
from mtv_world_ros.inspection.motion_residual import MotionResidual
from mtv_world_ros.inspection.places import CameraPlaces

#: distance of drawn and seen robot above which a pose is reported as doubtful [fraction of image
#: width]
_DOUBTED = 0.02
#: minimum correlation of drawn and seen motion of a pose that is not doubtful: on ten real
#: recordings a view with the right focal length had .35 to .47, and .23 to .32 with one a
#: third too long; another view had .37 to .56 with any of three focal lengths
_LEAST_MATCH = 0.335


def expected_within(apart_px: FloatArray) -> float:
    """Return the distance from where it is within which 95 % of tool points are drawn [px].

    NaN = not known.

    Args:
        apart_px: (N,) distances of points that were not fitted to, taken for normal in x and y
            [px].
    """
    count = len(apart_px)
    if not count:
        return np.nan
    return float(np.sqrt(np.mean(apart_px**2) * f_distribution.ppf(0.95, 2, 2 * count)))


def stated_error(apart_px: FloatArray) -> float | None:
    """Return the standard error in x and in y of where points are drawn [px]; None = not known.

    95 % of points are within `expected_within` with this error.
    """
    within = expected_within(apart_px)
    return float(within / np.sqrt(chi2.ppf(0.95, 2))) if within > 0 else None


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedEstimate:
    """Estimated camera poses of one view in several recordings.

    Attributes:
        cameras: cameras of each recording, (R,).
        places: numbers of the places, for recordings that share one.
        measures: offset of the moving pixels from the robot in each recording, as `check` measures
            it.
        guess_measures: such offsets under the camera poses that the user guessed; empty without a
            guess.
        kept_guess: whether the guess fits better and is what `cameras` has.
        focal_px: focal length, estimated or given [px].
        bent: whether the lens' k1 was estimated, too.
        fits: (R,) correlation of drawn and seen changes of each recording.
        apart_px: (N,) distances between drawn and seen tool points [px]: those left out of a first
            fit, from that fit; the last one from the fit to all points.
        strays: seen points that contradict the others, and their distances from where they are
            drawn [px].
    """

    cameras: tuple[CameraModel, ...]
    places: CameraPlaces
    measures: tuple[MotionResidual, ...]
    guess_measures: tuple[MotionResidual, ...]
    kept_guess: bool
    focal_px: float
    bent: bool
    fits: FloatArray
    apart_px: FloatArray
    strays: tuple[tuple[SeenPoint, float], ...]

    @property
    def within_px(self) -> float:
        """`expected_within` of the seen points that were left out [px]."""
        return expected_within(self.apart_px)

    def doubts(self, number: int) -> str:
        """Return the reason why the pose of a recording may be wrong; empty if there is none."""
        measure = self.measures[number]
        if measure.reason:
            return f'not checked: {measure.reason}'
        if measure.match_here < _LEAST_MATCH:
            return (
                f'drawn and seen motion correlate by {measure.match_here:.2f}, below '
                f'{_LEAST_MATCH:g}: pose or focal length may be wrong'
            )
        if self._is_beside(number):
            apart = float(np.hypot(*measure.shift_px)) / self.cameras[number].width
            return f'the robot moves {apart:.1%} of the width beside where it is drawn'
        return ''

    def objection(self, number: int) -> str:
        """Return the reason why the pose of a recording is not to be relied on; empty = it is.

        A pose that a recording could not check, or with too little correlation to rely on, is
        good if another recording of the same place confirms it; not where the robot is seen to
        move beside where it is drawn.
        """
        doubt = self.doubts(number)
        if doubt and self.confirming(number):
            return ''
        return doubt

    def confirming(self, number: int) -> tuple[int, ...]:
        """Return the recordings that confirm the pose of another recording of their place.

        None do where that recording contradicts them.
        """
        if self._is_beside(number):
            return ()
        same = np.flatnonzero(self.places.place == self.places.place[number])
        return tuple(int(n) for n in same if n != number and not self.doubts(int(n)))

    def _is_beside(self, number: int) -> bool:
        """Return whether the robot moves beside where it is drawn."""
        measure = self.measures[number]
        if measure.reason:
            return False
        apart = float(np.hypot(*measure.shift_px)) / self.cameras[number].width
        return apart > _DOUBTED and measure.match > 1.05 * measure.match_here
