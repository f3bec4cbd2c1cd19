"""Messages of Jazzy's standard packages as typed objects and CDR bytes, without ROS installed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
import struct
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.serde import SerdeError
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

from mtv_world_ros.core.data_types import CameraModel, JointTrajectory
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.transforms import quaternion, rotation
from mtv_world_ros.data.bag.video_packets import FFMPEG_PACKET, FFMPEG_PACKET_DEFINITION

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
#: message types of a view's images
IMAGE_TYPES = (IMAGE, COMPRESSED_IMAGE, FFMPEG_PACKET)
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
JOINT_STATE = 'sensor_msgs/msg/JointState'
JOINT_TRAJECTORY = 'trajectory_msgs/msg/JointTrajectory'
STRING = 'std_msgs/msg/String'
POSE_ARRAY = 'geometry_msgs/msg/PoseArray'
POSE_STAMPED = 'geometry_msgs/msg/PoseStamped'
TF_MESSAGE = 'tf2_msgs/msg/TFMessage'
TRANSFORM_STAMPED = 'geometry_msgs/msg/TransformStamped'

#: `format` of colour images in JPEG, as image_transport writes it
JPEG = 'rgb8; jpeg compressed bgr8'
#: `format` of label images (object masks) in PNG, as image_transport writes it
PNG_LABELS = 'mono8; png compressed mono8'
#: nanoseconds in a second
NANO = 1_000_000_000
#: errors that the generated reader raises for bytes that are not a message of its type
_UNREADABLE = (
    SerdeError, struct.error, ValueError, LookupError, TypeError, ArithmeticError, MemoryError,
    AssertionError,
)  # fmt: skip
#: CameraInfo's names of the distortion models that are called otherwise here
_ROS_DISTORTION = {'none': 'plumb_bob'}


@cache
def typestore() -> Typestore:
    """Definitions of every message type that a Jazzy desktop installs, and of video packets."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(FFMPEG_PACKET_DEFINITION, FFMPEG_PACKET))
    return store


def is_standard(msgtype: str) -> bool:
    """Return True if the type belongs to a standard message package."""
    return msgtype in typestore().fielddefs


def check_type(msgtype: str) -> str:
    """Return `msgtype` if it is known.

    Raises:
        EpisodeError: the type is not among the standard message packages.
    """
    known = typestore().fielddefs
    if msgtype not in known:
        raise EpisodeError.unknown(
            'message type',
            msgtype,
            known,
            is_not=' is not one of the standard packages of Jazzy',
            most=0,
        )
    return msgtype


@cache
def definition(msgtype: str) -> str:
    """Return the type's `.msg` text and those of the types in it, as rosbag2 writes them."""
    return typestore().generate_msgdef(check_type(msgtype), ros_version=2)[0]


@cache
def type_hash(msgtype: str) -> str:
    """Return the type's RIHS01 hash."""
    return typestore().hash_rihs01(check_type(msgtype))


def serialize(msgtype: str, message: object) -> bytes:
    """Return the CDR bytes, encapsulation header included."""
    return bytes(typestore().serialize_cdr(message, check_type(msgtype)))


def deserialize(msgtype: str, data: bytes) -> Any:
    """Return the typed message of CDR bytes; surplus bytes at the end are ignored.

    Some writers record up to a few bytes more than the message has (rclpy's
    `serialize_message` does where trailing float64 sequences are empty).

    Raises:
        EpisodeError: the type is unknown or the bytes do not hold such a message.
    """
    return deserialize_as(typestore(), check_type(msgtype), msgtype, data)


def deserialize_as(store: Typestore, name: str, msgtype: str, data: bytes) -> Any:
    """Return the message of CDR bytes by a definition of a store; see `deserialize`.

    Args:
        store: definitions.
        name: name of the definition in the store.
        msgtype: recorded type, for error texts.
        data: CDR bytes with encapsulation header.
    """
    try:
        if data[:2] not in (b'\x00\x00', b'\x00\x01'):
            raise EpisodeError(f'{msgtype}: encapsulation {data[:2].hex()} is not plain CDR')
        parsed = store.get_msgdef(name)
        read = parsed.deserialize_cdr_le if data[1] else parsed.deserialize_cdr_be
        return read(memoryview(data)[4:], 0, parsed.cls, store)[0]
    except _UNREADABLE as error:
        raise EpisodeError(
            f'{len(data)} bytes do not hold a whole {msgtype} message ({error})'
        ) from error


def make(msgtype: str, **fields: Any) -> Any:
    """Return a typed message; every field must be given."""
    return typestore().types[check_type(msgtype)](**fields)


def make_header(stamp_ns: int, frame_id: str) -> Any:
    """Return the std_msgs/Header.

    Raises:
        EpisodeError: the stamp does not fit builtin_interfaces/Time.
    """
    return make('std_msgs/msg/Header', stamp=_make_time(stamp_ns, 'Time'), frame_id=frame_id)


def header_stamp(message: Any) -> int:
    """Return the header's stamp [ns]; 0 = not stamped."""
    return message.header.stamp.sec * NANO + message.header.stamp.nanosec


def _make_time(stamp_ns: int, kind: str) -> Any:
    sec, nanosec = divmod(int(stamp_ns), NANO)
    if not 0 <= sec < 2**31:
        raise EpisodeError(f'stamp {stamp_ns} ns does not fit a ROS time (0 to 2^31 s)')
    return make(f'builtin_interfaces/msg/{kind}', sec=sec, nanosec=nanosec)


