"""Messages of Foxglove's schemas, in Protobuf or as ROS 2 messages, as the standard messages.

Schemas are those of https://github.com/foxglove/foxglove-sdk (schemas/). Other Protobuf
messages are read where they have joint names, as many positions, and a stamp.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

from mcap.exceptions import McapError
from mcap.records import Schema
import numpy as np
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

from mtv_world_ros.core.bounded_input import parse_json
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.extras import needs_text
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.video_packets import FFMPEG_PACKET, is_key

_TF = 'geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n'
#: fields of the ROS 2 messages, in their order
_DEFINITIONS = {
    'CompressedVideo': 'time timestamp\nstring frame_id\nuint8[] data\nstring format\n',
    'CompressedImage': 'time timestamp\nstring frame_id\nuint8[] data\nstring format\n',
    'RawImage': 'time timestamp\nstring frame_id\nuint32 width\nuint32 height\n'
    'string encoding\nuint32 step\nuint8[] data\n',
    'CameraCalibration': 'time timestamp\nstring frame_id\nuint32 width\nuint32 height\n'
    'string distortion_model\nfloat64[] D\nfloat64[9] K\nfloat64[9] R\nfloat64[12] P\n',
    'FrameTransform': f'time timestamp\nstring parent_frame_id\nstring child_frame_id\n{_TF}',
    'FrameTransforms': 'foxglove_msgs/FrameTransform[] transforms\n',
}
_ROS_PREFIX, _PREFIX = 'foxglove_msgs/msg/', 'foxglove.'
_NAMES = ('name', 'names', 'joint_names', 'joint_name')
_POSITIONS = ('position', 'positions', 'joint_positions', 'q')
_STAMPS = ('timestamp', 'stamp', 'header', 'time')

Read = Callable[[bytes], tuple[str, bytes]]


@cache
def _store() -> Typestore:
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in _DEFINITIONS.items():
        text = text.replace('time timestamp', 'builtin_interfaces/Time timestamp')
        store.register(get_types_from_msg(text, _ROS_PREFIX + name))
    return store


def ros_reader(msgtype: str) -> Read | None:
    """Return the reader of a ROS 2 message type of Foxglove; None = it is another type."""
    name = msgtype.removeprefix(_ROS_PREFIX)
    if name == msgtype or name not in _MAKERS:
        return None

    def read(data: bytes) -> tuple[str, bytes]:
        found = messages.deserialize_as(_store(), msgtype, msgtype, data)
        return _standard(name, found)

    return read


def protobuf_reader(schema: Schema) -> Read:
    """Return the reader of Protobuf messages of a schema.

    Raises:
        EpisodeError: the schema is not read, and why.
    """
    try:
        from google.protobuf.message import DecodeError
        from mcap_protobuf.decoder import DecoderFactory
    except ImportError as error:
        raise EpisodeError(needs_text('its Protobuf', 'mcap-protobuf-support')) from error
    try:
        decode = DecoderFactory().decoder_for('protobuf', schema)
    except (McapError, DecodeError, RecursionError, LookupError, TypeError, ValueError) as error:
        raise EpisodeError(f"its Protobuf schema '{schema.name}' is damaged: {error}") from error
    name = schema.name.removeprefix(_PREFIX)
    is_known = name != schema.name and name in _MAKERS
    if decode is None or not (is_known or _joint_fields(decode(b''))):
        known = ', '.join(_PREFIX + name for name in _MAKERS)
        raise EpisodeError(
            f"its Protobuf schema '{schema.name}' is not read; read are {known}, and messages "
            'with names, positions and a stamp'
        )

    def read(data: bytes) -> tuple[str, bytes]:
        try:
            found = decode(data)
        except DecodeError as error:
            raise EpisodeError(f'{len(data)} bytes hold no {schema.name} ({error})') from error
        return _standard(name, found) if is_known else _joint_state(found)

    return read


def json_reader(schema: Schema) -> Read:
    """Return the reader of JSON messages of one of Foxglove's schemas; bytes are in base64.

    Raises:
        EpisodeError: the schema is not read.
    """
    name = schema.name.removeprefix(_PREFIX)
    if name == schema.name or name not in _MAKERS:
        known = ', '.join(_PREFIX + name for name in _MAKERS)
        raise EpisodeError(f"its JSON schema '{schema.name}' is not read; read are {known}")

    def read(data: bytes) -> tuple[str, bytes]:
        try:
            values = parse_json(data, f'a {schema.name}')
            if isinstance(values.get('data'), str):
                values['data'] = base64.b64decode(values['data'], validate=True)
            return _standard(name, _namespace(values))
        except (ValueError, AttributeError, TypeError) as error:
            raise EpisodeError(f'{len(data)} bytes hold no {schema.name} ({error})') from error

    return read


def _namespace(value: Any) -> Any:
    """Return JSON objects with their keys as attributes; stamps have sec and nanosec."""
    if isinstance(value, list):
        return [_namespace(one) for one in value]
    if not isinstance(value, dict):
        return value
    names = {'nsec': 'nanosec'}
    return SimpleNamespace(**{names.get(k, str(k)): _namespace(v) for k, v in value.items()})


def _standard(name: str, found: Any) -> tuple[str, bytes]:
    msgtype, make = _MAKERS[name]
    try:
        return msgtype, messages.serialize(msgtype, make(found))
    except (ValueError, TypeError, AssertionError, ArithmeticError, AttributeError) as error:
        raise EpisodeError(f'a foxglove {name} cannot be used: {error}') from error


def _stamp_ns(stamp: Any) -> int:
    """Return a stamp of Protobuf (seconds, nanos) or ROS 2 (sec, nanosec) [ns]."""
    seconds = stamp.seconds if hasattr(stamp, 'seconds') else stamp.sec
    nanos = stamp.nanos if hasattr(stamp, 'nanos') else stamp.nanosec
    return int(seconds) * messages.NANO + int(nanos)


def _header(found: Any) -> Any:
    return messages.make_header(_stamp_ns(found.timestamp), found.frame_id)


def _bytes(data: Any) -> Any:
    return np.frombuffer(bytes(data), np.uint8)


def _video(found: Any) -> Any:
    data = _bytes(found.data)
    return messages.make(
        FFMPEG_PACKET, header=_header(found), width=0, height=0, encoding=found.format, pts=0,
        flags=int(is_key(found.format, bytes(data))), is_bigendian=False, data=data,
    )  # fmt: skip


def _compressed(found: Any) -> Any:
    return messages.make(
        messages.COMPRESSED_IMAGE,
        header=_header(found),
        format=found.format,
        data=_bytes(found.data),
    )


def _raw(found: Any) -> Any:
    return messages.make(
        messages.IMAGE, header=_header(found), height=found.height, width=found.width,
        encoding=found.encoding, is_bigendian=0, step=found.step, data=_bytes(found.data),
    )  # fmt: skip


def _matrix(values: Any, size: int) -> Any:
    array = np.array(values, np.float64)
    return array if len(array) == size else np.zeros(size)


def _calibration(found: Any) -> Any:
    return messages.make(
        messages.CAMERA_INFO, header=_header(found), height=found.height, width=found.width,
        distortion_model=found.distortion_model, d=np.array(found.D, np.float64),
        k=_matrix(found.K, 9), r=_matrix(found.R, 9), p=_matrix(found.P, 12), binning_x=0,
        binning_y=0,
        roi=messages.make('sensor_msgs/msg/RegionOfInterest', x_offset=0, y_offset=0, height=0,
                          width=0, do_rectify=False),
    )  # fmt: skip


def _transform(found: Any) -> Any:
    p, q = found.translation, found.rotation
    make = messages.make
    return make(
        messages.TRANSFORM_STAMPED,
        header=messages.make_header(_stamp_ns(found.timestamp), found.parent_frame_id),
        child_frame_id=found.child_frame_id,
        transform=make(
            'geometry_msgs/msg/Transform',
            translation=make('geometry_msgs/msg/Vector3', x=p.x, y=p.y, z=p.z),
            rotation=make('geometry_msgs/msg/Quaternion', x=q.x, y=q.y, z=q.z, w=q.w),
        ),
    )


def _transforms(found: Any) -> Any:
    return messages.make(
        messages.TF_MESSAGE, transforms=[_transform(one) for one in found.transforms]
    )


def _joint_fields(message: Any) -> tuple[str, str, str] | None:
    """Return the fields of names, positions and stamp of a Protobuf message; None = not there."""
    fields = message.DESCRIPTOR.fields_by_name
    found = [
        next((name for name in names if name in fields), '')
        for names in (_NAMES, _POSITIONS, _STAMPS)
    ]
    if not all(found):
        return None
    names, positions, stamp = found
    numbers = (fields[positions].CPPTYPE_DOUBLE, fields[positions].CPPTYPE_FLOAT)
    fits = (
        fields[names].is_repeated
        and fields[names].cpp_type == fields[names].CPPTYPE_STRING
        and fields[positions].is_repeated
        and fields[positions].cpp_type in numbers
        and fields[stamp].message_type is not None
    )
    return (names, positions, stamp) if fits else None


def _joint_state(message: Any) -> tuple[str, bytes]:
    fields = _joint_fields(message)
    assert fields is not None
    names, positions, stamp = (getattr(message, name) for name in fields)
    stamp = getattr(stamp, 'stamp', stamp)  # of a header
    stamp = getattr(stamp, 'timestamp', stamp)
    try:
        stamp_ns = _stamp_ns(stamp)
    except AttributeError:
        stamp_ns = 0  # the time of receipt
    state = messages.make_joint_state(stamp_ns, list(names), list(positions))
    return messages.JOINT_STATE, messages.serialize(messages.JOINT_STATE, state)


_MAKERS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    'CompressedVideo': (FFMPEG_PACKET, _video),
    'CompressedImage': (messages.COMPRESSED_IMAGE, _compressed),
    'RawImage': (messages.IMAGE, _raw),
    'CameraCalibration': (messages.CAMERA_INFO, _calibration),
    'FrameTransform': (
        messages.TF_MESSAGE,
        lambda found: messages.make(messages.TF_MESSAGE, transforms=[_transform(found)]),
    ),
    'FrameTransforms': (messages.TF_MESSAGE, _transforms),
}
