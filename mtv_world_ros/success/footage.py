"""What the estimator is shown of a chunk: masks in calibrated views, and what the robot does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mtv_world_ros.data_types import BoolArray, CameraModel, FloatArray, ObjectMasks
from mtv_world_ros.geometry.camera import camera_poses
from mtv_world_ros.geometry.robot import RobotModel


@dataclass(frozen=True, slots=True, kw_only=True)
class Footage:
    """A chunk of V views, O objects, A arms and T predicted frames; row 0 is the start frame.

    Attributes:
        masks: of the T predicted frames.
        start_masks: of the frame before them (T = 1).
        cameras: V cameras at the masks' size.
        poses: (V, 1 + T, 4, 4) T_base_camera.
        tools: (A, 1 + T, 3) where the tools are commanded to be [m]; None = not known.
        openings: (A, 1 + T) of the grippers, 0 closed to 1 open; None = not known.
    """

    masks: ObjectMasks
    start_masks: ObjectMasks
    cameras: Sequence[CameraModel]
    poses: FloatArray
    tools: FloatArray | None = None
    openings: FloatArray | None = None

    @property
    def num_frames(self) -> int:
        """T."""
        return self.masks.masks.shape[2]

    def frame_masks(self, frame: int) -> BoolArray:
        """Returns (V, O, H, W) masks of a frame, 0 = the start frame."""
        return self.start_masks.masks[:, :, 0] if frame == 0 else self.masks.masks[:, :, frame - 1]

    def known(self, frame: int) -> BoolArray:
        """Returns (V, O) whether an object's mask is to be trusted and is there."""
        status = self.start_masks.status if frame == 0 else self.masks.status
        ok = np.array([[word == 'ok' for word in row] for row in status], np.bool_)
        masks = self.frame_masks(frame)
        return ok.reshape(masks.shape[:2]) & masks.any((-2, -1))


def footage_of(
    robot: RobotModel,
    cameras: Sequence[CameraModel],
    positions: FloatArray,
    start_masks: ObjectMasks,
    masks: ObjectMasks,
) -> Footage:
    """Returns the footage of a chunk at joint positions (1 + T, J), row 0 at the start masks."""
    return Footage(
        masks=masks,
        start_masks=start_masks,
        cameras=cameras,
        poses=np.stack([camera_poses(camera, robot, positions) for camera in cameras]),
        tools=robot.tool_poses(positions)[..., :3, 3],
        openings=robot.gripper_openings(positions),
    )
