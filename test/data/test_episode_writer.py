from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import cv2
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
import numpy as np
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import get_typestore, Stores
import yaml

from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.episode_writer import EpisodeWriter

START_NS, PERIOD_NS, FRAMES = 1_700_000_000_000_000_000, 100_000_000, 8
JOINTS = ['left_joint1', 'left_joint2', 'left_gripper']


def by_topic_with_rosbags(path: Path) -> dict[str, list]:
    store = get_typestore(Stores.ROS2_JAZZY)
    found: dict[str, list] = {}
    with Reader(path) as reader:
        for connection, stamp, data in reader.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((stamp, message))
    return found


def by_topic_with_mcap_ros2(path: Path) -> dict[str, list]:
    found: dict[str, list] = {}
    with (path / f'{path.name}_0.mcap').open('rb') as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def profiles_of(reader: Reader) -> dict[str, Any]:
    """Offered profile of each topic."""
    return {c.topic: cast('Any', c.ext).offered_qos_profiles[0] for c in reader.connections}


@pytest.mark.parametrize('read', [by_topic_with_rosbags, by_topic_with_mcap_ros2])
def test_independent_readers_find_every_value_that_was_written(read, episode_path):
    found = read(episode_path)
    assert {topic: len(items) for topic, items in found.items()} == {
        '/instruction': 1,
        '/tf_static': 1,
        '/joint_trajectory': 1,
        '/joint_states': FRAMES,
        **{
            f'/{view}/{kind}': FRAMES
            for view in ('low', 'high')
            for kind in ('image_raw/compressed', 'mask/compressed', 'camera_info')
        },
    }
    for index, (log_time, state) in enumerate(found['/joint_states']):
        assert log_time == START_NS + index * PERIOD_NS
        assert state.header.stamp.sec * 10**9 + state.header.stamp.nanosec == log_time
        assert list(state.name) == JOINTS
        np.testing.assert_array_equal(state.position, [index, index / 3, -index])
    assert found['/instruction'][0][1].data == 'stack the red block on the blue block'
    commanded = found['/joint_trajectory'][0][1]
    starts = [p.time_from_start.sec + p.time_from_start.nanosec * 1e-9 for p in commanded.points]
    np.testing.assert_allclose(starts, [0.1, 0.25, 0.5], atol=1e-9)
    np.testing.assert_array_equal(commanded.points[2].positions, np.arange(6.0, 9.0) / 7)
    np.testing.assert_array_equal(commanded.points[2].velocities, np.arange(6.0, 9.0) / 7 * 2)
    info = found['/low/camera_info'][0][1]
    assert (info.width, info.height, info.distortion_model) == (64, 48, 'plumb_bob')
    assert info.header.frame_id == 'low_optical_frame'
    np.testing.assert_allclose(info.k, [70.4, 0, 32, 0, 71.4, 24, 0, 0, 1])
    np.testing.assert_allclose(info.p, [70.4, 0, 32, 0, 0, 71.4, 24, 0, 0, 0, 1, 0])


@pytest.mark.parametrize('read', [by_topic_with_rosbags, by_topic_with_mcap_ros2])
def test_masks_are_exact_and_jpegs_close(read, episode_path):
    found = read(episode_path)
    mask = found['/high/mask/compressed'][3][1]
    ids = cv2.imdecode(np.frombuffer(mask.data, np.uint8), cv2.IMREAD_UNCHANGED)
    expected = np.zeros((48, 64), np.uint8)
    expected[5:15, 8:23], expected[30:40, 30:50] = 1, 2
    np.testing.assert_array_equal(ids, expected)
    image = found['/high/image_raw/compressed'][3][1]
    assert image.format == 'rgb8; jpeg compressed bgr8'
    bgr = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
    assert abs(bgr[24, 2] - np.array([60.0, 96.0, 36.0])).max() < 6


def test_raw_images_are_exact(make_episode):
    path = make_episode('raw', compressed=False)
    message = by_topic_with_rosbags(path)['/low/image_raw'][2][1]
    assert (message.encoding, message.width, message.height, message.step) == ('rgb8', 64, 48, 192)
    assert message.data.reshape(48, 64, 3)[10, 20].tolist() == [80, 40, 40]


@pytest.mark.filterwarnings('ignore::DeprecationWarning')
def test_ros_itself_reads_the_recorded_bytes(episode_path):
    serialization = pytest.importorskip('rclpy.serialization')
    from sensor_msgs.msg import CameraInfo, CompressedImage, JointState
    from std_msgs.msg import String
    from trajectory_msgs.msg import JointTrajectory as TrajectoryMessage

    kinds = (CameraInfo, CompressedImage, JointState, String, TrajectoryMessage)
    types = {f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}': kind for kind in kinds}
    last = {
        message.topic: serialization.deserialize_message(message.data, types[message.msgtype])
        for message in BagReader(episode_path).messages()
        if message.topic != '/tf_static'  # tf2_msgs has no wheel
    }
    assert last['/instruction'].data == 'stack the red block on the blue block'
    assert list(last['/joint_states'].position) == [7.0, 7 / 3, -7.0]
    assert list(last['/low/camera_info'].k) == [70.4, 0, 32, 0, 71.4, 24, 0, 0, 1]
    assert len(last['/joint_trajectory'].points) == 3
    assert bytes(last['/low/mask/compressed'].data[:4]) == b'\x89PNG'


