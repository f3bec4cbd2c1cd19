from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
import yaml

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.core.errors import CalibrationError, EpisodeError
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.writer import BagWriter
from mtv_world_ros.data.episode_reader import read_episode, read_info

STORE = get_typestore(Stores.ROS2_JAZZY)


def header(stamp_ns: int) -> Any:
    time = STORE.types['builtin_interfaces/msg/Time'](
        sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
    )
    return STORE.types['std_msgs/msg/Header'](stamp=time, frame_id='camera')


def image(stamp_ns: int, value: int = 7, encoding: str = 'mono8', **changes: Any) -> Any:
    fields = {
        'header': header(stamp_ns),
        'height': 2,
        'width': 3,
        'encoding': encoding,
        'is_bigendian': 0,
        'step': 3,
        'data': np.full(6, value, np.uint8),
        **changes,
    }
    return STORE.types['sensor_msgs/msg/Image'](**fields)


def joint_state(stamp_ns: int, **positions: float) -> Any:
    return STORE.types['sensor_msgs/msg/JointState'](
        header=header(stamp_ns),
        name=list(positions),
        position=np.array(list(positions.values())),
        velocity=np.empty(0),
        effort=np.empty(0),
    )


def camera_info(stamp_ns: int, focal: float = 50.0) -> Any:
    info = messages.make_camera_info(stamp_ns, _camera(), 'camera')
    info.k = np.array([focal, 0, 1, 0, focal, 1, 0, 0, 1], np.float64)
    return info


def _camera() -> Any:
    from mtv_world_ros.core.data_types import CameraModel

    return CameraModel(
        view='low', width=3, height=2, K=np.eye(3), mount_link='base', T_mount_camera=np.eye(4)
    )


