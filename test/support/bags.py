"""Bags as a robot with its own topics would record them, written by rosbags."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray
from mtv_world_ros.core.images import encode_jpeg
from mtv_world_ros.core.transforms import inverse, quaternion
from mtv_world_ros.data.bag import messages
from mtv_world_ros.robot.model import RobotModel
from test.support.crane import FPS, JOINTS, make_cameras, render, START_NS, URDF

STORE = get_typestore(Stores.ROS2_JAZZY)
FRAMES = {'door': 'door_optical', 'palm': 'palm_optical'}
#: with which these recordings are imported
MAPPING = {
    'namespace': 'cell',
    'action': 'state',
    'joints': {f'lab_{name}': name for name in JOINTS},
    'instruction': 'wave',
}


def bag_cameras() -> dict[str, CameraModel]:
    """The cameras of these recordings."""
    return {view: camera for view, camera in make_cameras().items() if view in FRAMES}


def grey_frames(count: int) -> dict[str, ByteArray]:
    """Pictures of all views for tests that look at none."""
    return {
        view: np.full((count, camera.height, camera.width, 3), 90, np.uint8)
        for view, camera in bag_cameras().items()
    }


class Bag:
    """Writes messages of any standard type."""

    def __init__(self, path: Path, *, sqlite: bool, compression: str) -> None:
        storage = StoragePlugin.SQLITE3 if sqlite else StoragePlugin.MCAP
        self._writer = Writer(path, version=9, storage_plugin=storage)
        self._writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> Bag:
        self._writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def write(self, topic: str, kind: str, stamp_ns: int, message: Any) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=STORE)
        self._writer.write(self._connections[topic], stamp_ns, STORE.serialize_cdr(message, kind))


def transform(stamp_ns: int, parent: str, child: str, T: FloatArray) -> Any:
    """geometry_msgs/TransformStamped."""
    make = messages.make
    x, y, z, w = (float(v) for v in quaternion(T[:3, :3]))
    return make(
        'geometry_msgs/msg/TransformStamped',
        header=messages.make_header(stamp_ns, parent),
        child_frame_id=child,
        transform=make(
            'geometry_msgs/msg/Transform',
            translation=make(
                'geometry_msgs/msg/Vector3', **dict(zip('xyz', T[:3, 3].tolist(), strict=True))
            ),
            rotation=make('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w),
        ),
    )


def yuyv(rgb: ByteArray) -> ByteArray:
    """(H, 2 W) packed YUV of (H, W, 3), BT.601."""
    r, g, b = np.moveaxis(rgb.astype(float), -1, 0)
    y = 16 + (65.481 * r + 128.553 * g + 24.966 * b) / 255
    u = 128 + (-37.797 * r - 74.203 * g + 112.0 * b) / 255
    v = 128 + (112.0 * r - 93.786 * g - 18.214 * b) / 255
    packed = np.stack([y[:, ::2], u[:, ::2], y[:, 1::2], v[:, ::2]], -1)
    return packed.round().clip(0, 255).astype(np.uint8).reshape(len(rgb), -1)


def record(
    path: Path,
    robot: RobotModel,
    cameras: dict[str, CameraModel],
    positions: FloatArray,
    *,
    sqlite: bool = True,
    compression: str = 'none',
    prefix: str = 'lab_',
    urdf: str = URDF,
    frames: dict[str, ByteArray] | None = None,
    more: Callable[[Bag], None] | None = None,
    cart: FloatArray | None = None,
) -> Path:
    """A teleoperated recording in the namespace /cell: joints with a prefix, no commands.

    `door` has raw yuv422_yuy2 images and is fixed to the TF frame `ceiling`, `palm` has JPEG and
    is fixed to a TF frame on the hand that the URDF does not have. `more` writes other topics.
    With `cart` (N, 4, 4) the TF frame `ceiling` is one that moves in `plinth` by these poses.
    """
    frames = frames or {v: render(robot, c, positions) for v, c in cameras.items()}
    ceiling = np.diag([1.0, -1, -1, 1])
    ceiling[:3, 3] = 0.4, 0.1, 2.0
    adapter = np.eye(4)
    adapter[:3, 3] = 0.0, 0.03, 0.01
    with Bag(path, sqlite=sqlite, compression=compression) as bag:
        fixed = [
            transform(START_NS, 'plinth', 'ceiling', ceiling),
            transform(START_NS, 'ceiling', FRAMES['door'],
                      inverse(ceiling) @ cameras['door'].T_mount_camera),
            transform(START_NS, 'hand', 'adapter', adapter),
            transform(START_NS, 'adapter', FRAMES['palm'],
                      inverse(adapter) @ cameras['palm'].T_mount_camera),
        ]  # fmt: skip
        tf = 'tf2_msgs/msg/TFMessage'
        if cart is not None:
            del fixed[0]
        bag.write('/tf_static', tf, START_NS, messages.make(tf, transforms=fixed))
        text = messages.make(messages.STRING, data=urdf)
        bag.write('/cell/robot_description', messages.STRING, START_NS, text)
        links = robot.forward_kinematics(positions)
        for k, row in enumerate(positions):
            stamp = START_NS + round(k * 1e9 / FPS)
            _write_row(bag, stamp, prefix, robot, row)
            moving = [transform(stamp, 'plinth', 'hand', links['hand'][k])]
            if cart is not None:
                moving.append(transform(stamp, 'plinth', 'ceiling', cart[k]))
            bag.write('/tf', tf, stamp, messages.make(tf, transforms=moving))
            for view, camera in cameras.items():
                _write_view(bag, stamp, view, camera, frames[view][k])
        if more is not None:
            more(bag)
    return path


def _write_row(bag: Bag, stamp: int, prefix: str, robot: RobotModel, row: FloatArray) -> None:
    names = [prefix + name for name in robot.joint_names]
    state = messages.make_joint_state(stamp, names, row)
    bag.write('/cell/joint_states', messages.JOINT_STATE, stamp, state)


def _write_view(bag: Bag, stamp: int, view: str, camera: CameraModel, frame: ByteArray) -> None:
    header = messages.make_header(stamp, FRAMES[view])
    info = messages.make_camera_info(stamp, camera, FRAMES[view])
    bag.write(f'/cell/{view}/color/camera_info', messages.CAMERA_INFO, stamp, info)
    if view == 'palm':
        message = messages.make(
            messages.COMPRESSED_IMAGE, header=header, format='rgb8; jpeg compressed bgr8',
            data=np.frombuffer(encode_jpeg(frame, 95), np.uint8),
        )  # fmt: skip
        topic = f'/cell/{view}/color/image_raw/compressed'
        bag.write(topic, messages.COMPRESSED_IMAGE, stamp, message)
        return
    packed = yuyv(frame)
    message = messages.make(
        messages.IMAGE, header=header, height=camera.height, width=camera.width, is_bigendian=0,
        encoding='yuv422_yuy2', step=packed.shape[1], data=packed.ravel(),
    )  # fmt: skip
    bag.write(f'/cell/{view}/color/image_raw', messages.IMAGE, stamp, message)
