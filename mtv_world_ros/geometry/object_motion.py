"""Where objects go, and what they look like on the way.

V views, O objects, T frames, H W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np

from mtv_world_ros.data_types import BoolArray, ByteArray, CameraModel, FloatArray
from mtv_world_ros.geometry.camera import project
from mtv_world_ros.geometry.robot import RobotModel

#: what moved or turned by less is taken to stand still
_STILL_M, _STILL_RAD = 0.004, 0.08


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

    def moves(self) -> BoolArray:
        """Returns (T, O) whether an object is elsewhere than at first, by more than an error."""
        way = np.linalg.norm(self.points - self.reference, axis=-1)
        turned = np.einsum('toii->to', self.rotations) < 1 + 2 * np.cos(_STILL_RAD)
        return (way > _STILL_M) | turned

    def then(self, motion: ObjectMotion) -> ObjectMotion:
        """Returns both, one after the other; row 0 of the second is the last of the first."""
        return replace(
            self,
            points=np.concatenate([self.points, motion.points[1:]]),
            rotations=np.concatenate([self.rotations, motion.rotations[1:]]),
        )

    def __getitem__(self, frames: slice | np.ndarray) -> ObjectMotion:
        """Returns some of the frames, with the same reference."""
        return ObjectMotion(
            reference=self.reference,
            points=self.points[frames],
            rotations=self.rotations[frames],
        )


class TrackedObjects(Protocol):
    """Objects on their way; what one chunk hands to the next."""

    @property
    def step_s(self) -> float:
        """Time between the rows of a motion [s]."""
        ...

    @property
    def commands_a_step(self) -> int:
        """How many joint positions `advance` takes a step."""
        ...

    @property
    def sizes(self) -> FloatArray:
        """(K, O, 3) their extents in each of the motions, upright [m]."""
        ...

    def advance(self, positions: FloatArray) -> tuple[tuple[ObjectMotion, ...], TrackedObjects]:
        """Returns where they are at each of 1 + T steps, and then.

        The first motion is the expected one; the others, if any, are of places and sizes within
        the error of what the masks tell. Row 0 is where they are now.

        Args:
            positions: (1 + T * `commands_a_step`, J) that are commanded [rad or m].
        """
        ...


class ObjectMotionModel(Protocol):
    """Says where objects go under commanded joints."""

    def find(
        self, masks: BoolArray, cameras: Sequence[CameraModel], poses: Sequence[FloatArray]
    ) -> TrackedObjects:
        """Returns the objects of masks (V, O, H, W), seen by cameras at T_base_camera (4, 4)."""
        ...

    def with_robot(self, robot: RobotModel) -> ObjectMotionModel:
        """Returns the same for a robot of the same joints and tools."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundObjects:
    """The named objects as the last real frame shows them, and where they are now.

    Attributes:
        names: O of them.
        frames: (V, H, W, 3) that frame, at the model's size.
        masks: (V, O, H, W) in it.
        poses: (V, 4, 4) T_base_camera then.
        tracked: where they are now.
        motions: since that frame, `tracked.step_s` apart; the expected one first.
        positions: (N, J) joints at their rows [rad or m].
    """

    names: tuple[str, ...]
    frames: ByteArray
    masks: BoolArray
    poses: FloatArray
    tracked: TrackedObjects
    motions: tuple[ObjectMotion, ...] = ()
    positions: FloatArray | None = None

    def move(
        self,
        positions: FloatArray,
        times: FloatArray,
        cameras: Sequence[CameraModel],
        poses: FloatArray,
    ) -> tuple[ByteArray, FoundObjects]:
        """Moves the objects as the robot moves.

        Args:
            positions: (1 + T * `tracked.commands_a_step`, J) [rad or m], evenly spaced; row 0
                where the robot is now.
            times: (T,) at which they are shown, from row 0 on [s].
            cameras: V cameras at the masks' size.
            poses: (V, T, 4, 4) T_base_camera at these times.

        Returns:
            Their pictures (V, T, H, W, 4), and the objects after the last row.
        """
        motions, tracked = self.tracked.advance(positions)
        positions = positions[:: self.tracked.commands_a_step]
        rows = np.rint(times / self.tracked.step_s).astype(int)
        shown = motions[0][np.minimum(rows, len(positions) - 1)]
        pictures = moved_pictures(self.frames, self.masks, shown, cameras, self.poses, poses)
        if self.motions and self.positions is not None:
            pairs = zip(self.motions, motions, strict=True)
            motions = tuple(before.then(after) for before, after in pairs)
            positions = np.concatenate([self.positions, positions[1:]])
        return pictures, replace(self, tracked=tracked, motions=motions, positions=positions)