@pytest.fixture
def foreign_bag(tmp_path) -> Callable[..., Path]:
    """Records (topic, type, log stamp, message) with rosbags, as a robot would."""

    def make(*entries: tuple[str, str, int, Any], name: str = 'bag') -> Path:
        with Writer(tmp_path / name, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connections: dict[str, Any] = {}
            for topic, kind, stamp, message in entries:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
                writer.write(connections[topic], stamp, STORE.serialize_cdr(message, kind))
        return tmp_path / name

    return make


def read(path: Path, **options: Any):
    return read_episode(path, with_cameras=False, **options)


IMAGE, STATE = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/JointState'
COMPRESSED = 'sensor_msgs/msg/CompressedImage'


def test_the_frames_before_a_cut_are_all_there(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (30, 48, 64, 3), np.uint8)
    with BagWriter(tmp_path / 'bag') as writer:
        for index, frame in enumerate(noise):
            message = image(10**9 + index, 0, 'rgb8', height=48, width=64, step=192,
                            data=frame.ravel())  # fmt: skip
            writer.write_raw('/low/image_raw', IMAGE, index, messages.serialize(IMAGE, message))
    file = tmp_path / 'bag' / 'bag_0.mcap'
    content = file.read_bytes()
    counts = []
    for length in range(30_000, len(content), 20_011):
        file.write_bytes(content[:length])
        episode = read(tmp_path / 'bag')
        frames = np.asarray(episode.images['low'].frames)
        np.testing.assert_array_equal(frames, noise[: len(frames)])
        assert episode.truncated or len(frames) == 30
        counts.append(len(frames))
    assert counts == sorted(counts)
    assert len(set(counts)) >= 5


def compressed(stamp_ns: int, layout: str, data: np.ndarray | None = None) -> Any:
    """By default a grey PNG of value 9."""
    if data is None:
        data = cv2.imencode('.png', np.full((2, 3, 3), 9, np.uint8))[1].ravel()
    return STORE.types[COMPRESSED](header=header(stamp_ns), format=layout, data=data)


@pytest.mark.parametrize(
    ('topic', 'kind', 'message', 'says'),
    [
        ('/low/image_raw', IMAGE, image(5, encoding='32FC1'), "view 'low'.*TOPIC.*32FC1.*rgb8"),
        ('/low/image_raw/compressed', COMPRESSED, compressed(5, 'h264', np.zeros(9, np.uint8)),
         "TOPIC.*'h264' is not supported"),
    ],
)  # fmt: skip
def test_an_unknown_encoding_is_named_with_its_topic(foreign_bag, topic, kind, message, says):
    path = foreign_bag((topic, kind, 5, message))
    with pytest.raises(EpisodeError, match=says.replace('TOPIC', topic)):
        read(path)


def test_padded_rows_are_read(foreign_bag):
    data = np.array([1, 2, 3, 99, 99, 4, 5, 6, 99, 99], np.uint8)
    path = foreign_bag(('/low/image_raw', IMAGE, 5, image(5, step=5, data=data)))
    frames = read(path).images['low'].frames
    assert frames[0][..., 0].tolist() == [[1, 2, 3], [4, 5, 6]]


def test_bad_frames_are_left_out_and_counted(foreign_bag):
    path = foreign_bag(
        ('/low/image_raw', IMAGE, 1, image(1, step=2)),
        ('/low/image_raw', IMAGE, 2, image(2)),
        ('/low/image_raw', IMAGE, 3, image(3, data=np.zeros(4, np.uint8))),
    )
    episode = read(path)
    assert episode.images['low'].stamps_ns.tolist() == [2]
    assert len(episode.warnings) == 1
    assert '/low/image_raw' in episode.warnings[0]
    assert '2 messages were left out, the first: image of 3x2 mono8' in episode.warnings[0]


def test_stamps_of_the_headers_count_and_are_sorted(foreign_bag):
    path = foreign_bag(
        ('/low/image_raw', IMAGE, 100, image(30, 3)),
        ('/low/image_raw', IMAGE, 101, image(10, 1)),
        ('/low/image_raw', IMAGE, 102, image(20, 2)),
        ('/low/image_raw', IMAGE, 103, image(30, 4)),
    )
    episode = read(path)
    assert episode.images['low'].stamps_ns.tolist() == [10, 20, 30]
    assert np.asarray(episode.images['low'].frames)[:, 0, 0, 0].tolist() == [1, 2, 4]
    assert [text for text in episode.warnings if 'have been sorted' in text and '1 mess' in text]
    assert [text for text in episode.warnings if '1 stamps came twice' in text]


def test_log_times_stand_in_for_missing_stamps(foreign_bag):
    path = foreign_bag(
        ('/low/image_raw', IMAGE, 100, image(0)), ('/low/image_raw', IMAGE, 150, image(0))
    )
    episode = read(path)
    assert episode.images['low'].stamps_ns.tolist() == [100, 150]
    assert episode.warnings == ("'/low/image_raw': headers without stamp; log times are used",)


def test_topics_of_other_robots_are_mapped(foreign_bag):
    path = foreign_bag(
        ('/camera_low/color/image_raw', IMAGE, 1, image(1, 1)),
        ('/camera_low/color/camera_info', 'sensor_msgs/msg/CameraInfo', 1, camera_info(1)),
        ('/top/rgb', IMAGE, 1, image(1, 2)),
        ('/follower/joint_states', STATE, 1, joint_state(1, a=0.5)),
    )
    with pytest.raises(EpisodeError, match=r'image topics are /camera_low/color/image_raw, /top'):
        read(path)
    names = {'low': '/camera_low/color/image_raw', 'high': '/top/rgb'}
    episode = read(path, topics={**names, 'joint_states': '/follower/joint_states'})
    assert episode.views == ('low', 'high')
    assert episode.images['high'].frames[0][0, 0, 0] == 2
    assert episode.joint_states is not None
    with pytest.raises(
        EpisodeError, match=r"'joint_state' is neither.*did you mean 'joint_states'"
    ):
        read(path, views=['low'], topics={'low': '/a', 'joint_state': '/b'})


@pytest.mark.parametrize('named', ['/cam/image', '/cam/image/compressed'])
def test_a_mapped_topic_may_be_compressed(foreign_bag, named):
    path = foreign_bag(('/cam/image/compressed', COMPRESSED, 5, compressed(5, 'png')))
    assert read(path, topics={'low': named}).images['low'].frames[0][0, 0, 0] == 9


def test_raw_images_are_preferred_to_compressed_ones(foreign_bag):
    path = foreign_bag(
        ('/low/image_raw/compressed', COMPRESSED, 5, compressed(5, 'png')),
        ('/low/image_raw', IMAGE, 5, image(5, 7)),
    )
    assert read(path).images['low'].frames[0][0, 0, 0] == 7


def test_a_bag_without_states_commands_and_masks_is_read(foreign_bag):
    episode = read(foreign_bag(('/low/image_raw', IMAGE, 1, image(1))))
    assert (episode.joint_states, episode.trajectories, episode.masks) == (None, [], None)
    assert (episode.info.task, episode.info.outcome, episode.info.seed) == ('', 'unknown', None)


def test_the_instruction_topic_stands_in_for_metadata(foreign_bag):
    text = STORE.types['std_msgs/msg/String'](data='stack them')
    path = foreign_bag(
        ('/low/image_raw', IMAGE, 1, image(1)), ('/instruction', 'std_msgs/msg/String', 3, text)
    )
    assert read(path).info.instruction == 'stack them'
    assert read_info(path).instruction == 'stack them'


def test_bad_trajectories_are_left_out_with_the_reason(tmp_path):
    kind = 'trajectory_msgs/msg/JointTrajectory'
    point = STORE.types['trajectory_msgs/msg/JointTrajectoryPoint']
    duration = STORE.types['builtin_interfaces/msg/Duration']

    def command(stamp: int, times: list[int], values: list[list[float]]) -> bytes:
        points = [
            point(positions=np.array(row), velocities=np.empty(0), accelerations=np.empty(0),
                  effort=np.empty(0), time_from_start=duration(sec=second, nanosec=0))
            for second, row in zip(times, values, strict=True)
        ]  # fmt: skip
        message = STORE.types[kind](header=header(stamp), joint_names=['a'], points=points)
        return bytes(STORE.serialize_cdr(message, kind))

    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_raw('/low/image_raw', IMAGE, 1, messages.serialize(IMAGE, image(1)))
        for stamp, times, values in [
            (1, [], []),
            (2, [1, 1], [[0.0], [1.0]]),
            (3, [1, 2], [[0.0], [np.nan]]),
            (4, [1], [[0.0, 1.0]]),
            (5, [1, 2], [[0.0], [1.0]]),
        ]:
            writer.write_raw('/joint_trajectory', kind, stamp, command(stamp, times, values))
        writer.write_raw('/joint_trajectory', kind, 6, command(6, [1], [[0.0]])[:-30])
    episode = read(tmp_path / 'bag')
    assert [stamp for stamp, _ in episode.trajectories] == [5]
    assert '5 messages were left out' in episode.warnings[0]


def test_surplus_bytes_after_a_message_are_tolerated(tmp_path):
    # rclpy's serialize_message gives 76 bytes for a JointState of 68
    data = messages.serialize(STATE, joint_state(1, a=0.5)) + bytes(8)
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_raw('/low/image_raw', IMAGE, 1, messages.serialize(IMAGE, image(1)))
        writer.write_raw('/joint_states', STATE, 1, data)
    states = read(tmp_path / 'bag').joint_states
    assert states is not None
    assert states.positions.tolist() == [[0.5]]


def test_a_topic_of_another_type_is_not_taken(foreign_bag):
    path = foreign_bag(
        ('/low/image_raw', IMAGE, 1, image(1)), ('/joint_trajectory', IMAGE, 1, image(1))
    )
    episode = read(path)
    assert episode.trajectories == []
    assert 'expected trajectory_msgs/msg/JointTrajectory' in episode.warnings[0]


def test_camera_info_that_changes_within_an_episode_is_refused(foreign_bag, make_episode):
    kind = 'sensor_msgs/msg/CameraInfo'
    entries = [
        ('/low/camera_info', kind, n, camera_info(n, f)) for n, f in enumerate([50.0, 50.0])
    ]
    path = foreign_bag(('/low/image_raw', IMAGE, 1, image(1)), *entries)
    calibration = make_episode('other') / 'calibration.yaml'
    found = read_episode(path, calibration=calibration)
    low, given = found.cameras['low'], load_calibration(calibration)['low']
    assert (low.width, low.height) == (3, 2)
    assert low.K[0, 0] == pytest.approx(given.K[0, 0] * 3 / given.width)  # the file's, and said
    assert any('CameraInfo 50.0' in line for line in found.warnings)
    changed = ('/low/camera_info', kind, 9, camera_info(9, 60.0))
    path = foreign_bag(('/low/image_raw', IMAGE, 1, image(1)), *entries, changed, name='changed')
    with pytest.raises(CalibrationError, match='/low/camera_info.*changes at message 2'):
        read_episode(path, calibration=calibration)


def test_labels_that_ros2_bag_record_was_given_count(foreign_bag):
    path = foreign_bag(('/low/image_raw', IMAGE, 1, image(1)))
    content = yaml.safe_load((path / 'metadata.yaml').read_text())
    labels = {'task': 'stack', 'outcome': 'failure', 'operator': 'kim'}
    content['rosbag2_bagfile_information']['custom_data'] = labels
    (path / 'metadata.yaml').write_text(yaml.safe_dump(content))
    info = read(path).info
    assert (info.task, info.outcome, info.metadata) == ('stack', 'failure', {'operator': 'kim'})
    labels['outcome'] = 'won'
    (path / 'metadata.yaml').write_text(yaml.safe_dump(content))
    with pytest.raises(EpisodeError, match=r"'won' is not one of success, failure, unknown"):
        read(path)
