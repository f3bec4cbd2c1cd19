"""Bags with one oddity that real robots record: what import bag and the reader make of them."""

from __future__ import annotations

from pathlib import Path
import re
import shutil

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
import yaml

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.episode import JointStates
from mtv_world_ros.data.episode_reader import read_episode, read_info
from mtv_world_ros.data.stream_clocks import ClockBreakError
from mtv_world_ros.robot.file import load_robot
from test.support.bags import STORE
from test.support.robot_recordings import (
    camera,
    Event,
    HOME,
    JOINTS,
    NANO,
    ns,
    positions,
    RATE,
    START,
    VIEWS,
)


def test_a_plain_recording_is_imported_without_a_word(record, run):
    status, said = run(record())
    assert status == 0
    assert 'bag: 4.0 s; frames: front 40, side 40' in said
    assert len([line for line in said.splitlines() if line.startswith(("'", '/'))]) == 0, said


def test_the_outcome_of_each_bag_is_read_from_its_custom_data(record, run, tmp_path):
    for name, word in (('good', 'true'), ('bad', 'failed')):
        bag = record(name=name)
        file = bag / 'metadata.yaml'
        values = yaml.safe_load(file.read_text())
        values['rosbag2_bagfile_information']['custom_data'] = {'success': word}
        file.write_text(yaml.safe_dump(values))
        status, said = run(bag, outcome='key: success')
        assert status == 0, said
    outcomes = [read_info(tmp_path / 'out' / name).outcome for name in ('good', 'bad')]
    assert outcomes == ['success', 'failure']
    status, said = run(record(name='silent'), outcome='key: success')
    assert status == 1 and "no outcome 'success' in custom_data" in said, said