def moved_pictures(
    frames: ByteArray,
    masks: BoolArray,
    motion: ObjectMotion,
    cameras: Sequence[CameraModel],
    reference_poses: Sequence[FloatArray] | FloatArray,
    poses: FloatArray,
) -> ByteArray:
    """Returns the objects alone, (V, T, H, W, 4) uint8 RGB and cover, as they move rigidly.

    Each object is moved as the picture of a plane through its centre that faces the camera:
    shifted by the projected way, scaled by the ratio of depths, turned by the rotation about the
    line of sight. What has moved lies over what has not, as a thing does over the container that
    it was put into; else near ones over far ones. What is not known, or behind a camera, is held.

    Args:
        frames: (V, H, W, 3) uint8 RGB of the reference.
        masks: (V, O, H, W) in it.
        motion: T frames.
        cameras: V cameras at the masks' size.
        reference_poses: V of T_base_camera (4, 4) at the reference.
        poses: (V, T, 4, 4) T_base_camera.
    """
    num_frames = len(motion.points)
    views, _, height, width = masks.shape
    shown = np.zeros((views, num_frames, height, width, 4), np.uint8)
    moves = motion.moves()
    for view, camera in enumerate(cameras):
        before, depth = project(camera, reference_poses[view], motion.reference)
        after, depths = project(camera, poses[view][:, None], motion.points)
        turns = _turns(motion.rotations, poses[view])
        cut = [_cut_out(frames[view], mask) for mask in masks[view]]
        for frame in range(num_frames):
            for item in _from_behind(depths[frame], moves[frame]):
                picture = cut[item]
                if moves[frame, item] and np.isfinite([*after[frame, item], *before[item]]).all():
                    zoom = float(depth[item] / depths[frame, item])
                    turn = float(turns[frame, item])
                    picture = _warped(picture, before[item], after[frame, item], zoom, turn)
                _lay(shown[view, frame], picture)
    return shown


def _from_behind(depths: FloatArray, moves: BoolArray) -> list[int]:
    """Items in the order in which they are laid over each other; unknown depths count as far."""
    far = np.nan_to_num(depths, nan=np.inf)
    return sorted(range(len(far)), key=lambda item: (bool(moves[item]), -float(far[item])))


def _cut_out(frame: ByteArray, mask: BoolArray) -> ByteArray:
    """(H, W, 4) the object's colours, black elsewhere, and its mask as 0 or 255."""
    cover = np.where(mask, 255, 0).astype(np.uint8)[..., None]
    return np.concatenate([np.where(mask[..., None], frame, 0).astype(np.uint8), cover], axis=-1)


def _lay(image: ByteArray, picture: ByteArray) -> None:
    """Lays a picture, already weighed by its cover, over an (H, W, 4) image."""
    rows, columns = np.nonzero(picture[..., 3])
    if not len(rows):
        return
    box = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    part, rest = picture[box], 255 - picture[box][..., 3:].astype(np.uint16)
    image[box] = part + ((image[box] * rest + 127) // 255).astype(np.uint8)


def _warped(
    picture: ByteArray, before: FloatArray, after: FloatArray, zoom: float, turn: float
) -> ByteArray:
    cos, sin = zoom * np.cos(turn), zoom * np.sin(turn)
    linear = np.array([[cos, -sin], [sin, cos]])
    affine = np.column_stack([linear, after - linear @ before])
    size = picture.shape[1::-1]
    return cv2.warpAffine(picture, affine, size, flags=cv2.INTER_LINEAR).astype(np.uint8)


def _turns(rotations: FloatArray, poses: FloatArray) -> FloatArray:
    """(T, O) angles [rad] about the optical axis, positive from the image's x to its y."""
    local = np.swapaxes(poses[:, None, :3, :3], -1, -2) @ rotations @ poses[:, None, :3, :3]
    return np.arctan2(local[..., 1, 0] - local[..., 0, 1], local[..., 0, 0] + local[..., 1, 1])
