from __future__ import annotations

from pathlib import Path
import signal
import subprocess
import sys
from threading import Thread
from typing import Any, cast

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.bag.metadata import LATCHED, Qos
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.bag.writer import BagWriter
from mtv_world_ros.data.episode_writer import EpisodeWriter


def profiles_of(reader: Reader) -> dict[str, Any]:
    """Offered profile of each topic."""
    return {c.topic: cast('Any', c.ext).offered_qos_profiles[0] for c in reader.connections}


def test_an_exception_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError, match='simulator fell over'):
        _record_and_fail(tmp_path / 'episode')
    assert list(tmp_path.iterdir()) == []


def test_a_killed_recorder_leaves_nothing_under_the_name(tmp_path):
    code = (
        'import os, signal\n'
        'from mtv_world_ros.data.episode_writer import EpisodeWriter\n'
        f'writer = EpisodeWriter({str(tmp_path / "episode")!r}, task="t", instruction="i", '
        'robot="r")\n'
        'writer.write_instruction(0)\n'
        'os.kill(os.getpid(), signal.SIGKILL)\n'
    )
    root = Path(__file__).parents[3]
    done = subprocess.run([sys.executable, '-c', code], cwd=root, timeout=180, check=False)
    assert done.returncode == -signal.SIGKILL
    assert not (tmp_path / 'episode').exists()
    assert all(left.name.startswith('.episode.') for left in tmp_path.iterdir())


def test_an_existing_episode_is_kept_unless_overwritten(make_episode, tmp_path):
    path = make_episode('kept')
    before = (path / 'metadata.yaml').read_bytes()
    with pytest.raises(EpisodeError, match='exists already'):
        _writer(path)
    assert (path / 'metadata.yaml').read_bytes() == before
    with pytest.raises(KeyError), _writer(path, overwrite=True):
        raise KeyError
    assert (path / 'metadata.yaml').read_bytes() == before
    with _writer(path, overwrite=True) as writer:
        writer.write_instruction(5)
    assert [m.topic for m in BagReader(path).messages()] == ['/instruction']
    assert [left.name for left in tmp_path.iterdir()] == ['kept']


def test_a_folder_that_is_no_bag_is_never_overwritten(tmp_path):
    (tmp_path / 'photos').mkdir()
    (tmp_path / 'photos' / 'cat.jpg').write_bytes(b'x')
    with pytest.raises(EpisodeError, match='not a bag folder'):
        _writer(tmp_path / 'photos', overwrite=True)
    assert (tmp_path / 'photos' / 'cat.jpg').exists()


def test_a_name_that_was_taken_meanwhile_is_respected(tmp_path):
    writer = _writer(tmp_path / 'episode')
    (tmp_path / 'episode').mkdir()
    (tmp_path / 'episode' / 'mine').write_text('')
    with pytest.raises(EpisodeError, match='exists already'):
        writer.close()
    assert [left.name for left in (tmp_path / 'episode').iterdir()] == ['mine']
    assert [left.name for left in tmp_path.iterdir()] == ['episode']


def test_a_parent_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / 'file').write_bytes(b'')
    with pytest.raises(EpisodeError, match='cannot write .*file/episode'):
        _writer(tmp_path / 'file' / 'episode')


@pytest.mark.parametrize(
    ('write', 'reason'),
    [
        (lambda w: w.write_image('low', 0, np.zeros((4, 4), np.uint8)), r'low.*\(4, 4\) uint8'),
        (lambda w: w.write_image('low', 0, np.zeros((4, 4, 3))), 'float64'),
        (lambda w: w.write_mask('low', 0, np.zeros((4, 4), bool)), 'bool'),
        (lambda w: w.write_joint_states(0, ['a', 'b'], [0.0]), r'position has shape \(1,\)'),
        (lambda w: w.write_joint_states(0, ['a'], [0.0], [1.0, 2.0]), 'velocity has shape'),
        (lambda w: w.write_instruction(-1), 'stamp -1 ns'),
        (lambda w: w.write_joint_states(2**31 * 10**9, ['a'], [0.0]), 'does not fit a ROS time'),
        (lambda w: w.write_raw('/a', 'std_msgs/msg/Sting', 0, b''), 'did you mean'),
        (lambda w: w.write_raw('/instruction', 'std_msgs/msg/Bool', 0, b''), 'recorded as'),
    ],
)
def test_what_cannot_be_recorded_is_refused_with_a_reason(write, reason, tmp_path):
    with _writer(tmp_path / 'episode') as writer:
        writer.write_instruction(0)
        with pytest.raises(EpisodeError, match=reason):
            write(writer)
    assert [m.topic for m in BagReader(tmp_path / 'episode').messages()] == ['/instruction']


