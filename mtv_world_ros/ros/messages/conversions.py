"""Joint, instruction, estimate and diagnostic messages to and from data types; stamps, headers."""

from __future__ import annotations

from array import array
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from importlib import import_module
import struct
from typing import Any

from builtin_interfaces.msg import Duration, Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
import numpy as np
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32MultiArray, Header, MultiArrayDimension, MultiArrayLayout
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMsg
from trajectory_msgs.msg import JointTrajectoryPoint

from mtv_world_ros.core.bounded_input import check_limit
from mtv_world_ros.core.data_types import FloatArray, JointTrajectory
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.joint_plans import read_plan
from mtv_world_ros.data.measured_joints import JointSample, read_sample
from mtv_world_ros.ros.messages.rejection import Reason, rejected_as, Rejection

#: the encapsulation header comes first; the stamp is a header's first field
_OFFSET = 4
#: a message with a stamp is at least this long
MIN_STAMPED_BYTES = _OFFSET + 8


@cache
def message_class(msgtype: str) -> Any:
    """Return the class of a type such as `sensor_msgs/msg/Image`.

    Raises:
        EpisodeError: its package is not installed.
    """
    package, _, name = msgtype.split('/')
    try:
        return getattr(import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError) as error:
        raise EpisodeError(f"message type '{msgtype}' is not installed") from error


@cache
def has_header(msgtype: str) -> bool:
    """Return whether a type starts with a std_msgs/Header."""
    fields = message_class(msgtype).get_fields_and_field_types()
    return next(iter(fields.values()), '') == 'std_msgs/Header'


def read_stamp(data: bytes) -> int:
    """Stamp [ns] of a serialised message that starts with a header."""
    sec, nanosec = struct.unpack_from(_layout(data), data, _OFFSET)
    return sec * NANO + nanosec


def with_stamp(data: bytes, stamp_ns: int) -> bytes:
    """Return the serialised message with another stamp."""
    changed = bytearray(data)
    struct.pack_into(_layout(data), changed, _OFFSET, *divmod(stamp_ns, NANO))
    return bytes(changed)


def _layout(data: bytes) -> str:
    return '<iI' if data[1] & 1 else '>iI'


NANO = 1_000_000_000


def to_ns(stamp: Time | Duration) -> int:
    """Return the nanoseconds of a stamp or a duration."""
    return stamp.sec * NANO + stamp.nanosec


def to_stamp(stamp_ns: int) -> Time:
    """Stamp of nanoseconds since the epoch; they must fit a ROS time (0 to 2^31 s)."""
    sec, nanosec = divmod(stamp_ns, NANO)
    return Time(sec=sec, nanosec=nanosec)


def make_header(stamp_ns: int, frame_id: str = '') -> Header:
    """Return a header with this stamp and frame."""
    return Header(stamp=to_stamp(stamp_ns), frame_id=frame_id)


def to_trajectory(message: JointTrajectoryMsg) -> JointTrajectory:
    """Return the trajectory, see `read_plan`.

    Raises:
        Rejection: the message cannot be used.
    """
    with rejected_as(Reason.TRAJECTORY_MALFORMED):
        return read_plan(message)


def to_trajectory_message(trajectory: JointTrajectory, header: Header) -> JointTrajectoryMsg:
    """Return the message of a trajectory whose times count from the header's stamp.

    Inverse of `to_trajectory`.
    """
    points = []
    for row, seconds in enumerate(trajectory.times):
        point = JointTrajectoryPoint(positions=array('d', trajectory.positions[row].tolist()))
        if trajectory.velocities is not None:
            point.velocities = array('d', trajectory.velocities[row].tolist())
        after = point.time_from_start
        after.sec, after.nanosec = divmod(round(float(seconds) * NANO), NANO)
        points.append(point)
    names = list(trajectory.joint_names)
    return JointTrajectoryMsg(header=header, joint_names=names, points=points)


def to_sample(message: JointState, joints: Collection[str] | None = None) -> JointSample:
    """Return joint positions by name, and the names of joints without a finite position.

    Args:
        message: message of one or several joints.
        joints: names of the joints that are read; None = all.

    Raises:
        Rejection: no positions, or not one a name.
    """
    if not message.position or len(message.position) != len(message.name):
        raise Rejection(
            Reason.JOINT_STATE_INVALID,
            f'the joint state has {len(message.name)} names and {len(message.position)} '
            'positions; it needs one position a name',
        )
    with rejected_as(Reason.JOINT_STATE_INVALID):
        check_limit('joint_names', len(message.name), 'the joint state')
    return read_sample(list(message.name), message.position, joints)


def check_sample(sample: JointSample) -> None:
    """Raise if a joint of the sample has no finite position.

    Raises:
        Rejection: names the joints.
    """
    if sample.faults:
        joints = '; '.join(f"joint '{name}': {why}" for name, why in sample.faults.items())
        raise Rejection(Reason.JOINT_STATE_INVALID, f'the joint state is incomplete: {joints}')


def to_positions(message: JointState) -> dict[str, float]:
    """Return position by joint name [rad or m].

    Raises:
        Rejection: no positions, not one a name, a joint twice with two positions, or not finite.
    """
    sample = to_sample(message)
    check_sample(sample)
    return sample.positions


def to_joint_state(names: Sequence[str], positions: FloatArray, header: Header) -> JointState:
    """Return the JointState of (J,) positions [rad or m]."""
    return JointState(header=header, name=list(names), position=array('d', positions.tolist()))


def to_multi_array(values: FloatArray, labels: Sequence[str]) -> Float32MultiArray:
    """Return the array as a row-major multi-array message with one label a dimension."""
    dimensions = [
        MultiArrayDimension(
            label=label, size=values.shape[axis], stride=int(np.prod(values.shape[axis:]))
        )
        for axis, label in enumerate(labels)
    ]
    data = array('f', np.ravel(values).tolist())
    return Float32MultiArray(layout=MultiArrayLayout(dim=dimensions), data=data)


def to_text(value: object) -> str:
    """Return a value as diagnostics show it: numbers short, lists joined by commas."""
    if isinstance(value, float):
        return f'{value:.6g}'
    if isinstance(value, (list, tuple)):
        return ', '.join(to_text(part) for part in value)
    return str(value).lower() if isinstance(value, bool) else str(value)


def to_status(
    name: str, hardware_id: str, level: bytes, message: str, values: Mapping[str, object]
) -> DiagnosticStatus:
    """Return a diagnostic status with every value as text."""
    return DiagnosticStatus(
        level=level,
        name=name,
        message=message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=to_text(value)) for key, value in values.items()],
    )


def values_of(status: DiagnosticStatus) -> dict[str, str]:
    """Return the key-value pairs of a status."""
    return {pair.key: pair.value for pair in status.values}
