"""Where objects go, and what their masks look like on the way.

V views, O objects, T frames, H W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mtv_world_ros.data_types import BoolArray, CameraModel, FloatArray
from mtv_world_ros.geometry.camera import project


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectMotion:
    """Rigid motions of objects from a reference on.

    Attributes:
        reference: (O, 3) where their centres were at the reference [m]; NaN = not known.
        points: (T, O, 3) where they are [m].
        rotations: (T, O, 3, 3) from the reference.
    """

    reference: FloatArray
    points: FloatArray
    rotations: FloatArray

    def __getitem__(self, frames: slice) -> ObjectMotion:
        """Returns some of the frames, with the same reference."""
        return ObjectMotion(
            reference=self.reference,
            points=self.points[frames],
            rotations=self.rotations[frames],
        )


def moved_masks(
    masks: BoolArray,
    motion: ObjectMotion,
    cameras: Sequence[CameraModel],
    reference_poses: Sequence[FloatArray],
    poses: FloatArray,
) -> BoolArray:
    """Returns the masks (V, O, T, H, W) of objects that move rigidly.

    Each mask is moved as the picture of a plane through the object's centre that faces the camera:
    shifted by the projected way, scaled by the ratio of depths, turned by the rotation about the
    line of sight. What is not known, or behind a camera, is held.

    Args:
        masks: (V, O, H, W) at the reference.
        motion: T frames.
        cameras: V cameras at the masks' size.
        reference_poses: V of T_base_camera (4, 4) at the reference.
        poses: (V, T, 4, 4) T_base_camera.
    """
    num_frames = len(motion.points)
    moved = np.repeat(masks[:, :, None], num_frames, axis=2)
    for view, camera in enumerate(cameras):
        before, depth = project(camera, reference_poses[view], motion.reference)
        after, depths = project(camera, poses[view][:, None], motion.points)
        zoom = depth / depths
        turns = _turns(motion.rotations, poses[view])
        for frame, item in zip(*np.nonzero(np.isfinite(after).all(-1)), strict=True):
            if not (np.isfinite(before[item]).all() and masks[view, item].any()):
                continue
            if np.abs(after[frame, item] - before[item]).max() < 0.05 and (
                abs(turns[frame, item]) < 0.02
            ):
                continue
            moved[view, item, frame] = _warped(
                masks[view, item],
                before[item],
                after[frame, item],
                float(zoom[frame, item]),
                float(turns[frame, item]),
            )
    return moved


def _warped(
    mask: BoolArray, before: FloatArray, after: FloatArray, zoom: float, turn: float
) -> BoolArray:
    cos, sin = zoom * np.cos(turn), zoom * np.sin(turn)
    linear = np.array([[cos, -sin], [sin, cos]])
    affine = np.column_stack([linear, after - linear @ before])
    warped = cv2.warpAffine(
        mask.astype(np.float32), affine, mask.shape[::-1], flags=cv2.INTER_LINEAR
    )
    return np.asarray(warped >= 0.5)


def _turns(rotations: FloatArray, poses: FloatArray) -> FloatArray:
    """(T, O) angles [rad] about the optical axis, positive from the image's x to its y."""
    local = np.swapaxes(poses[:, None, :3, :3], -1, -2) @ rotations @ poses[:, None, :3, :3]
    return np.arctan2(local[..., 1, 0] - local[..., 0, 1], local[..., 0, 0] + local[..., 1, 1])