def test_any_standard_topic_can_be_recorded_as_raw_bytes(tmp_path):
    types = [
        'sensor_msgs/msg/Image',
        'std_msgs/msg/Float64',
        'std_msgs/msg/Float32MultiArray',
        'trajectory_msgs/msg/JointTrajectory',
        'diagnostic_msgs/msg/DiagnosticArray',
        'rosgraph_msgs/msg/Clock',
        'tf2_msgs/msg/TFMessage',
        'rcl_interfaces/msg/Log',
    ]
    with BagWriter(tmp_path / 'bag') as writer:
        for index, msgtype in enumerate(types):
            writer.write_raw(
                f'/topic{index}', msgtype, 100 + index, b'\x00\x01\x00\x00' + b'\0' * 64
            )
    found = [
        (m.topic, m.msgtype, m.stamp_ns, len(m.data))
        for m in BagReader(tmp_path / 'bag').messages()
    ]
    assert found == [(f'/topic{i}', t, 100 + i, 68) for i, t in enumerate(types)]
    with Reader(tmp_path / 'bag') as reader:
        assert [c.msgtype for c in reader.connections] == types


def test_a_declared_profile_is_recorded_and_kept(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        writer.declare('/a', 'std_msgs/msg/String', Qos(reliability='best_effort', depth=3))
        writer.declare('/b', 'std_msgs/msg/String', LATCHED)
        writer.declare('/a', 'std_msgs/msg/String')
    with Reader(tmp_path / 'bag') as reader:
        offered = profiles_of(reader)
    assert (offered['/a'].reliability.name, offered['/a'].depth) == ('BEST_EFFORT', 3)
    assert offered['/b'].durability.name == 'TRANSIENT_LOCAL'


def test_an_empty_bag_is_a_valid_bag(tmp_path):
    with BagWriter(tmp_path / 'bag'):
        pass
    with Reader(tmp_path / 'bag') as reader:
        assert reader.message_count == 0
    assert list(BagReader(tmp_path / 'bag').messages()) == []


def test_threads_may_record_at_once(tmp_path):
    def record(topic: str) -> None:
        for index in range(200):
            writer.write_raw(topic, 'std_msgs/msg/String', index, b'\0\1\0\0\1\0\0\0\0')

    with BagWriter(tmp_path / 'bag') as writer:
        threads = [Thread(target=record, args=(f'/topic{i}',)) for i in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    with Reader(tmp_path / 'bag') as reader:
        assert {c.topic: c.msgcount for c in reader.connections} == {
            f'/topic{i}': 200 for i in range(4)
        }


def test_nothing_can_be_recorded_after_close(tmp_path):
    writer = BagWriter(tmp_path / 'bag')
    writer.close()
    writer.close()
    writer.abort()
    assert (tmp_path / 'bag' / 'metadata.yaml').is_file()
    with pytest.raises(EpisodeError, match='is closed'):
        writer.write_raw('/a', 'std_msgs/msg/String', 0, b'')


def _writer(path: Path, **options) -> EpisodeWriter:
    return EpisodeWriter(path, task='t', instruction='i', robot='r', **options)


def _record_and_fail(path: Path) -> None:
    with _writer(path) as writer:
        writer.write_instruction(0)
        raise RuntimeError('simulator fell over')
