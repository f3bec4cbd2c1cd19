"""Reports 35 to 44 of docs/importing_cases.md, each as small valid input."""

from __future__ import annotations

import base64
import json
from pathlib import Path
import shutil

import cv2
from mcap.writer import Writer as McapWriter
import numpy as np
import pytest
import yaml

from mtv_world_ros.cli import main
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag_mapping import BagMapping
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.importing.hdf5_files import Hdf5Frames
from mtv_world_ros.importing.lerobot_episodes import import_dataset
from mtv_world_ros.viewing.video import encode_video
from test.support.robot_recordings import Event, events, FPS, JOINTS, ns, positions, SECONDS

parquet = pytest.importorskip('pyarrow.parquet', reason='pyarrow is not installed')


def joints_over_time(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the imported and the right positions of a recording of `robot_recordings`."""
    states = read_episode(folder).joint_states
    assert states is not None
    columns = [states.joint_names.index(name) for name in JOINTS]
    right = [positions((int(stamp) - ns(0)) / 1e9) for stamp in states.stamps_ns]
    return states.positions[:, columns], np.array(right)


# 35: ros2_controllers#402


def test_35_names_of_position_interfaces_are_those_of_joints(record, run, tmp_path):
    def interfaces(topic: str, _seconds: float, message) -> None:
        if topic == '/joint_states':
            message.name = [f'{n}/{kind}' for n in JOINTS for kind in ('position', 'velocity')]
            message.position = np.stack([message.position, np.full(8, 9.0)], axis=1).ravel()

    status, said = run(record(change=interfaces))
    assert status == 0, said
    assert 'panda_joint1/velocity' in said and 'no joint of the robot' in said
    found, right = joints_over_time(tmp_path / 'out/bag')
    np.testing.assert_allclose(found, right, atol=1e-9)


def test_35_a_renamed_joint_goes_before_the_interface():
    mapping = BagMapping(joints={'a/position': 'b', 'prefix': 'left_'})
    assert mapping.joint_name('a/position') == 'b'
    assert mapping.joint_name('left_elbow/position') == 'elbow'


# 36: PlotJuggler#613, #1373


def test_36_joint_states_without_names_are_refused_and_the_advice_works(record, run, tmp_path):
    def nameless(topic: str, _seconds: float, message) -> None:
        if topic == '/joint_states':
            message.name = []

    bag = record(change=nameless)
    status, said = run(bag)
    assert status == 1
    assert "have 8 positions and no names; 'state_joints' in the mapping (--topics) must" in said
    status, said = run(bag, state_joints=JOINTS[:7])
    assert status == 1 and 'must name as many' in said
    status, said = run(bag, state_joints=JOINTS)
    assert status == 0, said
    found, right = joints_over_time(tmp_path / 'out/bag')
    np.testing.assert_allclose(found, right, atol=1e-9)


# 37: rosbag2video#27, 38: realsense-ros#2361, rtabmap_ros#509


def test_37_guessed_views_have_colours(record, tmp_path, capsys):
    more: list[Event] = []
    for k in range(round(SECONDS * FPS)):
        header = messages.make_header(ns(k / FPS), 'lidar')
        image = messages.make(
            messages.IMAGE, header=header, height=24, width=32, encoding='32FC1', is_bigendian=0,
            step=128, data=np.full(24 * 32, 2.5, np.float32).view(np.uint8),
        )  # fmt: skip
        more.append((k / FPS, '/lidar/range_image', messages.IMAGE, image))
    out = tmp_path / 'out'
    command = ['import', 'bag', str(record(more=more)), '--robot', 'franka', '--out', str(out)]
    assert main(command) == 0
    assert '/lidar/range_image' in capsys.readouterr().err
    assert set(read_episode(out / 'bag').views) == {'front', 'side'}


def test_38_depth_as_jpeg_or_in_compressed_depth_is_no_view(record, tmp_path, capsys):
    depth = np.full((24, 32), 2500, np.uint16)
    png = cv2.imencode('.png', depth)[1].tobytes()
    jpeg = cv2.imencode('.jpg', (depth / 255).astype(np.uint8))[1].tobytes()
    topics = {
        '/camera/aligned_depth_to_color/image_raw/compressed': ('16UC1; jpeg compressed ', jpeg),
        '/data_throttled_image_depth/compressedDepth': (
            '16UC1; compressedDepth',
            b'\0' * 12 + png,
        ),
    }
    more: list[Event] = [
        (k / FPS, topic, messages.COMPRESSED_IMAGE,
         messages.make_compressed(ns(k / FPS), 'x', data, layout))
        for k in range(10) for topic, (layout, data) in topics.items()
    ]  # fmt: skip
    out = tmp_path / 'out'
    command = ['import', 'bag', str(record(more=more)), '--robot', 'franka', '--out', str(out)]
    assert main(command) == 0
    said = capsys.readouterr().err
    assert all(topic in said for topic in topics) and 'no colour images, by its name' in said
    assert set(read_episode(out / 'bag').views) == {'front', 'side'}


# 39: bagpy#14 is in test_other_recorders.py; 40: RoboTwin#438


@pytest.mark.parametrize('stored', ['S', 'V'])
def test_40_pictures_that_opencv_stored_with_red_and_blue_exchanged(tmp_path, stored):
    h5py = pytest.importorskip('h5py', reason='h5py is not installed')
    red = np.full((48, 64, 3), (200, 60, 20), np.uint8)
    # RoboTwin gives RGB to cv2.imencode, and pads the files to one length
    file = cv2.imencode('.jpg', red, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    with h5py.File(tmp_path / 'a.hdf5', 'w') as root:
        padded = np.array([file.ljust(len(file) + 5, b'\0')] * 3, f'{stored}{len(file) + 5}')
        root['observation/head_camera/rgb'] = padded
    place = tmp_path / 'a.hdf5', 'observation/head_camera/rgb'
    np.testing.assert_allclose(Hdf5Frames(*place)[0].mean((0, 1)), [20, 60, 200], atol=3)
    frames = Hdf5Frames(*place, is_bgr=True)
    np.testing.assert_allclose(frames[2].mean((0, 1)), [200, 60, 20], atol=3)


# 41: lerobot#1449 is in test_import_hdf5.py; 42: starVLA#285, 43: lerobot-doctor#7


def test_42_videos_are_in_other_files_than_the_rows(datasets, make_mapping, tmp_path):
    """Each episode's video is a file of its own, the rows of both are in one."""
    root = Path(shutil.copytree(datasets('v3.0'), tmp_path / 'set'))
    table = root / 'meta/episodes/chunk-000/file-000.parquet'
    rows = parquet.read_table(table).to_pylist()
    key = 'observation.images.front'
    own = root / f'videos/{key}/chunk-000/file-001.mp4'
    own.write_bytes(encode_video(np.stack(
        [np.full((48, 64, 3), 23 + 16 * k, np.uint8) for k in range(9)]), 10))  # fmt: skip
    rows[1] |= {f'videos/{key}/file_index': 1, f'videos/{key}/from_timestamp': 0.0,
                f'videos/{key}/to_timestamp': 0.9}  # fmt: skip
    import pyarrow

    parquet.write_table(pyarrow.Table.from_pylist(rows), table)
    summary = import_dataset(root, make_mapping(), tmp_path / 'out')
    assert summary.made == [0, 1], summary.failed
    for number, count in ((0, 12), (1, 9)):
        path = tmp_path / f'out/episode_{number:06d}'
        frames = read_episode(path, with_cameras=False).images['front'].frames
        levels = [float(np.asarray(frame).mean()) for frame in frames]
        np.testing.assert_allclose(levels, 20 + 3 * number + 16 * np.arange(count), atol=5)


def test_43_a_video_lasts_one_period_longer_than_its_rows(datasets, make_mapping, tmp_path):
    """34 frames at 5 Hz last 6.8 s, and the last row is at 6.6 s: no drift, and not a word."""
    summary = import_dataset(datasets('v2.1'), make_mapping(), tmp_path / 'out')
    assert summary.made == [0, 1]
    said = [line for lines in summary.warnings.values() for line in lines]
    assert not [line for line in said if 'shifted' in line or 'duration' in line or ' s ' in line]


# 44: PlotJuggler#46, ros_comm#330


@pytest.mark.parametrize('kind', ['pandas', 'rostopic'])
def test_44_tables_of_pandas_and_rostopic(tmp_path, capsys, kind):
    count = 20
    rows = np.stack([positions(k / 10) for k in range(count)])
    raw = tmp_path / 'raw'
    raw.mkdir()
    frames = np.stack([np.full((48, 64, 3), 20 + 8 * k, np.uint8) for k in range(count)])
    (raw / 'a.mp4').write_bytes(encode_video(frames, 10))
    texts = [','.join(map(str, row)) for row in rows.tolist()]
    if kind == 'pandas':  # DataFrame.to_csv has an index without a name
        head, columns = ',' + ','.join(JOINTS), JOINTS
        lines = [f'{k},{text}' for k, text in enumerate(texts)]
        more = {'fps': 10}
    else:  # rostopic echo -p: names are texts in columns of their own
        columns = [f'field.position{k}' for k in range(8)]
        head = ','.join(['%time', 'field.header.frame_id', 'field.name0', *columns])
        lines = [f'{ns(k / 10)},,{JOINTS[0]},{text}' for k, text in enumerate(texts)]
        more = {'time': '%time', 'time_unit': 'ns'}
    (raw / 'a.csv').write_text('\n'.join([head, *lines]) + '\n')
    mapping = tmp_path / 'm.yaml'
    mapping.write_text(yaml.safe_dump({
        'robot': 'franka', 'rows': '{name}.csv', 'views': {'front': '{name}.mp4'},
        'state': {'feature': '', 'joints': dict(zip(JOINTS, columns, strict=True))}, **more,
    }))  # fmt: skip
    out = tmp_path / 'out'
    assert main(['import', 'videos', str(raw), '--mapping', str(mapping), '--out', str(out)]) == 0
    said = capsys.readouterr().err
    assert 'field.name0' in said or kind == 'pandas'
    states = read_episode(out / 'a', unknown_mount='panda_link0').joint_states
    assert states is not None
    np.testing.assert_allclose(states.positions, rows, atol=1e-9)
    np.testing.assert_allclose(np.diff(states.stamps_ns), 1e8, rtol=1e-5)


# JSON, as in mcap#1198


@pytest.mark.parametrize('schema', ['foxglove.CompressedImage', 'lab.Image'])
def test_json_of_foxgloves_schemas_is_read_and_others_are_named(tmp_path, capsys, schema):
    path = tmp_path / 'fox.mcap'
    with path.open('wb') as file:
        writer = McapWriter(file)
        writer.start()
        topics: dict[str, int] = {}
        for t, topic, kind, message in sorted(events(), key=lambda each: each[0]):
            stamp_ns = ns(t)
            if kind != messages.COMPRESSED_IMAGE:
                if topic not in topics:
                    text = messages.definition(kind).encode()
                    number = writer.register_schema(kind, 'ros2msg', text)
                    topics[topic] = writer.register_channel(topic, 'cdr', number)
                data = messages.serialize(kind, message)
                writer.add_message(topics[topic], stamp_ns, data, stamp_ns)
                continue
            if topic not in topics:
                number = writer.register_schema(schema, 'jsonschema', b'{}')
                topics[topic] = writer.register_channel(topic, 'json', number)
            stamp = message.header.stamp
            told = {
                'timestamp': {'sec': stamp.sec, 'nsec': stamp.nanosec},
                'frame_id': message.header.frame_id, 'format': 'jpeg',
                'data': base64.b64encode(bytes(message.data)).decode(),
            }  # fmt: skip
            writer.add_message(topics[topic], stamp_ns, json.dumps(told).encode(), stamp_ns)
        writer.finish()
    out = str(tmp_path / 'out')
    status = main(['import', 'bag', str(path), '--robot', 'franka', '--out', out])
    if schema == 'lab.Image':
        assert status == 1
        said = capsys.readouterr().err
        assert "'/front/image_raw/compressed' was left out: its JSON schema 'lab.Image'" in said
        return
    assert status == 0
    frames = read_episode(tmp_path / 'out/fox').images['front'].frames
    assert len(frames) == SECONDS * FPS
    np.testing.assert_allclose(np.asarray(frames[0]).mean(), 90, atol=2)


def test_every_row_of_the_log_has_a_link():
    page = share_path('config').parent / 'docs/importing_cases.md'
    rows = [line for line in page.read_text().splitlines() if line.startswith('| ')]
    numbered = {line.split('|')[1].strip(): line for line in rows if line[2].isdigit()}
    assert all('https://github.com/' in numbered[str(k)] for k in range(35, 45))
