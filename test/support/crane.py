"""A robot, cameras and recordings that `config/` knows nothing of, drawn by its own shapes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import struct

import cv2
import numpy as np

from mtv_world_ros.cameras.camera import camera_poses, project
from mtv_world_ros.cameras.silhouettes import project_part
from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray, JointTrajectory
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import load_shape

START_NS = 1_700_000_000_000_000_000
WIDTH, HEIGHT, FPS = 320, 240, 10
JOINTS = ('yaw', 'shoulder', 'elbow', 'roll', 'nod', 'jaw_left')
YAML = """
name: crane
urdf: crane.urdf
base_link: plinth
tools:
  - {arm: arm, link: hand, position: [0, 0, 0.14], gripper_joint: jaw_left, gripper_closed: 0.0,
     gripper_open: 0.04, finger_travel_m: 0.04}
"""


def _joint(name: str, kind: str, parent: str, child: str, xyz: str, axis: str, more: str) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}"/><axis xyz="{axis}"/>{more}</joint>'
    )


def _link(name: str, xyz: str, geometry: str) -> str:
    shape = f'<origin xyz="{xyz}"/><geometry>{geometry}</geometry>'
    return f'<link name="{name}"><visual>{shape}</visual></link>'


_LIMIT = '<limit lower="{}" upper="{}" effort="1" velocity="2"/>'
#: without inertias; the root link is `world`, the base of the arm `plinth`
URDF = '\n'.join(
    [
        '<robot name="crane"><link name="world"/>',
        _link('plinth', '0 0 0.05', '<cylinder radius="0.09" length="0.1"/>'),
        _link('tower', '0 0 0.1', '<cylinder radius="0.06" length="0.2"/>'),
        _link('boom', '0 0 0.17', '<box size="0.07 0.09 0.4"/>'),
        _link('jib', '0 0 0.15', '<box size="0.06 0.07 0.34"/>'),
        _link('spool', '0 0 0.05', '<cylinder radius="0.05" length="0.1"/>'),
        _link('hand', '0 0 0.04', '<mesh filename="package://crane/meshes/hand.stl"/>'),
        _link('left', '0 0 0.03', '<box size="0.02 0.015 0.06"/>'),
        _link('right', '0 0 0.03', '<box size="0.02 0.015 0.06"/>'),
        _joint('stand', 'fixed', 'world', 'plinth', '0 0 0', '0 0 1', ''),
        _joint('yaw', 'revolute', 'plinth', 'tower', '0 0 0.1', '0 0 1', _LIMIT.format(-2.8, 2.8)),
        _joint('shoulder', 'revolute', 'tower', 'boom', '0 0 0.2', '0 1 0',
               _LIMIT.format(-1.6, 1.6)),
        _joint('elbow', 'revolute', 'boom', 'jib', '0 0 0.36', '0 1 0', _LIMIT.format(0, 2.6)),
        _joint('roll', 'continuous', 'jib', 'spool', '0 0 0.3', '0 0 1', ''),
        _joint('nod', 'revolute', 'spool', 'hand', '0 0 0.08', '0 1 0', _LIMIT.format(-2, 2)),
        _joint('jaw_left', 'prismatic', 'hand', 'left', '0 0 0.08', '0 1 0',
               _LIMIT.format(0, 0.04)),
        _joint('jaw_right', 'prismatic', 'hand', 'right', '0 0 0.08', '0 -1 0',
               _LIMIT.format(0, 0.04) + '<mimic joint="jaw_left"/>'),
        '</robot>',
    ]
)  # fmt: skip


def write_robot(folder: Path) -> Path:
    """Write `crane.yaml`, its URDF and its one mesh; return the YAML."""
    (folder / 'crane' / 'meshes').mkdir(parents=True, exist_ok=True)
    write_cuboid(folder / 'crane' / 'meshes' / 'hand.stl', np.array([0.05, 0.12, 0.08]))
    (folder / 'crane' / 'crane.urdf').write_text(URDF)
    (folder / 'crane' / 'crane.yaml').write_text(YAML)
    return folder / 'crane' / 'crane.yaml'


def write_cuboid(path: Path, size: FloatArray) -> None:
    """A binary STL of 12 triangles round the origin."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size / 2
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
             (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]  # fmt: skip
    rows = [struct.pack('<12fH', 0, 0, 0, *corners[list(face)].ravel(), 0) for face in faces]
    path.write_bytes(bytes(80) + struct.pack('<I', len(rows)) + b''.join(rows))


