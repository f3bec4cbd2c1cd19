"""Silhouettes of a robot's shapes in a view."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.data_types import CameraModel, FloatArray
from mtv_world_ros.geometry.camera import camera_poses, project
from mtv_world_ros.geometry.robot import RobotModel
from mtv_world_ros.inspection.robot_shape import LinkShape

#: pixels are drawn with this many fractional bits
_SHIFT_BITS = 4
_FAR_PX = 4000


def draw_silhouettes(
    shapes: Sequence[LinkShape], camera: CameraModel, robot: RobotModel, positions: FloatArray
) -> NDArray[np.uint8]:
    """(T, H, W) 1 where the robot is in the image, for positions (T, J)."""
    poses = robot.forward_kinematics(positions)
    T_base_camera = camera_poses(camera, robot, positions)
    parts = [project_part(part, poses[part.link], camera, T_base_camera) for part in shapes]
    return fill(parts, camera)


def project_part(
    part: LinkShape, poses: FloatArray, camera: CameraModel, T_base_camera: FloatArray
) -> FloatArray:
    """(T, N, 2) pixels of its points."""
    points = np.einsum('tij,nj->tni', poses[:, :3, :3], part.points) + poses[:, None, :3, 3]
    return project(camera, T_base_camera[:, None], points)[0]


def fill(parts: Sequence[FloatArray], camera: CameraModel) -> NDArray[np.uint8]:
    """(T, H, W) the convex hulls of the parts' pixels; parts that reach behind are left out."""
    images = np.zeros((len(parts[0]), camera.height, camera.width), np.uint8)
    for part in parts:
        for image, pixels in zip(images, part, strict=True):
            if np.isfinite(pixels).all():
                fixed = np.rint(pixels.clip(-_FAR_PX, _FAR_PX) * 2**_SHIFT_BITS).astype(np.int32)
                cv2.fillConvexPoly(image, cv2.convexHull(fixed), 1, shift=_SHIFT_BITS)
    return images
