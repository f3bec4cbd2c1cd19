"""Sizes of serialised messages, checked before they are decoded.

Decoding makes a Python object of every nested message, 6 to 9 microseconds each, so that a small
message can cost seconds. Numbers and images are copied in one piece.
"""

from __future__ import annotations

import struct

from mtv_world_ros.core.bounded_input import check_limit
from mtv_world_ros.data.bag.messages import COMPRESSED_IMAGE, IMAGE, JOINT_TRAJECTORY
from mtv_world_ros.data.bag.video_packets import FFMPEG_PACKET

#: fields of `Limits` by message type; other messages are small
_LIMITS = {
    IMAGE: 'chunk_bytes',
    COMPRESSED_IMAGE: 'image_bytes',
    FFMPEG_PACKET: 'image_bytes',
    JOINT_TRAJECTORY: 'plan_bytes',
}
#: encapsulation header of CDR, then the stamp of a header [bytes]
_ENCAPSULATION, _STAMP = 4, 8


def check_size(msgtype: str, data: bytes, limit: str = '') -> None:
    """Check the size of a serialised message, and of a plan the joints and points that it states.

    Args:
        msgtype: type of the message, e.g. `sensor_msgs/msg/Image`.
        data: CDR bytes with encapsulation header.
        limit: field of `Limits`; empty = that of the type.

    Raises:
        LimitError: it is larger than allowed.
    """
    name = msgtype.rpartition('/')[2]
    check_limit(limit or _LIMITS.get(msgtype, 'message_bytes'), len(data), f'the {name}')
    if msgtype == JOINT_TRAJECTORY:
        joints, points = _plan_counts(data)
        check_limit('joint_names', joints, 'the trajectory')
        check_limit('trajectory_points', points, 'the trajectory')


def _plan_counts(data: bytes) -> tuple[int, int]:
    """Return the joint names and points that a plan states; 0 where the bytes end before."""
    read = struct.Struct('<I' if data[1:2] == b'\x01' else '>I').unpack_from
    try:
        at = _after_text(data, _ENCAPSULATION + _STAMP, read)  # the frame
        (joints,) = read(data, at)
        at += 4
        if joints <= len(data) // 4:
            for _ in range(joints):
                at = _after_text(data, at, read)
            (points,) = read(data, at)
            return joints, points
    except struct.error:  # the decoder names what is missing
        return 0, 0
    return joints, 0


def _after_text(data: bytes, at: int, read: object) -> int:
    """Return the aligned position after a text."""
    (length,) = read(data, at)  # type: ignore[operator]
    return at + 4 + (length + 3) // 4 * 4
