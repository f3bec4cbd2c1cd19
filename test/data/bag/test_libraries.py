"""What rosbags and mcap lose of bags that the own reader and writer keep.

Where one of these tests fails, a library has learned it, and own code of `data/bag` can go.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing
import io
from pathlib import Path
import shutil
import sqlite3
import struct

from mcap.exceptions import McapError
from mcap.records import Message
from mcap.stream_reader import StreamReader
import numpy as np
import pytest
from rosbags.rosbag2 import ReaderError, StoragePlugin, Writer
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.bag.writer import BagWriter

TOPIC, NUM = '/text', 400


def text(number: int) -> bytes:
    """A message that hardly gets smaller by compression."""
    data = np.random.default_rng(number).bytes(1000).hex()
    return messages.serialize(messages.STRING, messages.make(messages.STRING, data=data))


def sqlite_bag(folder: Path, stamps: Iterable[int]) -> Path:
    """A bag of rosbags' own writer."""
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        typestore = messages.typestore()
        channel = writer.add_connection(TOPIC, messages.STRING, typestore=typestore)
        for stamp in stamps:
            writer.write(channel, stamp, text(stamp))
    return next(folder.glob('*.db3'))


def mcap_bag(folder: Path) -> Path:
    with BagWriter(folder) as writer:
        for stamp in range(NUM):
            writer.write_raw(TOPIC, messages.STRING, stamp, text(stamp))
    return next(folder.glob('*.mcap'))


def own(path: Path) -> list[int]:
    return [message.stamp_ns for message in BagReader(path).messages()]


def by_rosbags(path: Path) -> list[int]:
    reader = Sqlite3Reader(path)
    reader.open()
    with closing(reader):
        return [stamp for _, stamp, _ in reader.messages(reader.connections)]


def by_mcap(path: Path) -> list[int]:
    """Log times of the messages up to the first record that mcap cannot read."""
    found = []
    try:
        for record in StreamReader(io.BytesIO(path.read_bytes()), validate_crcs=True).records:
            found += [record.log_time] if isinstance(record, Message) else []
    except (McapError, ValueError, struct.error):
        pass
    return found


def test_both_read_a_whole_bag(tmp_path):
    database, recording = sqlite_bag(tmp_path / 'a', range(NUM)), mcap_bag(tmp_path / 'b')
    assert by_rosbags(database) == own(database) == [*range(NUM)]
    assert by_mcap(recording) == own(recording) == [*range(NUM)]


def test_rosbags_reads_nothing_of_an_sqlite_bag_that_was_cut_off(tmp_path):
    file = sqlite_bag(tmp_path / 'a', range(NUM))
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    with pytest.raises(ReaderError, match='malformed'):
        by_rosbags(file)
    assert NUM // 2 < len(own(file)) < NUM


def test_rosbags_leaves_out_the_journal_of_a_killed_recorder(tmp_path):
    file = sqlite_bag(tmp_path / 'a', range(NUM))
    with closing(sqlite3.connect(file)) as database:
        database.execute('PRAGMA journal_mode=WAL')
        columns = 'topic_id, timestamp, data'
        copied = 'SELECT topic_id, timestamp + 1000, data FROM messages'
        database.execute(f'INSERT INTO messages({columns}) {copied}')
        database.commit()
        killed = tmp_path / 'killed.db3'
        for end in ('', '-wal'):
            shutil.copyfile(f'{file}{end}', f'{killed}{end}')
    assert len(by_rosbags(killed)) == NUM
    assert len(own(killed)) == 2 * NUM


def test_rosbags_hides_where_the_clock_of_a_recorder_was_set_back(tmp_path):
    stamps = [*range(100), *range(50, 150)]
    file = sqlite_bag(tmp_path / 'a', stamps)
    assert by_rosbags(file) == sorted(stamps)
    assert own(file) == stamps


def test_mcap_reads_nothing_of_the_chunk_in_which_a_bag_is_cut_off(tmp_path):
    file = mcap_bag(tmp_path / 'a')
    whole, more = file.read_bytes(), []
    for share in (0.2, 0.4, 0.6, 0.8):
        file.write_bytes(whole[: int(share * len(whole))])
        by_library, kept = by_mcap(file), own(file)
        assert kept[: len(by_library)] == by_library
        more.append(len(kept) - len(by_library))
    assert max(more) > 20, 'messages of 2 kB in chunks of 256 kB'


def test_rosbags_keeps_no_message_of_a_process_that_is_killed_and_no_time_of_publication(tmp_path):
    writer = Writer(tmp_path / 'a', version=9, storage_plugin=StoragePlugin.MCAP)
    writer.open()
    channel = writer.add_connection(TOPIC, messages.STRING, typestore=messages.typestore())
    for stamp in range(NUM):
        writer.write(channel, stamp, text(stamp))
    shutil.copyfile(next((tmp_path / 'a').glob('*.mcap')), tmp_path / 'killed.mcap')
    writer.close()
    assert own(tmp_path / 'killed.mcap') == []
    with BagWriter(tmp_path / 'b') as kept:
        for stamp in range(NUM):
            kept.write_raw(TOPIC, messages.STRING, stamp + 10, text(stamp), publish_ns=stamp)
        kept.flush()
        shutil.copyfile(next(kept.folder.glob('*.mcap')), tmp_path / 'kept.mcap')
    assert own(tmp_path / 'kept.mcap') == [*range(10, NUM + 10)]
    (first, *_) = BagReader(tmp_path / 'b').messages()
    assert (first.stamp_ns, first.publish_ns) == (10, 0)