def test_metadata_yaml_is_version_9_and_counts_what_is_there(episode_path):
    content = yaml.safe_load((episode_path / 'metadata.yaml').read_text())
    information = content['rosbag2_bagfile_information']
    assert information['version'] == 9
    assert information['storage_identifier'] == 'mcap'
    assert information['relative_file_paths'] == ['episode_0.mcap']
    assert information['message_count'] == 3 + 7 * FRAMES
    assert information['starting_time'] == {'nanoseconds_since_epoch': START_NS}
    assert information['duration'] == {'nanoseconds': 7 * PERIOD_NS}
    assert information['files'][0]['message_count'] == 3 + 7 * FRAMES
    assert information['compression_mode'] == information['compression_format'] == ''
    counts = {
        entry['topic_metadata']['name']: entry['message_count']
        for entry in information['topics_with_message_count']
    }
    assert counts['/instruction'] == 1
    assert counts['/high/mask/compressed'] == FRAMES
    assert '&' not in (episode_path / 'metadata.yaml').read_text()


def test_the_instruction_is_offered_latched_in_yaml_and_channel(episode_path):
    content = yaml.safe_load((episode_path / 'metadata.yaml').read_text())
    entries = content['rosbag2_bagfile_information']['topics_with_message_count']
    offered = {e['topic_metadata']['name']: e['topic_metadata'] for e in entries}
    profile = offered['/instruction']['offered_qos_profiles'][0]
    assert (profile['durability'], profile['reliability']) == ('transient_local', 'reliable')
    assert (profile['history'], profile['depth']) == ('keep_last', 1)
    assert profile['deadline'] == {'sec': 9223372036, 'nsec': 854775807}
    assert offered['/joint_states']['offered_qos_profiles'][0]['durability'] == 'volatile'
    with Reader(episode_path) as reader:
        profiles = profiles_of(reader)
    assert profiles['/instruction'].durability.name == 'TRANSIENT_LOCAL'
    with (episode_path / 'episode_0.mcap').open('rb') as stream:
        summary = make_reader(stream).get_summary()
    channels = {channel.topic: channel for channel in summary.channels.values()}
    in_channel = yaml.safe_load(channels['/instruction'].metadata['offered_qos_profiles'])
    assert in_channel == offered['/instruction']['offered_qos_profiles']


def test_the_mcap_file_is_what_foxglove_and_rosbag2_expect(episode_path):
    with (episode_path / 'episode_0.mcap').open('rb') as stream:
        reader = make_reader(stream)
        header, summary = reader.get_header(), reader.get_summary()
        records = {record.name: record.metadata for record in reader.iter_metadata()}
    assert header.profile == 'ros2'
    assert {channel.message_encoding for channel in summary.channels.values()} == {'cdr'}
    assert {schema.encoding for schema in summary.schemas.values()} == {'ros2msg'}
    assert {schema.name for schema in summary.schemas.values()} == {
        'sensor_msgs/msg/CompressedImage',
        'sensor_msgs/msg/CameraInfo',
        'sensor_msgs/msg/JointState',
        'trajectory_msgs/msg/JointTrajectory',
        'std_msgs/msg/String',
        'tf2_msgs/msg/TFMessage',
    }
    assert summary.statistics.message_count == 3 + 7 * FRAMES
    assert {index.compression for index in summary.chunk_indexes} == {'zstd'}
    assert records['mtv_world'] == {
        'task': 'stack_blocks_two',
        'outcome': 'success',
        'seed': '7',
        'objects': '["red block", "blue block"]',
        'instruction': 'stack the red block on the blue block',
        'robot': 'yam_bimanual',
        'simulator': 'test',
    }
    recorded = yaml.safe_load(records['rosbag2']['serialized_metadata'])
    content = yaml.safe_load((episode_path / 'metadata.yaml').read_text())
    assert recorded == content['rosbag2_bagfile_information']
    assert recorded['custom_data'] == records['mtv_world']


def test_type_hashes_are_those_of_ros():
    # `ros2 topic info -v` of a std_msgs/String publisher prints this one
    assert messages.type_hash('std_msgs/msg/String') == (
        'RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18'
    )


def test_an_unknown_outcome_drops_the_episode(tmp_path):
    with pytest.raises(EpisodeError, match=r"'sucess' is not one of .*did you mean 'success'"):
        _record_with_outcome(tmp_path / 'episode', 'sucess')
    assert list(tmp_path.iterdir()) == []


def test_metadata_keys_of_the_episode_cannot_be_shadowed(tmp_path):
    writer = _writer(tmp_path / 'episode', metadata={'task': 'another'})
    with pytest.raises(EpisodeError, match=r"keys \['task'\]"):
        writer.close()
    assert list(tmp_path.iterdir()) == []


def test_text_of_any_language_survives(tmp_path):
    text = 'lege den »roten« Würfel: links\n# 红色'
    with _writer(tmp_path / 'episode', metadata={'note': text}) as writer:
        writer.write_instruction(0, text)
    content = yaml.safe_load((tmp_path / 'episode' / 'metadata.yaml').read_text(encoding='utf-8'))
    assert content['rosbag2_bagfile_information']['custom_data']['note'] == text
    assert by_topic_with_mcap_ros2(tmp_path / 'episode')['/instruction'][0][1].data == text


def test_a_trajectory_without_velocities_has_none(tmp_path):
    plain = JointTrajectory(joint_names=['a'], times=[0.0, 1.5], positions=[[1.0], [2.0]])
    with _writer(tmp_path / 'episode') as writer:
        writer.write_trajectory(0, plain)
    message = by_topic_with_mcap_ros2(tmp_path / 'episode')['/joint_trajectory'][0][1]
    assert [len(point.velocities) for point in message.points] == [0, 0]
    assert message.points[1].time_from_start.nanosec == 500_000_000


def _writer(path: Path, **options) -> EpisodeWriter:
    return EpisodeWriter(path, task='t', instruction='i', robot='r', **options)


def _record_with_outcome(path: Path, outcome: str) -> None:
    with _writer(path) as writer:
        writer.outcome = outcome
