"""Checks of the real frames that a plan starts from, after the first ones of an episode.

Frames that no longer show the scene, such as those of a covered, frozen or turned camera, are no
evidence: objects that are not seen in them did not move. The first frames of an episode are
checked by `camera_check`; each later plan is checked against what the episode began with.

Shape letters: V views, H W pixels, J joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mtv_world_ros.core.data_types import ByteArray, FloatArray, ObjectMasks, Observation
from mtv_world_ros.core.images import resize_frames
from mtv_world_ros.vision.camera_check import CameraCheck, CameraChecker, CameraFit


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameCheckSettings:
    """Settings of the check of the frames that a plan starts from.

    Attributes:
        min_contrast: standard deviation of a picture below which it is blank [grey levels].
        max_still_change: mean difference of two pictures that are the same [grey levels].
        max_frozen_change: largest difference of any pixel in pictures of a frozen camera [grey
            levels].
        min_still_s: time for which a frozen camera has shown one picture; a slow one shows each
            twice [s].
        min_joint_motion: joint motion after which two pictures of an arm differ [rad or m].
        max_offset: shift of the arm's outline since the episode began, of a camera that fitted
            then [fraction of image width].
    """

    min_contrast: float = 4.0
    max_still_change: float = 0.3
    max_frozen_change: int = 2
    min_still_s: float = 0.5
    min_joint_motion: float = 0.03
    max_offset: float = 0.03


SETTINGS = FrameCheckSettings()
_BLANK = 'shows a blank picture (contrast {:.1f} grey levels)'


def check_frames(
    observation: Observation,
    first: Observation,
    begun: CameraCheck,
    checker: CameraChecker | None,
    settings: FrameCheckSettings = SETTINGS,
) -> tuple[str, ...]:
    """Return why frames of an episode are no evidence, a reason for each such view.

    Args:
        observation: real observation that a plan starts from; its cameras are corrected as those
            of `first` are.
        first: first real observation of the episode.
        begun: check of the cameras in `first`.
        checker: compares pictures with the arm's outline; None = outlines are not compared.
        settings: thresholds.
    """
    reasons = {
        camera.view: _picture_doubt(frame, before, motion, settings)
        for camera, frame, before, motion in zip(
            observation.cameras,
            observation.frames,
            _at_size(first.frames, observation.frames),
            _motions(observation, first),
            strict=True,
        )
    }
    fitted = {fit.view for fit in begun.fits if fit.status in ('fits', 'corrected')}
    left = fitted - {view for view, reason in reasons.items() if reason}
    if checker is not None and left:
        shown = checker.shows_arm(observation)
        left -= {view for view, is_met in zip(observation.views, shown, strict=True) if is_met}
    if checker is not None and left:
        max_offset_px = settings.max_offset * observation.frames.shape[2]
        for fit in checker.check(observation).fits:
            if fit.view in left:
                reasons[fit.view] = _outline_doubt(fit, max_offset_px)
    return tuple(f"camera '{view}' {reason}" for view, reason in reasons.items() if reason)


@dataclass(frozen=True, slots=True, kw_only=True)
class StillPictures:
    """The picture of each camera, unchanged for a time, and the joint motion in that time.

    Attributes:
        frames: (V, H, W, 3) uint8 RGB, when the picture changed last.
        low: (V, J) smallest joint positions since then [rad or m].
        high: (V, J) largest ones.
        still_s: (V,) time since then [s].
    """

    frames: ByteArray
    low: FloatArray
    high: FloatArray
    still_s: FloatArray


def check_stretch(
    frames: ByteArray,
    positions: FloatArray,
    period_s: float,
    views: Sequence[str],
    before: StillPictures | None = None,
    settings: FrameCheckSettings = SETTINGS,
) -> tuple[tuple[str, ...], StillPictures]:
    """Return why frames that follow one another are no evidence, and what stood still at the end.

    A camera is frozen if it has shown one picture through all these frames, and for
    `min_still_s` or longer, while joints moved. Frames may come one at a time.

    Args:
        frames: (V, N, H, W, 3) uint8 RGB.
        positions: (N, J) measured joint positions at these frames [rad or m].
        period_s: time between two frames [s].
        views: names of the V views.
        before: what stood still at the end of the frames before these, of the same size; None =
            there were none.
        settings: thresholds.

    Returns:
        a reason for each view that is no evidence, and the pictures for the frames after these.
    """
    still = before or _shown(frames, positions, -period_s)
    has_changed_within = np.zeros(len(views), bool)
    for row, position in enumerate(positions):
        seen = frames[:, row]
        apart = np.abs(seen.astype(np.int16) - still.frames).max((1, 2, 3), initial=0)
        has_changed = apart > settings.max_frozen_change
        if row:
            has_changed_within |= has_changed
        new = has_changed[:, None]
        still = StillPictures(
            frames=np.where(new[..., None, None], seen, still.frames),
            low=np.where(new, position, np.minimum(still.low, position)),
            high=np.where(new, position, np.maximum(still.high, position)),
            still_s=np.where(has_changed, 0.0, still.still_s + period_s),
        )
    moved = (still.high - still.low).max(1, initial=0.0)
    frozen = ~has_changed_within & (moved >= settings.min_joint_motion)
    frozen &= still.still_s >= settings.min_still_s
    reasons = []
    for view, shown, is_frozen in zip(views, frames, frozen, strict=True):
        contrast = _contrast(shown[-1])
        if contrast < settings.min_contrast:
            reasons.append(f"camera '{view}' {_BLANK.format(contrast)}")
        elif is_frozen:
            reasons.append(
                f"camera '{view}' shows one picture all the time, although the arm moves"
            )
    return tuple(reasons), still


def _shown(frames: ByteArray, positions: FloatArray, still_s: float) -> StillPictures:
    """Return the first frame as what stands still from now on."""
    first = np.repeat(positions[:1], len(frames), axis=0)
    return StillPictures(
        frames=frames[:, 0], low=first, high=first, still_s=np.full(len(frames), still_s)
    )


def _contrast(frame: ByteArray) -> float:
    return float(frame.astype(np.float32).mean(-1).std())


def lost_objects(masks: ObjectMasks) -> tuple[str, ...]:
    """Return the names of objects that no view shows in the last frame of masks."""
    seen = np.atleast_1d(masks.masks[:, :, -1].any((0, 2, 3)))
    return tuple(name for name, is_seen in zip(masks.names, seen, strict=True) if not is_seen)


def frame_doubt(reasons: tuple[str, ...], lost: tuple[str, ...]) -> str:
    """Return the reason why no verdict is given from these frames; empty = there may be one."""
    names = ', '.join(f"'{name}'" for name in lost)
    unseen = f'no view shows {names} where this plan starts' if lost else ''
    return '; '.join(filter(None, [*reasons, unseen]))


def _at_size(frames: ByteArray, like: ByteArray) -> ByteArray:
    height, width = like.shape[1:3]
    if frames.shape[1:3] == (height, width):
        return frames
    return resize_frames(frames, width, height)


def _motions(observation: Observation, first: Observation) -> FloatArray:
    """Return the largest joint motion since the episode began, for each view."""
    moved = float(np.abs(observation.positions - first.positions).max(initial=0.0))
    return np.full(len(observation.cameras), moved)


def _picture_doubt(
    frame: ByteArray, before: ByteArray, motion: float, settings: FrameCheckSettings
) -> str:
    contrast = _contrast(frame)
    if contrast < settings.min_contrast:
        return _BLANK.format(contrast)
    change = float(np.abs(frame.astype(np.int16) - before).mean())
    if motion >= settings.min_joint_motion and change < settings.max_still_change:
        return 'shows the same picture as when the episode began, although the arm has moved'
    return ''


def _outline_doubt(fit: CameraFit, max_offset_px: float) -> str:
    if fit.status == 'refused' or fit.offset_px > max_offset_px:
        return 'no longer shows the arm where joint states put it'
    if fit.status == 'unchecked' and 'hardly in view' not in fit.text:
        return f'showed the arm when the episode began, and does not now ({_why(fit)})'
    return ''


def _why(fit: CameraFit) -> str:
    return fit.text.rpartition(': ')[2]
