"""ROS times and durations as integers of nanoseconds."""

from __future__ import annotations

from builtin_interfaces.msg import Duration, Time
from std_msgs.msg import Header

NANO = 1_000_000_000


def to_ns(stamp: Time | Duration) -> int:
    """Nanoseconds of a stamp or a duration."""
    return stamp.sec * NANO + stamp.nanosec


def to_stamp(stamp_ns: int) -> Time:
    """Stamp of nanoseconds since the epoch; they must fit a ROS time (0 to 2^31 s)."""
    sec, nanosec = divmod(stamp_ns, NANO)
    return Time(sec=sec, nanosec=nanosec)


def make_header(stamp_ns: int, frame_id: str = '') -> Header:
    """A header with this stamp and frame."""
    return Header(stamp=to_stamp(stamp_ns), frame_id=frame_id)
