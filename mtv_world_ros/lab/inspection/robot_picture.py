"""A picture of a robot: its shapes from two sides, grippers closed and open, and tool frames."""

from __future__ import annotations

import cv2
import numpy as np

from mtv_world_ros.data_types import ByteArray, CameraModel, FloatArray
from mtv_world_ros.geometry.camera import project
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.geometry.robot.shape import load_shape, project_part, RobotShape
from mtv_world_ros.geometry.transforms import looking_along

_SIZE, _FOCAL = 480, 520.0
#: colours of x, y and z axes
_AXES = ((220, 40, 40), (30, 160, 30), (40, 60, 230))
_AXIS_M = 0.08


def robot_picture(robot: RobotModel) -> ByteArray:
    """Returns (H, W, 3) RGB: front and side, above with grippers shut, below with them open."""
    shape = load_shape(robot)
    rows = []
    for share in (0.0, 1.0):
        positions = middle_positions(robot, share)
        rows.append(np.hstack([_tile(robot, shape, positions, angle) for angle in (35, 125)]))
    return np.vstack(rows)


def middle_positions(robot: RobotModel, opening: float) -> FloatArray:
    """(1, J) all joints half-way between their limits, at most a radian from zero."""
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in (robot.lower, robot.upper))
    positions = np.clip((lower + upper) / 2, -1.0, 1.0).clip(robot.lower, robot.upper)
    for tool in robot.tools:
        if tool.gripper_joint is not None:
            travel = tool.gripper_open - tool.gripper_closed
            column = robot.joint_names.index(tool.gripper_joint)
            positions[column] = tool.gripper_closed + opening * travel
    return positions[None]


def _tile(
    robot: RobotModel, shape: RobotShape, positions: FloatArray, angle_deg: float
) -> ByteArray:
    poses = robot.forward_kinematics(positions)
    points = [p.points @ poses[p.link][0, :3, :3].T + poses[p.link][0, :3, 3] for p in shape.parts]
    cloud = np.concatenate([*points, robot.tool_poses(positions)[:, 0, :3, 3]])
    camera = _camera(cloud, np.radians(angle_deg))
    image = np.full((_SIZE, _SIZE, 3), 245, np.uint8)
    depths = [float(project(camera, camera.T_mount_camera, p)[1].mean()) for p in points]
    for index in np.argsort(depths)[::-1]:
        part = shape.parts[int(index)]
        T = camera.T_mount_camera[None]
        pixels = project_part(part, poses[part.link], camera, T)[0]
        hull = cv2.convexHull(np.rint(pixels * 16).astype(np.int32))
        shade = 120 + 23 * (int(index) % 5)
        cv2.fillConvexPoly(image, hull, (shade, shade, shade + 12), cv2.LINE_AA, 4)
        cv2.polylines(image, [hull], True, (70, 70, 80), 1, cv2.LINE_AA, 4)
    for T in robot.tool_poses(positions)[:, 0]:
        _draw_axes(image, camera, T)
    return image


def _camera(cloud: FloatArray, angle: float) -> CameraModel:
    """A camera that sees all points, from a direction and slightly above."""
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    centre, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 0.05)
    ahead = -np.array([np.cos(angle), np.sin(angle), 0.45])
    T = np.eye(4)
    T[:3, :3] = looking_along(ahead)
    T[:3, 3] = centre - T[:3, 2] * radius * 2.6
    K = np.array([[_FOCAL, 0, _SIZE / 2], [0, _FOCAL, _SIZE / 2], [0, 0, 1]])
    return CameraModel(
        view='picture', width=_SIZE, height=_SIZE, K=K, mount_link='', T_mount_camera=T
    )


def _draw_axes(image: ByteArray, camera: CameraModel, T: FloatArray) -> None:
    ends = np.stack([T[:3, 3], *(T[:3, 3] + _AXIS_M * T[:3, k] for k in range(3))])
    pixels, _ = project(camera, camera.T_mount_camera, ends)
    origin, *tips = [tuple(int(v) for v in np.rint(p)) for p in pixels]
    for tip, colour in zip(tips, _AXES, strict=True):
        cv2.line(image, origin, tip, colour, 2, cv2.LINE_AA)
