"""Checks of pictures against joint states that need no camera pose: frozen, still, mirrored."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.data.episode import Track
from mtv_world_ros.data_types import ByteArray, CameraModel
from mtv_world_ros.lab.inspection.clocks import JointTrack, Stamps
from mtv_world_ros.lab.inspection.inspection_report import broken, Finding, suspicious

#: mean difference of two frames below which they are the same picture [grey levels]
_SAME_PICTURE = 0.05
#: joints that move more between two frames must change the picture [rad or m]
_MOVES = 0.02
#: share of such frames without change from which a view is suspicious, broken
_FROZEN, _BROKEN = 0.1, 0.5
#: frames a second below which motions between frames are guessed
_LEAST_HZ = 2.5
#: joint states this long before the first or after the last frame [s]
_LONGEST_WITHOUT_FRAMES_S = 2.0
#: frames that are compared at most
_MOST_FRAMES = 80


def check_frozen(track: Track, joints: JointTrack) -> tuple[dict[str, str], list[Finding]]:
    """Frames that stay the same while joints move."""
    covered = np.flatnonzero(joints.covers(track.stamps_ns))
    count = min(len(covered), _MOST_FRAMES)
    if count < 3:
        return {}, []
    first = int((len(covered) - count) // 2)
    chosen = covered[first : first + count]
    positions = joints.at(track.stamps_ns[chosen])
    moves = np.abs(np.diff(positions, axis=0)).max(axis=1) > _MOVES
    if moves.sum() < 3:
        return {}, []
    frames = [np.asarray(track.frames[int(n)])[::4, ::4].astype(np.int16) for n in chosen]
    changes = np.array([np.abs(b - a).mean() for a, b in zip(frames, frames[1:], strict=False)])
    share = float((changes[moves] < _SAME_PICTURE).mean())
    measures = {'frames that do not change while joints move': f'{share:.0%}'}
    text = (
        f'{share:.0%} of the frames in which joints move are the same as the one before: the '
        'camera hangs, or this is not a view of this robot'
    )
    if share > _BROKEN:
        return measures, [broken(text)]
    return measures, [suspicious(text)] if share > _FROZEN else []


def check_lengths(stamps_ns: Stamps, joints: JointTrack) -> tuple[dict[str, str], list[Finding]]:
    """Rates too low to follow a motion, and joint states without pictures."""
    findings = []
    if len(stamps_ns) > 1:
        rate = 1e9 / float(np.median(np.diff(stamps_ns)))
        if rate < _LEAST_HZ:
            findings.append(
                suspicious(f'{rate:.2g} frames a second: {_LEAST_HZ:g} or more are needed')
            )
    ends = (joints.stamps_ns[-1] - stamps_ns[-1], stamps_ns[0] - joints.stamps_ns[0])
    longest = max(ends) * 1e-9
    if longest > _LONGEST_WITHOUT_FRAMES_S:
        where = 'after the last' if ends[0] >= ends[1] else 'before the first'
        findings.append(
            suspicious(
                f'joint states go on for {longest:.1f} s {where} frame: video and joints are of '
                'different length'
            )
        )
    return {}, findings


class MirroredFrames:
    """Frames that are mirrored left to right when asked for.

    Args:
        track: the frames.
    """

    def __init__(self, track: Track) -> None:
        self._frames = track.frames

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> ByteArray:
        return np.asarray(self._frames[index])[..., ::-1, :]

    def __array__(self, dtype: object = None, copy: bool | None = None) -> NDArray[np.uint8]:
        return np.asarray(self._frames)[..., ::-1, :]


def mirrored(track: Track, camera: CameraModel) -> tuple[Track, CameraModel]:
    """Returns a view's frames mirrored left to right, with the camera of such frames."""
    K = camera.K.copy()
    K[0, 2] = camera.width - 1 - K[0, 2]
    frames = MirroredFrames(track)
    return Track(track.stamps_ns, frames), replace(camera, K=K)  # type: ignore[arg-type]
