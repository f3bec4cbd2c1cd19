"""Messages of ROS 1 bags (`.bag`, version 2.0), as the ROS 2 messages of the same names."""

from __future__ import annotations

import bz2
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
import struct
from typing import Any

import lz4.frame
from rosbags.convert.converter import migrate_message
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import Compression, decompressors
from rosbags.serde import SerdeError
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.command_messages import (
    ACTION_GOAL,
    command_store,
    CONTROLLER_STATE,
    own_name,
)

MAGIC = b'#ROSBAG V'
#: names that types had before they were moved
_RENAMED = {'tf/msg/tfMessage': messages.TF_MESSAGE}
#: types that Noetic's standard packages do not have, as far as they are read
_FURTHER = {
    messages.TF_MESSAGE: 'geometry_msgs/TransformStamped[] transforms\n',
    CONTROLLER_STATE: """std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint reference
""",
    ACTION_GOAL: """std_msgs/Header header
time goal_stamp
string goal_id
trajectory_msgs/JointTrajectory trajectory
""",
}
#: types whose whole definition is not known here, so that their checksum is not compared
_BEGINNINGS = (CONTROLLER_STATE, ACTION_GOAL)
_UNREADABLE = (
    ReaderError, SerdeError, struct.error, ValueError, LookupError, TypeError, ArithmeticError,
    MemoryError, AssertionError, AttributeError, EOFError, RuntimeError,
)  # fmt: skip


class Ros1Error(Exception):
    """A bag cannot be read further."""


@cache
def _noetic() -> Typestore:
    store = get_typestore(Stores.ROS1_NOETIC)
    for msgtype, text in _FURTHER.items():
        store.register(get_types_from_msg(text, msgtype))
    return store


@contextmanager
def _opened(path: Path, most_bytes: int) -> Iterator[Reader]:
    """Open a bag whose chunks hold a limited number of bytes once they are inflated.

    Raises:
        Ros1Error: it is damaged, has no index, or a chunk is larger.
    """
    reader = Reader(path)
    try:
        reader.open()
    except _UNREADABLE as error:
        remedy = '; rosbag reindex FILE makes one' if 'not indexed' in str(error) else ''
        raise Ros1Error(f'{error}{remedy}') from error
    try:
        for position, chunk in reader.chunks.items():
            if chunk.datasize > most_bytes:
                raise Ros1Error(f'a chunk has {chunk.datasize} bytes, at most {most_bytes}')
            inflate = _bounded(chunk.decompressor, most_bytes)
            reader.chunks[position] = chunk._replace(decompressor=inflate)
        yield reader
    finally:
        reader.close()


def _bounded(inflate: Callable[[bytes], bytes], most: int) -> Callable[[bytes], bytes]:
    """Return a decompressor that stops at a number of bytes."""
    makers: dict[Any, Callable[[], Any]] = {
        decompressors[Compression.BZ2.value]: bz2.BZ2Decompressor,
        decompressors[Compression.LZ4.value]: lz4.frame.LZ4FrameDecompressor,
    }
    if inflate not in makers:
        return inflate

    def bounded(data: bytes) -> bytes:
        found = makers[inflate]().decompress(data, max_length=most + 1)
        if len(found) > most:
            raise Ros1Error(f'a chunk has more than {most} bytes')
        return found

    return bounded


class Ros1Bag:
    """Reader of one file.

    Args:
        path: the file.
        most_bytes: maximum size of a chunk once it is inflated [bytes].
        problem: gets a line for each topic that is left out, and why.
    """

    def __init__(self, path: Path, most_bytes: int, problem: Callable[[str], None]) -> None:
        self._path, self._most_bytes, self._problem = path, most_bytes, problem
        self._plans: dict[str, object] = {}

    def messages(self, topics: Collection[str] | None) -> Iterator[tuple[str, str, int, bytes]]:
        """Yield topic, ROS 2 type, receive time [ns] and CDR bytes, in the order of the times.

        Raises:
            Ros1Error: the file is damaged from here on.
        """
        with _opened(self._path, self._most_bytes) as reader:
            wanted = [one for one in reader.connections if topics is None or one.topic in topics]
            readable = [one for one in wanted if self._is_readable(one)]
            if not readable:
                return
            try:
                for connection, stamp_ns, data in reader.messages(readable):
                    msgtype = _RENAMED.get(connection.msgtype, connection.msgtype)
                    yield connection.topic, msgtype, stamp_ns, self._as_cdr(msgtype, data)
            except _UNREADABLE as error:
                raise Ros1Error(str(error)) from error

    def _is_readable(self, connection: Connection) -> bool:
        """Return whether messages can be read; name the topic if not."""
        msgtype = _RENAMED.get(connection.msgtype, connection.msgtype)
        if msgtype not in _noetic().fielddefs or not (
            msgtype in _BEGINNINGS or messages.is_standard(msgtype)
        ):
            self._problem(f"'{connection.topic}' was left out: {msgtype} of ROS 1 is not read")
            return False
        if msgtype in _BEGINNINGS:
            return True
        digest = _noetic().generate_msgdef(msgtype, ros_version=1)[1]
        if connection.digest not in ('*', digest):
            self._problem(
                f"'{connection.topic}' was left out: its {msgtype} is not Noetic's (checksum "
                f'{connection.digest}, not {digest})'
            )
            return False
        return True

    def _as_cdr(self, msgtype: str, data: bytes) -> bytes:
        source = _noetic()
        is_beginning = msgtype in _BEGINNINGS
        target = command_store() if is_beginning else messages.typestore()
        name = own_name(msgtype) if is_beginning else msgtype
        definition = source.get_msgdef(msgtype)
        found, _ = definition.deserialize_ros1(memoryview(data), 0, definition.cls, source)
        migrated = migrate_message(source, target, msgtype, name, self._plans, found)
        return bytes(target.serialize_cdr(migrated, name))
