"""Bags of common drivers with one oddity: nothing is lost in silence, and printed advice works."""

from __future__ import annotations

from pathlib import Path
import re
import shutil

import numpy as np
import pytest
import yaml

from mtv_world_ros.cli import main
from mtv_world_ros.core.images import encode_jpeg
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.training.unknown_cameras import unknown_camera_lines
from test.support.robot_recordings import (
    Event,
    FPS,
    IMAGE,
    JOINTS,
    NANO,
    ns,
    positions,
    RATE,
    SECONDS,
    START,
)

FINGER = 'panda_finger_joint1'
ARM = JOINTS[:7]


def finger(seconds: float) -> float:
    """Position of the finger [m]; it is commanded to move like that."""
    return 0.02 + 0.015 * np.sin(1.5 * seconds)


def own_gripper(topic: str, rate: int = 30, at: float | None = None) -> list[Event]:
    """Messages of a gripper's own driver, which has a second finger, too."""
    found: list[Event] = []
    for k in range(round(SECONDS * rate)):
        t = k / rate + 0.001
        value = finger(t) if at is None else at
        state = messages.make_joint_state(ns(t), [FINGER, 'panda_finger_joint2'], [value, value])
        found.append((t, topic, messages.JOINT_STATE, state))
    return found


def without_finger(topic: str, _seconds: float, message) -> None:
    if topic == '/joint_states':
        message.name, message.position = list(ARM), message.position[:7]


def moving_finger(topic: str, seconds: float, message, measured: float | None = None) -> None:
    """Change commands, and measured positions, so that the finger moves."""
    if topic == '/joint_states' and len(message.name) == len(JOINTS):
        message.position[7] = finger(seconds) if measured is None else measured
    if topic == '/joint_trajectory':
        for k, point in enumerate(message.points):
            point.positions[7] = finger(seconds + (k + 1) / 10)


def advice(said: str, key: str) -> dict:
    """Return the lines of a mapping that a message proposes for a key."""
    found = re.search(rf"'({key}: [^']+)'", said)
    assert found is not None, said
    return yaml.safe_load(found[1])


# Names of views


@pytest.mark.parametrize(
    ('topics', 'names'),
    [
        (['/zed/zed_node/left/color/rect/image', '/zed/zed_node/right/color/rect/image'],
         ['left', 'right']),
        (['/cam_a/pylon/image_raw', '/cam_b/pylon/image_raw'], ['cam_a', 'cam_b']),
        (['/front/image_rectified', '/side/image_rectified'], ['front', 'side']),
        (['/zed_a/zed_node/rgb/image', '/zed_b/zed_node/rgb/image', '/cam/image_raw'],
         ['zed_a', 'zed_b', 'cam']),
        (['/pylon/image_raw', '/cam_b/pylon/image_raw'], ['pylon', 'cam_b_pylon']),
        (['/a/cam/image_raw', '/b/cam/image_raw', '/x/a/image_raw'],
         ['a_cam', 'b_cam', 'x_a']),
    ],
)  # fmt: skip
def test_no_camera_is_lost_for_a_name(topics, names):
    from mtv_world_ros.importing.view_names import guess_views

    found = guess_views([topic + '/compressed' for topic in topics])
    assert {topic: name for name, topic in found.items()} == dict(zip(topics, names, strict=True))


def test_both_of_two_cameras_that_are_called_alike_are_imported(record, run, tmp_path):
    bag = record()
    renamed = rename_topics(bag, {'/front/': '/cam_a/pylon/', '/side/': '/cam_b/pylon/'})
    out = tmp_path / 'out'
    assert main(['import', 'bag', str(renamed), '--robot', 'franka', '--out', str(out)]) == 0
    assert read_episode(out / 'renamed').views == ('cam_a', 'cam_b')


def rename_topics(bag: Path, names: dict[str, str]) -> Path:
    """Return a copy of a bag with other beginnings of topics."""
    from mtv_world_ros.data.bag.reader import BagReader
    from mtv_world_ros.data.bag.writer import BagWriter

    with BagWriter(bag.parent / 'renamed') as writer:
        for message in BagReader(bag).messages():
            topic = message.topic
            for old, new in names.items():
                topic = topic.replace(old, new) if topic.startswith(old) else topic
            writer.write_raw(topic, message.msgtype, message.stamp_ns, message.data)
    return bag.parent / 'renamed'


# Cameras without an edge to the robot


