"""Tracks of object positions, from masks in calibrated views.

Shape letters: V views, N frames, O objects.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mtv_world_ros.cameras.mask_geometry import locate
from mtv_world_ros.core.data_types import CameraModel, FloatArray

#: rays that pass each other further away are not of one object [image width]
_APART = 0.05
#: frames whose median a place is
_WINDOW = 5
#: what is nearer to where it was stands still [m]
_STILL_M = 0.01


def track_points(
    cameras: Sequence[CameraModel], poses: FloatArray, pixels: FloatArray
) -> FloatArray:
    """Return (N, O, 3) where objects are [m], NaN = never seen by two views before or now.

    What two views do not see is on a straight way to where they see it again, or stays. What the
    views see at places that do not belong together is taken to be hidden. A visible part's middle
    differs a little from the object's: what has not gone by more stands still.

    Args:
        cameras: V cameras.
        poses: (V, N, 4, 4) T_base_camera.
        pixels: (V, N, O, 2) middles of the masks at the cameras' size, NaN = not seen.
    """
    num_frames, num_objects = pixels.shape[1:3]
    points = np.full((num_frames, num_objects, 3), np.nan)
    farthest = _APART * min(camera.width for camera in cameras)
    for frame, item in np.ndindex(num_frames, num_objects):
        found = locate(cameras, list(poses[:, frame]), pixels[:, frame, item])
        if found is not None and found.residual_px < farthest:
            points[frame, item] = found.point
    return np.stack([_steady(points[:, item]) for item in range(num_objects)], axis=1)


def _steady(points: FloatArray) -> FloatArray:
    """Return (N, 3) without gaps and jitter, of points that may be NaN."""
    seen = np.flatnonzero(np.isfinite(points).all(-1))
    result = np.full_like(points, np.nan)
    if not len(seen):
        return result
    half = _WINDOW // 2
    known = points[seen]
    smooth = np.stack(
        [np.median(known[max(0, n - half) : n + half + 1], axis=0) for n in range(len(seen))]
    )
    frames = np.arange(seen[0], len(points))
    ways = np.stack([np.interp(frames, seen, column) for column in smooth.T], axis=-1)
    held = ways[0]
    for frame, point in zip(frames, ways, strict=True):
        if np.linalg.norm(point - held) > _STILL_M:
            held = point
        result[frame] = held
    return result
