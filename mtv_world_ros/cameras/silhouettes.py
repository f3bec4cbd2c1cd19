"""Silhouettes of a robot in a view: its parts projected, cut off before the camera, filled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.cameras.camera import camera_poses, project
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.transforms import inverse
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import fill, LinkShape

#: parts of shapes nearer to the camera's plane are cut off [m]
_NEAR_M = 0.04


def draw_silhouettes(
    shapes: Sequence[LinkShape], camera: CameraModel, robot: RobotModel, positions: FloatArray
) -> NDArray[np.uint8]:
    """Return (T, H, W) 1 where the robot is in the image, for positions (T, J)."""
    poses = robot.forward_kinematics(positions)
    T_base_camera = camera_poses(camera, robot, positions)
    parts = [project_part(part, poses[part.link], camera, T_base_camera) for part in shapes]
    return fill(parts, camera)


def project_part(
    part: LinkShape, poses: FloatArray, camera: CameraModel, T_base_camera: FloatArray
) -> FloatArray:
    """Return (T, N, 2) pixels of its points.

    What reaches behind the camera is cut off before it.
    """
    T = inverse(T_base_camera) @ poses
    points = np.einsum('tij,nj->tni', T[:, :3, :3], part.points) + T[:, None, :3, 3]
    depth = points[..., 2]
    for row in np.flatnonzero((depth < _NEAR_M).any(axis=1) & (depth > _NEAR_M).any(axis=1)):
        points[row] = _before(points[row])
    return project(camera, np.eye(4), points)[0]


def project_points(parts: Sequence[FloatArray], camera: CameraModel) -> list[FloatArray]:
    """Pixels (T, N, 2) of parts given by their points (T, N, 3) in the base frame, for `fill`.

    The camera's pose is one in the base frame. What reaches behind it is cut off before it.
    """
    T = inverse(camera.T_mount_camera)
    points = np.concatenate(parts, axis=1) @ T[:3, :3].T + T[:3, 3]
    ends = np.cumsum([part.shape[1] for part in parts])[:-1]
    if (points[..., 2] < _NEAR_M).any():
        for part in np.split(points, ends, axis=1):  # views of the same memory
            near = part[..., 2] < _NEAR_M
            for row in np.flatnonzero(near.any(axis=1) & ~near.all(axis=1)):
                part[row] = _before(part[row])
    return np.split(project(camera, np.eye(4), points)[0], ends, axis=1)


def _before(points: FloatArray) -> FloatArray:
    """Points (N, 3) with those behind moved to where lines to the middle of the rest pass."""
    behind = points[:, 2] < _NEAR_M
    middle = points[~behind].mean(axis=0)
    apart = points[behind] - middle
    share = (_NEAR_M - middle[2]) / apart[:, 2:]
    moved = points.copy()
    moved[behind] = middle + share * apart
    return moved
