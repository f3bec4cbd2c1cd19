"""Copies of bags: messages byte by byte, with their topics' types and QoS profiles."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
import shutil

from mtv_world_ros.data.bag.metadata import parse_qos
from mtv_world_ros.data.bag.reader import BagMessage, BagReader, is_storage
from mtv_world_ros.data.bag.writer import BagWriter, RESERVE_NAME

#: name of the MCAP metadata record that every writer makes anew
_ROSBAG2_RECORD = 'rosbag2'
#: ends of the files that SQLite keeps next to a bag while it is written
_SQLITE_JOURNALS = ('.db3-wal', '.db3-shm', '.db3-journal')


def write_copies(
    reader: BagReader, writer: BagWriter, copied: Iterable[BagMessage]
) -> Iterator[BagMessage]:
    """Write messages into another bag and yield each one once it is written.

    Topics of the reader's bag keep their message type, definition and QoS profile.

    Args:
        reader: bag that the topics are declared in.
        writer: bag that is made.
        copied: messages, in the order in which they are written.
    """
    declared = set()
    for message in copied:
        if message.topic not in declared:
            declared.add(message.topic)
            found = reader.declared().get(message.topic)
            if found is not None:
                msgtype, text, profiles = found
                writer.declare(message.topic, msgtype, parse_qos(profiles), text)
        writer.write_raw(
            message.topic,
            message.msgtype,
            message.stamp_ns,
            message.data,
            publish_ns=message.publish_ns,
        )
        yield message


def copy_metadata(reader: BagReader, writer: BagWriter) -> None:
    """Copy the metadata records of a bag that was read to its end."""
    for name, values in reader.metadata.items():
        if name != _ROSBAG2_RECORD:
            writer.set_metadata(name, values)


def copy_companions(source: Path, folder: Path) -> None:
    """Copy the other files of a bag's folder, such as its calibration."""
    if source.is_file():
        return
    for path in source.iterdir():
        if _is_of_bag(path):
            continue
        if path.is_dir():
            shutil.copytree(path, folder / path.name, symlinks=True)
        elif path.is_file():
            shutil.copyfile(path, folder / path.name)


def _is_of_bag(path: Path) -> bool:
    """Return whether a file holds messages or is made anew by every writer."""
    journal = path.name.endswith(_SQLITE_JOURNALS)
    return is_storage(path) or journal or path.name in ('metadata.yaml', RESERVE_NAME)