def looking_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> FloatArray:
    """T_base_camera (4, 4) of an upright camera at a place that looks at another."""
    T = np.eye(4)
    ahead = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(ahead, (0, 0, 1.0))
    right /= np.linalg.norm(right)
    T[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    T[:3, 3] = eye
    return T


def make_cameras() -> dict[str, CameraModel]:
    """Two fixed cameras and one on the hand."""
    K = np.array([[300.0, 0, 158.5], [0, 300, 121.5], [0, 0, 1]])
    poses = {
        'door': ('plinth', looking_at((1.5, 0.5, 0.9), (0.1, 0.0, 0.4))),
        'window': ('plinth', looking_at((0.3, -1.6, 0.7), (0.1, 0.0, 0.4))),
        'palm': ('hand', looking_at((0.09, 0.0, -0.02), (0.0, 0.0, 0.2))),
    }
    return {
        view: CameraModel(
            view=view, width=WIDTH, height=HEIGHT, K=K, mount_link=link, T_mount_camera=T
        )
        for view, (link, T) in poses.items()
    }


def make_positions(
    seconds: float = 8.0, seed: int = 0, fps: float = FPS, speed: float = 1.0
) -> FloatArray:
    """(T, 6) smooth motion of all joints within their limits."""
    generator = np.random.default_rng(seed)
    t = np.arange(round(seconds * fps)) / fps
    middle = np.array([0.2, 0.3, 1.1, 0.0, 0.6, 0.02])
    reach = np.array([0.9, 0.45, 0.6, 0.8, 0.5, 0.018])
    rate = speed * generator.uniform(0.9, 1.6, 6)
    start = generator.uniform(0, 2 * np.pi, 6)
    return middle + reach * np.sin(rate * t[:, None] + start)


def render(robot: RobotModel, camera: CameraModel, positions: FloatArray) -> ByteArray:
    """(T, H, W, 3) the robot, link by link, before a textured floor and wall."""
    shape = load_shape(robot)
    poses = robot.forward_kinematics(positions)
    T_base_camera = camera_poses(camera, robot, positions)
    frames = np.stack([_background(camera, T) for T in T_base_camera])
    for t, frame in enumerate(frames):
        far_first = sorted(
            shape.parts,
            key=lambda part: -np.linalg.norm(poses[part.link][t, :3, 3] - T_base_camera[t, :3, 3]),
        )
        for part in far_first:
            pixels = project_part(
                part, poses[part.link][t : t + 1], camera, T_base_camera[t : t + 1]
            )[0]
            if np.isfinite(pixels).all():
                shade = 40 + 45 * (sorted(poses).index(part.link) % 5)
                hull = cv2.convexHull(np.rint(pixels * 8).astype(np.int32))
                cv2.fillConvexPoly(frame, hull, (shade, shade - 20, 30), cv2.LINE_AA, 3)
    return frames


def _background(camera: CameraModel, T_base_camera: FloatArray) -> ByteArray:
    """A room of coloured tiles, seen by rays."""
    rows, columns = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(camera.K).T
    rays = rays @ T_base_camera[:3, :3].T
    low, high = np.array([-2.5, -2.5, -0.01]), np.array([2.5, 2.5, 3.0])
    with np.errstate(divide='ignore'):
        ways = (np.where(rays > 0, high, low) - T_base_camera[:3, 3]) / rays
    at = T_base_camera[:3, 3] + ways.min(axis=-1, keepdims=True) * rays
    tiles = np.floor((at + 0.013) / 0.17).astype(np.int64)
    code = (tiles[..., 0] * 73_856_093) ^ (tiles[..., 1] * 19_349_663) ^ (tiles[..., 2] * 83_492_7)
    return np.stack([90 + (code >> shift) % 100 for shift in (0, 3, 7)], -1).astype(np.uint8)


def write_episode(
    path: Path,
    robot: RobotModel,
    cameras: dict[str, CameraModel],
    positions: FloatArray,
    *,
    recorded_as: dict[str, CameraModel] | None = None,
) -> Path:
    """Record what the cameras see; `recorded_as` is the calibration that is written."""
    written = recorded_as or cameras
    frames = {view: render(robot, camera, positions) for view, camera in cameras.items()}
    with EpisodeWriter(
        path, task='', instruction='move', robot=robot.name, cameras=list(written.values())
    ) as writer:
        stamps = [START_NS + round(k * 1e9 / FPS) for k in range(len(positions))]
        times = np.arange(1, len(positions)) / FPS
        writer.write_trajectory(
            stamps[0],
            JointTrajectory(joint_names=robot.joint_names, times=times, positions=positions[1:]),
        )
        writer.write_instruction(stamps[0])
        for k, stamp in enumerate(stamps):
            writer.write_joint_states(stamp, robot.joint_names, positions[k])
            for view, camera in written.items():
                writer.write_camera_info(view, stamp, camera)
                writer.write_image(view, stamp, frames[view][k])
    return path


def tilted(camera: CameraModel, degrees: float, axis: int) -> CameraModel:
    """The camera turned about an axis of its own."""
    turn = np.eye(4)
    a, b = [k for k in range(3) if k != axis]
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn[a, a] = turn[b, b] = c
    turn[a, b], turn[b, a] = -s, s
    return replace(camera, T_mount_camera=camera.T_mount_camera @ turn)


def load(folder: Path) -> RobotModel:
    """Write the robot and load it."""
    return load_robot(write_robot(folder))


def tool_pixels(robot: RobotModel, camera: CameraModel, positions: FloatArray) -> FloatArray:
    """(T, 2) where the tool point is seen."""
    points = robot.tool_poses(positions)[0, :, :3, 3]
    return project(camera, camera_poses(camera, robot, positions), points)[0]
