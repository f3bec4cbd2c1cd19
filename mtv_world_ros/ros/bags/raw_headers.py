"""Header stamps in serialised messages (CDR), read and replaced without deserialising."""

from __future__ import annotations

from functools import cache
from importlib import import_module
import struct
from typing import Any

from mtv_world_ros.errors import EpisodeError
from mtv_world_ros.ros.messages.conversions import NANO

#: the encapsulation header comes first; the stamp is a header's first field
_OFFSET = 4
#: a message with a stamp is at least this long
MIN_STAMPED_BYTES = _OFFSET + 8


@cache
def message_class(msgtype: str) -> Any:
    """Class of a type such as `sensor_msgs/msg/Image`.

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
    """Whether a type starts with a std_msgs/Header."""
    fields = message_class(msgtype).get_fields_and_field_types()
    return next(iter(fields.values()), '') == 'std_msgs/Header'


def read_stamp(data: bytes) -> int:
    """Stamp [ns] of a serialised message that starts with a header."""
    sec, nanosec = struct.unpack_from(_layout(data), data, _OFFSET)
    return sec * NANO + nanosec


def with_stamp(data: bytes, stamp_ns: int) -> bytes:
    """The serialised message with another stamp."""
    changed = bytearray(data)
    struct.pack_into(_layout(data), changed, _OFFSET, *divmod(stamp_ns, NANO))
    return bytes(changed)


def _layout(data: bytes) -> str:
    return '<iI' if data[1] & 1 else '>iI'
