"""Nothing that was recorded is lost: full disks, kills, and `mtv-world recover`."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time

from mcap.writer import Writer
import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.bag.copying import copy_companions
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.bag.writer import BagWriter
from mtv_world_ros.importing.recover import find_damaged, recover

TYPE = 'std_msgs/msg/UInt8MultiArray'
JOINTS = 'sensor_msgs/msg/JointState'


def payload(index: int, size: int = 20_000) -> bytes:
    """Do not compress."""
    return b'\0\1\0\0' + np.random.default_rng(index).bytes(size)


class Disk:
    """A file on a disk of so many bytes, which the reserve shares."""

    def __init__(self, file, size, reserve):
        self._file, self._size, self._reserve = file, size, reserve

    def write(self, data):
        taken = self._file.tell() + (self._reserve.stat().st_size if self._reserve.exists() else 0)
        if taken + len(data) > self._size:
            self._file.write(bytes(data[: (self._size - taken) // 2]))  # disks take a part first
            raise OSError(errno.ENOSPC, 'No space left on device')
        return self._file.write(data)

    def __getattr__(self, name):
        return getattr(self._file, name)


def fill(writer: BagWriter, size: int) -> int:
    """Record until the disk is full; return how many messages `write_raw` took or refused."""
    disk = Disk(writer._file._file, size, writer.folder / '.reserve')
    writer._file._file = disk
    for index in range(10_000):
        try:
            writer.write_raw('/noise', TYPE, index, payload(index))
        except EpisodeError as error:
            assert 'No space left' in str(error)
            return index + 1
    raise AssertionError('the disk never filled')


def test_a_full_disk_loses_no_message_and_the_bag_is_whole(tmp_path) -> None:
    writer = BagWriter(tmp_path / 'bag', keep=True)
    count = fill(writer, 12_000_000)
    with pytest.raises(EpisodeError, match='No space left'):
        writer.write_raw('/noise', TYPE, 1, payload(1))
    writer.close()
    with Reader(tmp_path / 'bag') as reader:  # an independent reader, by metadata and index
        found = [bytes(data) for _, _, data in reader.messages()]
    assert 'No space left' in BagReader(tmp_path / 'bag').custom_data['cut_off']
    assert found == [payload(index) for index in range(count)]
    assert not list(tmp_path.glob('.*'))
    assert not list((tmp_path / 'bag').glob('.*'))


@pytest.mark.skipif(os.geteuid() != 0, reason='mounts a small disk')
def test_a_disk_that_is_really_full_loses_no_message(tmp_path) -> None:
    mounted = subprocess.run(
        ['mount', '-t', 'tmpfs', '-o', 'size=6m', 'tmpfs', str(tmp_path)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip('no small disk can be mounted here')
    try:
        count = 0
        full = pytest.raises(EpisodeError, match='No space left')
        with full, BagWriter(tmp_path / 'bag', keep=True) as writer:
            while True:
                count += 1
                writer.write_raw('/noise', TYPE, count, payload(count))
        with Reader(tmp_path / 'bag') as reader:
            assert reader.message_count == count > 50
    finally:
        subprocess.run(['umount', str(tmp_path)], check=True)


def test_a_disk_with_no_room_for_the_end_leaves_all_but_the_last_chunk(tmp_path) -> None:
    writer = BagWriter(tmp_path / 'bag', keep=True)
    count = fill(writer, 12_000_000)
    disk = writer._file._file
    disk._size = disk._file.tell() + 100  # others took the room
    with pytest.raises(EpisodeError, match='mtv-world recover'):
        writer.close()
    writer.abort()  # deletes nothing after close
    (bag,) = [recover(source) for source in find_damaged(tmp_path / 'bag')]
    assert bag.path == tmp_path / 'bag'
    assert count - 15 < bag.num_messages['/noise'] < count
    assert bag.lost


def test_a_writer_without_keep_says_full_and_leaves_nothing(tmp_path) -> None:
    full = pytest.raises(EpisodeError, match='No space left')
    with full, BagWriter(tmp_path / 'bag') as writer:
        fill(writer, 1_000_000)
        writer.write_raw('/noise', TYPE, 0, b'')
    assert list(tmp_path.iterdir()) == []


def test_what_was_flushed_survives_a_kill(tmp_path) -> None:
    script = (
        'import os, signal, sys\n'
        'from mtv_world_ros.data.bag.writer import BagWriter\n'
        'from mtv_world_ros.data.bag.metadata import LATCHED\n'
        'writer = BagWriter(sys.argv[1], keep=True)\n'
        f'writer.declare("/joints", "{JOINTS}", LATCHED)\n'
        'for index in range(100):\n'
        f'    writer.write_raw("/joints", "{JOINTS}", 5 + index, bytes(64), publish_ns=index)\n'
        'writer.set_metadata("task", {"name": "stack"})\n'
        '(writer.folder / "calibration.yaml").write_text("{}")\n'
        'writer.flush()\n'
        'os.kill(os.getpid(), signal.SIGKILL)\n'
    )
    done = subprocess.run([sys.executable, '-c', script, str(tmp_path / 'bag')])
    assert done.returncode == -signal.SIGKILL
    assert main(['recover', str(tmp_path)]) == 0
    with Reader(tmp_path / 'bag') as reader:
        assert reader.message_count == 100
        assert reader.connections[0].ext.offered_qos_profiles[0].durability.name == (
            'TRANSIENT_LOCAL'
        )
    assert (tmp_path / 'bag' / 'calibration.yaml').is_file()
    assert [m.publish_ns for m in BagReader(tmp_path / 'bag').messages()] == list(range(100))
    assert list(tmp_path.glob('.bag.*.tmp'))  # what was damaged is left alone


def test_a_foreign_message_type_is_recovered_with_its_definition(tmp_path) -> None:
    with (tmp_path / 'cut.mcap').open('wb') as stream:
        writer = Writer(stream, chunk_size=100)
        writer.start(profile='ros2')
        schema = writer.register_schema('mine_msgs/msg/Thing', 'ros2msg', b'int32 value')
        channel = writer.register_channel('/thing', 'cdr', schema)
        for index in range(10):
            writer.add_message(channel, index, b'\0\1\0\0' + bytes([index, 0, 0, 0]), index)
        writer.finish()
    content = (tmp_path / 'cut.mcap').read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(content[: len(content) // 2])
    bag = recover(tmp_path / 'cut.mcap')
    assert bag.path == tmp_path / 'cut'
    reader = BagReader(bag.path)
    assert reader.topics() == {'/thing': 'mine_msgs/msg/Thing'}
    assert reader.declared()['/thing'][1] == 'int32 value'


def test_nothing_to_recover_is_said(tmp_path, capsys) -> None:
    assert main(['recover', str(tmp_path)]) == 1
    assert 'nothing to recover' in capsys.readouterr().err
    BagWriter(tmp_path / 'bag').close()
    assert main(['recover', str(tmp_path / 'bag')]) == 0
    assert '0 messages' in capsys.readouterr().out


@pytest.mark.parametrize('content', [b'', b'\x89MC', b'\x89MCAP0\r\n'])
def test_a_file_without_a_whole_message_is_said_and_no_bag_is_made(
    content, tmp_path, capsys
) -> None:
    (tmp_path / 'a.mcap').write_bytes(content)
    for words in ([], ['--out', str(tmp_path / 'out')]):
        assert main(['recover', str(tmp_path / 'a.mcap'), *words]) == 1
        said = capsys.readouterr()
        assert "nothing can be recovered of '" in said.err and 'no whole message' in said.err
        assert said.out == ''
    assert [path.name for path in tmp_path.iterdir()] == ['a.mcap']


def test_an_empty_recording_does_not_keep_others_from_being_recovered(tmp_path, capsys) -> None:
    (tmp_path / '.a.1.tmp').mkdir()
    (tmp_path / '.a.1.tmp' / 'a_0.mcap').write_bytes(b'')
    with BagWriter(tmp_path / 'whole') as writer:
        writer.write_raw('/noise', TYPE, 0, payload(0))
    (tmp_path / 'whole').rename(tmp_path / '.b.1.tmp')
    assert main(['recover', str(tmp_path)]) == 1
    said = capsys.readouterr()
    assert ".a.1.tmp', which has no whole message" in said.err
    assert '/noise 1' in said.out
    assert [m.topic for m in BagReader(tmp_path / 'b').messages()] == ['/noise']


def test_flushing_costs_little_time(tmp_path) -> None:
    with BagWriter(tmp_path / 'bag', keep=True) as writer:
        begin = time.process_time()
        for index in range(200):
            writer.write_raw('/noise', TYPE, index, payload(index, 100))
            writer.flush()
        assert time.process_time() - begin < 2.0


def test_what_goes_with_a_recording_is_copied_and_its_damaged_bag_is_not(tmp_path) -> None:
    source, folder = tmp_path / 'bag', tmp_path / 'whole'
    (source / 'notes').mkdir(parents=True)
    folder.mkdir()
    bag = ['a_0.db3', 'a_0.db3-wal', 'a_0.db3-shm', 'a_1.mcap', 'a_2.mcap.zstd', 'metadata.yaml']
    for name in (*bag, 'calibration.yaml', 'notes/day.txt', 'meshes.zstd'):
        (source / name).write_bytes(b'0')
    copy_companions(source, folder)
    assert {path.name for path in folder.rglob('*')} == {
        'calibration.yaml', 'notes', 'day.txt', 'meshes.zstd',
    }  # fmt: skip