def only_in_the_camera(view: str):
    """Make the view's transform one from the camera's own link."""

    def change(topic: str, _seconds: float, message) -> None:
        if topic == '/tf_static' and message.transforms[0].child_frame_id.startswith(view):
            message.transforms[0].header.frame_id = f'{view}_link'

    return change


def test_a_camera_without_an_edge_to_the_robot_is_marked_and_the_other_kept(record, run, tmp_path):
    status, said = run(record(change=only_in_the_camera('side')))
    assert status == 0, said
    assert (
        "view 'side': pose not known (TF does not connect 'side_link' with the robot): mtv-world "
        f'fit camera {tmp_path / "out"} --view side --click points.html'
    ) in said
    episode = read_episode(tmp_path / 'out' / 'bag', unknown_mount='panda_link0')
    assert dict(episode.unknown) == {'side': 'pose'}
    assert episode.cameras['front'].mount_link == 'panda_link0'
    np.testing.assert_allclose(episode.cameras['front'].K[0, 0], 40)


def test_the_command_that_estimates_an_unknown_camera_runs(record, run, tmp_path, monkeypatch):
    _, said = run(record(change=only_in_the_camera('side')))
    words = said.partition('robot): mtv-world ')[2].split('\n')[0].split()
    monkeypatch.chdir(tmp_path)
    assert main(words) == 0
    assert (tmp_path / 'points.html').is_file()


def test_training_says_what_unknown_cameras_cost_and_the_remedy(record, run, tmp_path):
    run(record(change=only_in_the_camera('side')))
    skipped = [str(tmp_path / 'out' / 'bag')]
    (line,) = unknown_camera_lines(skipped, 10)
    assert line.startswith('1 of 10 episodes (10%) are left out')
    assert f'fit camera {tmp_path / "out"} --view side --apply, and' in line
    assert '--apply-doubted' in line
    assert unknown_camera_lines([str(record(name='other'))], 10) == []


# Grippers


def test_a_gripper_on_a_topic_of_its_own_is_named_and_read(record, run, tmp_path):
    def change(topic, seconds, message):
        moving_finger(topic, seconds, message)
        without_finger(topic, seconds, message)

    bag = record(more=own_gripper('/hand/joint_states'), change=change)
    status, said = run(bag)
    assert status == 1
    assert '/hand/joint_states measures panda_finger_joint1' in said and 'constants' not in said
    status, said = run(bag, **advice(said, 'joint_states'))
    assert status == 0, said
    states = read_episode(tmp_path / 'out' / 'bag').joint_states
    times = (states.stamps_ns - START) / NANO
    apart = np.abs(states.positions[:, 7] - finger(times))
    assert apart.max() < 0.03 * 0.0225 + 1.5 * 0.015 / 30
    assert f'{FINGER[:-1]}2 of /hand/joint_states (no joint of the robot)' in said


def test_a_joint_that_is_nowhere_is_taken_from_constants(record, run, tmp_path):
    status, said = run(record(change=without_finger))
    assert status == 1
    status, said = run(tmp_path / 'bag', **advice(said, 'constants'))
    assert status == 0, said
    assert (read_episode(tmp_path / 'out' / 'bag').joint_states.positions[:, 7] == 0).all()


@pytest.mark.parametrize('rate', [10, 30, 100])
def test_a_second_publisher_of_a_finger_that_stands_still_is_left_out(record, run, tmp_path, rate):
    status, said = run(
        record(more=own_gripper('/joint_states', rate, at=0.0), change=moving_finger)
    )
    assert status == 0, said
    assert f"joint '{FINGER}' has two publishers: {round(SECONDS * rate)} of " in said
    states = read_episode(tmp_path / 'out' / 'bag').joint_states
    times = (states.stamps_ns - START) / NANO
    assert np.abs(states.positions[:, 7] - finger(times)).max() < 1.5 * 0.015 / RATE + 1e-6


def test_two_publishers_of_a_finger_that_both_move_are_refused(record, run):
    def other(seconds):
        state = messages.make_joint_state(ns(seconds), [FINGER], [0.04 - finger(seconds)])
        return seconds, '/joint_states', messages.JOINT_STATE, state

    more = [other(k / 50 + 0.001) for k in range(200)]
    status, said = run(record(more=more, change=moving_finger))
    assert status == 1 and 'it cannot be told which of them is the gripper' in said