@pytest.mark.parametrize(
    'jump',
    [
        lambda stamp, seconds: stamp - (2 * NANO if seconds >= 2 else 0),
        lambda stamp, seconds: stamp - START + NANO - (2 * NANO if seconds >= 2 else 0),
        lambda stamp, seconds: stamp + (40 * NANO if seconds >= 2 else 0),
    ],
    ids=['set back', 'simulated time starts over', 'set ahead'],
)
def test_a_recording_whose_clocks_jump_becomes_two_episodes(record, run, tmp_path, jump):
    bag = record(lambda topic, s, stamp: stamp if topic == '/tf_static' else jump(stamp, s))
    status, said = run(bag, outcome='success')
    assert status == 0, said
    assert '2 made, 0 kept, 0 failed' in said
    assert re.search(r'jump by [+-](2|40) s at 2.000 s of the recording', said), said
    for part in (1, 2):
        episode = read_episode(tmp_path / 'out' / f'bag_part{part}')
        assert len(episode.images['front'].stamps_ns) == 20
        assert (np.diff(episode.joint_states.stamps_ns) == NANO // RATE).all()
        assert episode.info.outcome == 'unknown'
        wanted = np.stack([positions(2 * (part - 1) + k / RATE) for k in range(100)])
        np.testing.assert_allclose(episode.joint_states.positions[:, 0], wanted[:, 0], atol=1e-9)
    status, said = run(bag, outcome='success')
    assert '0 made, 2 kept, 0 failed' in said
    with pytest.raises(ClockBreakError, match='mtv-world import bag makes an episode of each'):
        read_episode(bag)


def as_sqlite(bag: Path) -> Path:
    """Return the messages of a bag, in their order, as rosbag2_storage_sqlite3 stores them."""
    made, connections = bag.parent / 'sqlite' / bag.name, {}
    made.parent.mkdir()
    with Writer(made, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for message in BagReader(bag).messages():
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, message.msgtype, typestore=STORE
                )
            writer.write(connections[message.topic], message.stamp_ns, message.data)
    return made


@pytest.mark.parametrize('stored', [lambda bag: bag, as_sqlite], ids=['mcap', 'sqlite'])
def test_a_recorder_whose_own_clock_is_set_back_makes_two_episodes(record, run, stored):
    """Stamps and receive times go back together; the order of the file tells."""
    status, said = run(
        stored(
            record(
                lambda topic, s, stamp: stamp - (NANO if s >= 2 else 0),
                received=lambda s: s - (1 if s >= 2 else 0),
            )
        )
    )
    assert status == 0
    assert 'bag_part1: 2.0 s; frames: front 20, side 20' in said
    assert 'bag_part2: 2.0 s; frames: front 20, side 20' in said


def test_a_camera_of_another_clock_is_refused_until_its_receive_times_are_taken(
    record, run, tmp_path
):
    bag = record(lambda topic, _, stamp: stamp + 40 * NANO if 'front/image' in topic else stamp)
    status, said = run(bag)
    assert status == 1
    assert "'/front/image_raw/compressed' is not of the clock of '/joint_states'" in said
    assert '40 s ahead of those of the latter' in said
    assert "'received_times: [front]' in the mapping" in said
    status, said = run(bag, received_times=['front'])
    assert status == 0
    stamps = read_episode(tmp_path / 'out' / 'bag').images['front'].stamps_ns
    assert stamps[0] == ns(0.003) and len(stamps) == 40


def test_frames_that_share_no_moment_with_joint_states_are_refused(record, run):
    late = lambda topic, s, stamp: None if topic == '/joint_states' and s < 3.9 else stamp  # noqa: E731
    early = lambda topic, s, stamp: (  # noqa: E731
        None if 'image' in topic and s > 1 else late(topic, s, stamp)
    )
    status, said = run(record(early))
    assert status == 1
    assert "no frame of view 'front' has joint states: its frames are from 1750000000.003" in said


def test_a_view_with_one_frame_is_refused(record, run):
    edit = lambda topic, s, stamp: None if 'side/image' in topic and s > 0.01 else stamp  # noqa: E731
    status, said = run(record(edit))
    assert status == 1
    assert "view 'side': it has 1 frame, at least 2 are needed" in said
    assert "'views' with front" in said


def stop(seconds: float, names: list[str]) -> Event:
    header = messages.make_header(ns(seconds), '')
    message = messages.make(messages.JOINT_TRAJECTORY, header=header, joint_names=names, points=[])
    return seconds, '/joint_trajectory', messages.JOINT_TRAJECTORY, message


@pytest.mark.parametrize('names', [JOINTS, []], ids=['named', 'bare'])
def test_an_empty_trajectory_holds_the_arm_where_it_is(record, run, tmp_path, names):
    edit = lambda topic, s, stamp: None if topic == '/joint_trajectory' and s > 3 else stamp  # noqa: E731
    status, said = run(record(edit, more=[stop(2.5, names)]))
    assert status == 0
    assert '1 empty trajectories stop the plans before them' in said
    plans = read_episode(tmp_path / 'out' / 'bag').trajectories
    assert plans[-1][0] == ns(2.5)
    np.testing.assert_allclose(plans[-1][1].positions[:, 0], positions(2.5)[0], atol=1e-6)
    assert plans[-1][1].times[-1] == pytest.approx(3.98 - 2.5, abs=1e-3)


def test_a_camera_info_of_zeros_leaves_the_camera_unknown_or_to_the_file(record, run, tmp_path):
    def zeros(topic, _seconds, message):
        if topic == '/side/camera_info':
            message.k, message.p, message.d = np.zeros(9), np.zeros(12), np.zeros(0)
            message.width = message.height = 0

    bag = record(change=zeros)
    status, said = run(bag)
    assert status == 0
    assert 'cameras not known: side' in said
    assert "'/side/camera_info' is not calibrated (K[0] = 0)" in said
    file = tmp_path / 'cameras.yaml'
    values = {
        'width': 32, 'height': 24, 'K': [40.0, 42.0, 15.5, 11.5], 'mount_link': 'panda_link0',
        'T_mount_camera': camera('side').T_mount_camera.tolist(),
    }  # fmt: skip
    file.write_text(yaml.safe_dump({'views': dict.fromkeys(VIEWS, values)}))
    episode = read_episode(bag, calibration=file)
    assert episode.cameras['side'].K[1, 1] == 42.0
    assert episode.unknown == {}


def test_a_joint_that_is_not_measured_has_its_constant(record, run, tmp_path):
    def bare(topic, _seconds, message):
        if topic == '/joint_states':
            message.name, message.position = message.name[:7], message.position[:7]

    bag = record(change=bare)
    status, said = run(bag)
    assert status == 1
    assert "'constants: {panda_finger_joint1: 0.0}'" in said
    status, said = run(bag, constants={'panda_finger_joint1': 0.01})
    assert status == 0
    states = read_episode(tmp_path / 'out' / 'bag').joint_states
    assert set(states.positions[:, states.joint_names.index('panda_finger_joint1')]) == {0.01}


def test_positions_out_of_reach_are_said_once_for_the_recording(record, run):
    def spike(topic, seconds, message):
        if topic == '/joint_states' and abs(seconds - 2) < 1e-6:
            message.position[3] += 1.0

    status, said = run(record(change=spike))
    assert status == 0
    assert said.count('out of reach') == 1
    assert "'/joint_states': joint 'panda_joint4' jumps from -2.2 to -1.2" in said


def test_a_broken_clock_is_refused_by_every_reader(record):
    bag = record(lambda topic, s, stamp: stamp - 5 * NANO if 'front' in topic and s > 2 else stamp)
    with pytest.raises(EpisodeError, match="'/front/image_raw/compressed': its clock jumps by -5"):
        read_episode(bag)


def test_18_a_joint_that_turns_without_end_goes_the_short_way_between_two_samples(tmp_path):
    robot = load_robot(endless_robot(tmp_path))
    rows = np.tile(HOME, (2, 1))
    rows[:, 6] = 3.136, -3.141185307179586  # 6 mrad apart, as a driver reports within a turn
    states = JointStates(
        stamps_ns=np.array([START, START + 20_000_000]),
        joint_names=tuple(JOINTS),
        positions=rows,
    )
    at = states.at(np.array([START + 5_000_000, START + 10_000_000, START + 15_000_000]), robot)
    np.testing.assert_allclose(at[:, 6], [3.1375, 3.139, 3.1405 - 2 * np.pi], atol=1e-6)
    np.testing.assert_allclose(at[:, 5], HOME[5])


def endless_robot(folder: Path) -> Path:
    """Copy of the bundled robot whose last joint has no limits."""
    robot = folder / 'franka'
    shutil.copytree(share_path('config', 'robots', 'franka'), robot)
    file = robot / 'franka.urdf'
    begin, joint, end = file.read_text().partition('<joint name="panda_joint7" type="revolute">')
    end = end.replace('lower="-2.8973" upper="2.8973" ', '', 1)
    assert joint and 'lower' not in end.split('</joint>')[0]
    file.write_text(begin + joint.replace('revolute', 'continuous') + end)
    return robot / 'robot.yaml'


@pytest.mark.parametrize(
    ('begin', 'end', 'status', 'said'),
    [
        (1.95, 2.05, 0, '1 of 40 messages have wrong stamps and were left out, the first by -29'),
        (1.95, 4.0, 1, "'/front/image_raw/compressed': its clock jumps by -29"),
        (0.0, 4.0, 1, 'the stamps of the former are 29'),
    ],
    ids=['one', 'from then on', 'all'],
)
def test_19_stamps_beyond_31_bits_are_named(record, run, begin, end, status, said):
    """3 142 000 000 s are a negative number of seconds in a ROS time."""
    wrong = (3_142_000_000 - 2**32) * NANO
    found, text = run(
        record(
            lambda topic, s, stamp: (
                wrong + stamp - START if 'front/image' in topic and begin <= s < end else stamp
            )
        )
    )
    assert found == status, text
    assert said in text


def test_20_a_camera_whose_counter_starts_over_again_and_again_is_refused(record, run):
    bag = record(
        lambda topic, s, stamp: stamp - 4247 * NANO * int(s // 2) if 'front' in topic else stamp
    )
    status, said = run(bag)
    assert status == 1
    assert "'/front/image_raw/compressed': its clock jumps by -4247 s at 2.003 s" in said
    assert run(bag, received_times=['front'])[0] == 0


def test_21_a_camera_info_with_only_its_ones_is_not_calibrated(record, run):
    def ones(topic, _seconds, message):
        if topic == '/side/camera_info':
            message.k = np.r_[np.zeros(8), 1.0]
            message.p = np.r_[np.zeros(10), 1.0, 0.0]
            message.distortion_model, message.d = 'rational_polynomial', np.zeros(8)

    status, said = run(record(change=ones))
    assert status == 0
    assert "'/side/camera_info' is not calibrated (K[0] = 0)" in said


def test_22_joints_of_a_simulator_that_are_not_the_robots_may_be_nan(record, run, tmp_path):
    def mimic(topic, _seconds, message):
        if topic == '/joint_states':
            message.name.append('panda_finger_joint2_mimic')
            message.position = np.append(message.position, np.nan)

    status, said = run(record(change=mimic))
    assert status == 0, said
    assert 'not finite' not in said
    assert len(read_episode(tmp_path / 'out' / 'bag').joint_states.stamps_ns) == 200