def make_image(stamp_ns: int, frame_id: str, pixels: NDArray[np.uint8]) -> Any:
    """Return the sensor_msgs/Image of (H, W, 3) uint8 RGB as rgb8, or of (H, W) uint8 as mono8."""
    height, width = pixels.shape[:2]
    return make(
        IMAGE,
        header=make_header(stamp_ns, frame_id),
        height=height,
        width=width,
        encoding='rgb8' if pixels.ndim == 3 else 'mono8',
        is_bigendian=0,
        step=pixels[0].size,
        data=np.ascontiguousarray(pixels).ravel(),
    )


def make_compressed(stamp_ns: int, frame_id: str, data: bytes, layout: str = JPEG) -> Any:
    """Return the sensor_msgs/CompressedImage of a JPEG or PNG file; `layout` is its `format`."""
    header, content = make_header(stamp_ns, frame_id), np.frombuffer(data, np.uint8)
    return make(COMPRESSED_IMAGE, header=header, format=layout, data=content)


def make_camera_info(stamp_ns: int, camera: CameraModel, frame_id: str) -> Any:
    """Return the sensor_msgs/CameraInfo of a camera; R is the identity, P = [K 0]."""
    coefficients = camera.distortion if len(camera.distortion) else np.zeros(5)
    return make(
        CAMERA_INFO,
        header=make_header(stamp_ns, frame_id),
        height=camera.height,
        width=camera.width,
        distortion_model=_ROS_DISTORTION.get(camera.distortion_model, camera.distortion_model),
        d=np.array(coefficients, np.float64),
        k=np.array(camera.K, np.float64).ravel(),
        r=np.eye(3).ravel(),
        p=np.column_stack([camera.K, np.zeros(3)]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=make(
            'sensor_msgs/msg/RegionOfInterest',
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        ),
    )


def make_joint_state(
    stamp_ns: int, names: Sequence[str], positions: ArrayLike, velocities: ArrayLike | None = None
) -> Any:
    """Return the sensor_msgs/JointState; positions, velocities (J,) [rad or m, rad/s or m/s]."""
    given = {'position': positions, 'velocity': () if velocities is None else velocities}
    arrays = {key: np.array(value, np.float64) for key, value in given.items()}
    for key, array in arrays.items():
        if array.ndim != 1 or (key == 'position' or len(array)) and len(array) != len(names):
            raise EpisodeError(f'{key} has shape {array.shape}, expected ({len(names)},)')
    header = make_header(stamp_ns, '')
    return make(JOINT_STATE, header=header, name=list(names), effort=np.empty(0), **arrays)


def make_pose_array(stamp_ns: int, frame_id: str, poses: ArrayLike) -> Any:
    """Return the geometry_msgs/PoseArray of poses (O, 4, 4) in a frame."""
    items = []
    for pose in np.asarray(poses, np.float64).reshape(-1, 4, 4):
        x, y, z, w = quaternion(pose[:3, :3])
        px, py, pz = (float(v) for v in pose[:3, 3])
        items.append(
            make(
                'geometry_msgs/msg/Pose',
                position=make('geometry_msgs/msg/Point', x=px, y=py, z=pz),
                orientation=make(
                    'geometry_msgs/msg/Quaternion', x=float(x), y=float(y), z=float(z), w=float(w)
                ),
            )
        )
    return make(POSE_ARRAY, header=make_header(stamp_ns, frame_id), poses=items)


def parse_pose_array(message: Any) -> NDArray[np.float64]:
    """Return the poses (O, 4, 4) of a geometry_msgs/PoseArray."""
    return np.array([parse_pose(item) for item in message.poses]).reshape(-1, 4, 4)


def parse_pose(item: Any) -> NDArray[np.float64]:
    """Return the pose (4, 4) of a geometry_msgs/Pose.

    Raises:
        ValueError: its quaternion is zero.
    """
    p, q = item.position, item.orientation
    T = np.eye(4)
    T[:3, :3] = rotation((q.x, q.y, q.z, q.w))
    T[:3, 3] = p.x, p.y, p.z
    return T


def make_tf(stamp_ns: int, parent: str, child: str, T_parent_child: ArrayLike) -> Any:
    """Return the tf2_msgs/TFMessage with one transform."""
    return make(TF_MESSAGE, transforms=[make_transform(stamp_ns, parent, child, T_parent_child)])


def make_transform(stamp_ns: int, parent: str, child: str, T_parent_child: ArrayLike) -> Any:
    """Return a geometry_msgs/TransformStamped."""
    T = np.asarray(T_parent_child, np.float64)
    x, y, z, w = quaternion(T[:3, :3]).tolist()
    place = dict(zip('xyz', T[:3, 3].tolist(), strict=True))
    return make(
        TRANSFORM_STAMPED,
        header=make_header(stamp_ns, parent),
        child_frame_id=child,
        transform=make(
            'geometry_msgs/msg/Transform',
            translation=make('geometry_msgs/msg/Vector3', **place),
            rotation=make('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w),
        ),
    )


def make_joint_trajectory(stamp_ns: int, trajectory: JointTrajectory) -> Any:
    """Return the trajectory_msgs/JointTrajectory that starts at `stamp_ns`."""
    empty = np.empty(0)
    rates = trajectory.velocities
    points = [
        make(
            'trajectory_msgs/msg/JointTrajectoryPoint',
            positions=np.array(row, np.float64),
            velocities=empty if rates is None else np.array(rates[index], np.float64),
            accelerations=empty,
            effort=empty,
            time_from_start=_make_time(round(seconds * NANO), 'Duration'),
        )
        for index, (seconds, row) in enumerate(
            zip(trajectory.times, trajectory.positions, strict=True)
        )
    ]
    return make(
        JOINT_TRAJECTORY,
        header=make_header(stamp_ns, ''),
        joint_names=list(trajectory.joint_names),
        points=points,
    )