def test_a_finger_that_rests_while_it_is_commanded_is_named_with_its_topic(record, run, tmp_path):
    def change(topic, seconds, message):
        moving_finger(topic, seconds, message, measured=0.0)

    status, said = run(record(more=own_gripper('/hand/joint_states'), change=change))
    assert status == 0, said
    assert f"joint '{FINGER}' stays at 0 while its commands move from 0.00" in said
    shutil.rmtree(tmp_path / 'out')
    status, said = run(tmp_path / 'bag', **advice(said, 'joint_states'))
    assert status == 0 and 'stays at 0' not in said
    assert f"joint '{FINGER}' has two publishers: 200 of 320 positions stand still" in said


def test_a_gripper_that_opens_and_closes_in_steps_is_one_publisher(record, run, tmp_path):
    def change(topic, seconds, message):
        if topic == '/joint_states':
            message.position[7] = 0.04 * (int(seconds) % 2)

    status, said = run(record(change=change))
    assert status == 0 and 'two publishers' not in said
    measured = read_episode(tmp_path / 'out' / 'bag').joint_states.positions[:, 7]
    assert set(measured.tolist()) == {0.0, 0.04}


# Prefixes


@pytest.mark.parametrize('arms', [('left_',), ('left_', 'right_')])
def test_a_prefix_of_all_names_is_proposed_and_taken(record, run, tmp_path, arms):
    def change(topic, _seconds, message):
        if topic == '/joint_states':
            message.name = [arm + name for arm in arms for name in JOINTS]
            message.position = np.concatenate([message.position + k for k in range(len(arms))])
            message.velocity = np.empty(0)
        if topic == '/joint_trajectory':
            message.joint_names = ['left_' + name for name in message.joint_names]

    status, said = run(record(change=change))
    assert status == 1
    for arm in arms:
        assert f"'joints: {{prefix: {arm}}}'" in said
    assert 'constants' not in said
    status, said = run(tmp_path / 'bag', **advice(said, 'joints'))
    assert status == 0, said
    states = read_episode(tmp_path / 'out' / 'bag').joint_states
    assert states.joint_names == tuple(JOINTS)
    wanted = np.stack([positions(k / RATE) for k in range(len(states.stamps_ns))])
    np.testing.assert_allclose(states.positions, wanted, atol=1e-9)
    if len(arms) > 1:
        assert 'right_panda_joint1' in said and 'no joint of the robot' in said


# Topics that are not used


def test_every_topic_that_is_not_used_is_named_once_with_why(record, run):
    text = messages.make(messages.STRING, data='hello')
    depth = messages.make_image(ns(1.0), 'd', np.zeros((4, 4), np.uint8))
    info = messages.make_camera_info(ns(1.0), read_camera('front'), 'front_optical_frame')
    more: list[Event] = [
        (1.0, '/chatter', messages.STRING, text),
        (1.0, '/front/depth/image_raw', messages.IMAGE, depth),
        (1.0, '/front/depth/camera_info', messages.CAMERA_INFO, info),
        (1.0, '/front/image_mono', messages.IMAGE, depth),
        (1.0, '/other/joint_states', messages.JOINT_STATE,
         messages.make_joint_state(ns(1.0), ['a'], [0.0])),
    ]  # fmt: skip
    status, said = run(record(more=more), action='state')
    assert status == 0, said
    line = next(line for line in said.splitlines() if 'not used' in line)
    for part in (
        '/chatter (text;', '/front/depth/image_raw (no colour images, by its name)',
        '/front/depth/camera_info (camera info of no view)',
        "/front/image_mono (images of the camera of '/front/image_raw/compressed', which is read",
        '/other/joint_states (joint states;', "/joint_trajectory (commands; 'action: state' takes",
    ):  # fmt: skip
        assert line.count(part) == 1, (part, line)


def read_camera(view: str):
    from test.support.robot_recordings import camera

    return camera(view)


def test_commands_that_are_not_there_are_replaced_by_the_measured_positions(record, run, tmp_path):
    edit = lambda topic, _seconds, stamp: None if topic == '/joint_trajectory' else stamp  # noqa: E731
    status, said = run(record(edit))
    assert status == 1 and '--action state' in said
    status, said = run(tmp_path / 'bag', '--action', 'state')
    assert status == 0, said


# Recordings


def test_a_recording_without_metadata_is_read_beside_good_ones(record, run, tmp_path):
    folder = tmp_path / 'bags'
    for name in ('a', 'b', 'c'):
        shutil.move(record(name=name), folder / name)
    (folder / 'b' / 'metadata.yaml').unlink()
    status, said = run(folder)
    assert status == 0, said
    assert '3 made, 0 kept, 0 failed' in said
    assert "b' has no metadata.yaml (the recorder was killed?)" in said


def test_loose_files_of_several_recordings_are_one_bag_each(record, run, tmp_path):
    folder = tmp_path / 'loose'
    folder.mkdir()
    for name in ('monday', 'tuesday'):
        (file,) = record(name=name).glob('*.mcap')
        shutil.copy(file, folder / f'{name}.mcap')
    status, said = run(folder)
    assert status == 0 and '2 made' in said, said


# Pictures


def padded(data: bytes, count: int) -> bytes:
    """Put bytes before every fifth restart marker, as the firmware of webcams does."""
    parts = re.split(rb'(\xff[\xd0-\xd7])', data)
    markers = range(1, len(parts), 2)
    for n in list(markers)[::5]:
        parts[n] = b'\x37\x00\x91'[:count] + parts[n]
    return b''.join(parts)


def noisy_jpeg(restart: int) -> bytes:
    import cv2

    pixels = np.random.default_rng(5).integers(0, 255, (96, 128, 3)).astype(np.uint8)
    options = [cv2.IMWRITE_JPEG_RST_INTERVAL, restart]
    return cv2.imencode('.jpg', pixels, options)[1].tobytes()


@pytest.mark.parametrize('restart', [3, 8, 11])
@pytest.mark.parametrize('count', [1, 3])
def test_a_jpeg_with_bytes_before_restart_markers_decodes_whole(restart, count):
    from mtv_world_ros.data.bag.image_decoding import compressed_to_rgb

    data = noisy_jpeg(restart)
    whole = compressed_to_rgb('jpeg', np.frombuffer(data, np.uint8))
    shown = compressed_to_rgb('jpeg', np.frombuffer(padded(data, count), np.uint8))
    np.testing.assert_array_equal(shown, whole)


def test_a_jpeg_that_lost_a_part_between_restart_markers_is_damaged():
    from mtv_world_ros.core.errors import ObservationError
    from mtv_world_ros.data.bag.image_decoding import compressed_to_rgb

    data = padded(noisy_jpeg(8), 2)
    for lost in (slice(3000, 3400), slice(5000, 6500)):
        cut = data[: lost.start] + data[lost.stop :]
        with pytest.raises(ObservationError, match='damaged'):
            compressed_to_rgb('jpeg', np.frombuffer(cut, np.uint8))


def test_a_damaged_frame_is_left_out_by_name_and_the_others_stay(record, run, tmp_path):
    count = iter(range(1000))

    def change(topic, _seconds, message):
        if topic == IMAGE.format('front') and next(count) % 8 == 3:
            good = encode_jpeg(pixels, 90)
            cut = 2 * len(good) // 3
            message.data = np.frombuffer(good[:cut] + good[cut + 100 :], np.uint8)

    pixels = np.random.default_rng(1).integers(0, 255, (24, 32, 3)).astype(np.uint8)
    bag = record(change=change)
    status, said = run(bag)
    assert status == 0, said
    assert "view 'front': 5 of 40 frames were left out, '/front/image_raw/compressed'" in said
    stamps = read_episode(tmp_path / 'out' / 'bag').images['front'].stamps_ns
    assert len(stamps) == 35 and (np.diff(stamps) > 1.5 * NANO / FPS).sum() == 5
    as_it_is = read_episode(bag)
    assert len(as_it_is.images['front'].stamps_ns) == 35
    assert any('5 messages were left out' in text for text in as_it_is.warnings)


@pytest.mark.parametrize('folder', ['rect/', 'left_rect/', ''])
def test_rectified_pictures_in_a_folder_have_the_intrinsics_of_p(record, tmp_path, folder):
    def change(topic, _seconds, message):
        if topic == '/front/camera_info':
            message.d[0], message.k[0], message.p[0] = 0.3, 41.0, 38.0

    bag = rename_topics(record(change=change), {'/front/': f'/front/{folder}'})
    out = tmp_path / 'out'
    assert main(['import', 'bag', str(bag), '--robot', 'franka', '--out', str(out)]) == 0
    camera = read_episode(out / 'renamed').cameras[
        'front' if folder != 'left_rect/' else 'left_rect'
    ]
    assert camera.K[0, 0] == pytest.approx(38 if folder else 41)
    assert np.any(camera.distortion) == (not folder)
