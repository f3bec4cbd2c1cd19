"""What comes from outside is read in bounded time and memory, or refused with a reason."""

from __future__ import annotations

from dataclasses import fields
import io
import json
import os
import re
import struct
import time
import tracemalloc

import cv2
from mcap.writer import CompressionType, Writer
import numpy as np
import pytest
import yaml

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.core.bounded_input import (
    fill_template,
    Limits,
    limits,
    parse_yaml,
    read_bytes,
    read_json,
)
from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.errors import (
    CalibrationError,
    ConfigError,
    ObservationError,
    TrajectoryError,
)
from mtv_world_ros.core.files import bundled, share_path
from mtv_world_ros.data.bag.image_decoding import compressed_to_rgb
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.resample import match_joints
from mtv_world_ros.success.task import load_tasks, match_task
from mtv_world_ros.vision.describers.describer import objects_from_instruction

MOST_S = 2.0
YAML = {
    'deep': '[' * 100_000,
    'deep maps': '\n'.join(' ' * level + 'a:' for level in range(2000)),
    'laughs': 'a0: &a0 [1,1,1,1,1,1,1,1,1]\n'
    + '\n'.join(f'a{n + 1}: &a{n + 1} [{",".join([f"*a{n}"] * 9)}]' for n in range(9)),
    'merges': 'a0: &a0 {k: 1}\n'
    + '\n'.join(f'a{n + 1}: &a{n + 1} {{<<: [{",".join([f"*a{n}"] * 9)}]}}' for n in range(9)),
    'recursive': '&a [*a]',
    'not a time': '!!timestamp x',
    'no digits': '!!int ""',
    'digits': '9' * 100_000,
    'sixties': '1' + ':59' * 100_000,
    'too long': '#' * 5_000_000,
    'zero byte': '\0',
}


@pytest.fixture(autouse=True)
def clock():
    begin = time.process_time()
    yield
    assert time.process_time() - begin < MOST_S


@pytest.mark.parametrize('name', YAML)
def test_yaml_that_costs_too_much_is_refused(name):
    with pytest.raises(yaml.YAMLError):
        parse_yaml(YAML[name])


def test_yaml_with_aliases_and_merges_is_read_as_before():
    text = 'a: &a {k: [1, 2.5, yes, 2020-01-01]}\nb: {<<: *a, c: *a}\n'
    assert parse_yaml(text) == yaml.safe_load(text)


def test_a_key_that_a_mapping_has_twice_is_named_with_its_lines():
    for text in ('a: 1\nb: 2\na: 3', 'top:\n  a: 1\n  a: 3', '- {b: 1,\n   a: 1}\n- {b: 1, b: 2}'):
        with pytest.raises(yaml.YAMLError, match=r"'[ab]' is there twice, in lines \d and 3"):
            parse_yaml(text)
    merged = 'x: &x {b: 1}\na: {inner: &c {<<: *x, b: 2}}\nd: {<<: *c, b: 3}\n1: one\n"1": two'
    assert parse_yaml(merged) == yaml.safe_load(merged)


@pytest.mark.parametrize('value', ['-.inf', '.nan', '1e400', '[' * 5000, '"x"', '2**9'])
def test_a_calibration_with_a_wild_size_is_a_clear_error(tmp_path, value):
    file = tmp_path / 'calibration.yaml'
    file.write_text(
        f'views: {{low: {{width: {value}, height: 480, K: [90, 90, 47, 35], mount_link: base, '
        'position: [0, 0, 1], quaternion_xyzw: [0, 0, 0, 1]}}'
    )
    with pytest.raises(CalibrationError, match=r'calibration\.yaml'):
        load_calibration(file)


@pytest.mark.parametrize(
    'change',
    [
        {'K': [90, 1e-3, 47, 35]},
        {'distortion_model': 'plumb_bob', 'distortion': [float('nan')] * 5},
        {'distortion_model': 'plumb_bob', 'distortion': [1e30, 0, 0, 0, 0]},
        {'position': [0, 0, 1e9]},
        {'position': [0, 0, float('inf')]},
        {'width': 10**9},
    ],
)
def test_a_calibration_that_no_camera_has_is_refused(tmp_path, change):
    row = {
        'width': 96,
        'height': 72,
        'K': [90, 90, 47, 35],
        'mount_link': 'base',
        'position': [0, 0, 1],
        'quaternion_xyzw': [0, 0, 0, 1],
    }
    file = tmp_path / 'calibration.yaml'
    file.write_text(yaml.safe_dump({'views': {'low': row}}))
    assert load_calibration(file)['low'].width == 96
    file.write_text(yaml.safe_dump({'views': {'low': row | change}}))
    with pytest.raises(CalibrationError, match='low'):
        load_calibration(file)


def test_pipes_devices_and_folders_are_no_files(tmp_path):
    os.mkfifo(tmp_path / 'pipe.yaml')
    for path in (tmp_path / 'pipe.yaml', '/dev/zero', tmp_path):
        with pytest.raises(OSError, match=r'regular file|directory'):
            read_bytes(path, 'yaml_bytes')
    with pytest.raises(CalibrationError, match='regular file'):
        load_calibration(tmp_path / 'pipe.yaml')


def test_a_urdf_that_cannot_be_opened_is_a_clear_error(tmp_path):
    """Found by the fuzz: `Path.is_file` raises for a name that is too long."""
    robot = bundled('robots', 'yam_bimanual', 'robot_file').read_text()
    values = yaml.safe_load(robot)
    os.mkfifo(tmp_path / 'pipe.urdf')
    for name in ('9' * 5000, 'pipe.urdf', 'missing.urdf'):
        (tmp_path / 'robot.yaml').write_text(yaml.safe_dump(values | {'urdf': name}))
        with pytest.raises(ConfigError, match='URDF file'):
            load_robot(tmp_path / 'robot.yaml')


def test_json_is_bounded(tmp_path, monkeypatch):
    file = tmp_path / 'deep.json'
    file.write_text('[' * 1_000_000)
    with pytest.raises(ValueError, match='nested'):
        read_json(file)
    monkeypatch.setenv('MTV_WORLD_MAX_JSON_BYTES', '10')
    file.write_text(json.dumps(list(range(10))))
    with pytest.raises(ValueError, match='MTV_WORLD_MAX_JSON_BYTES'):
        read_json(file)


def test_every_limit_is_documented():
    page = share_path('docs', 'troubleshooting.md').read_text()
    words = Limits.__doc__ or ''
    entries = re.findall(r'^ +(\w+): ((?:.+\n)(?: {12}.+\n)*)', words, re.MULTILINE)
    texts = {name: ' '.join(text.split()).rstrip('.') for name, text in entries}
    for field in fields(Limits):
        variable, text = f'MTV_WORLD_MAX_{field.name.upper()}', texts[field.name]
        assert f'| `{variable}` | {field.default} | {text} |' in page


@pytest.mark.parametrize('text', ['', '-1', '0', 'many', '1e6', '٣'])
def test_a_limit_that_is_no_number_is_an_error(monkeypatch, text):
    monkeypatch.setenv('MTV_WORLD_MAX_YAML_NODES', text)
    with pytest.raises(ConfigError, match='MTV_WORLD_MAX_YAML_NODES'):
        limits()


def test_a_long_instruction_is_matched_in_bounded_time():
    tasks = load_tasks(share_path('config', 'tasks'))
    words = ('put the red block on the blue block and then ' * 400)[:15_000]
    for text in (words, 'put the ' + 'a ' * 7000, 'put the ' * 1900, 'stack the' + ' ' * 15_000):
        match_task(tasks, text)
        objects_from_instruction(text)
    assert match_task(tasks, 'stack the red block on the blue block') is not None


def test_many_joint_names_are_refused_at_once():
    robot = load_robot(bundled('robots', 'yam_bimanual', 'robot_file'))
    names = tuple(f'joint{n}' for n in range(20_000))
    plan = JointTrajectory(joint_names=names, times=[1.0], positions=np.zeros((1, 20_000)))
    with pytest.raises(TrajectoryError, match='20000 names'):
        match_joints(plan, robot)


def jpeg(size=(48, 64), **options) -> bytes:
    pixels = np.random.default_rng(0).integers(0, 255, (*size, 3), dtype=np.uint8)
    return cv2.imencode('.jpg', cv2.GaussianBlur(pixels, (0, 0), 2))[1].tobytes()


def read(data: bytes):
    return compressed_to_rgb('jpeg', np.frombuffer(data, np.uint8))


@pytest.mark.parametrize('side', [20_000, 65_500])
def test_the_header_of_a_jpeg_is_looked_at_before_it_is_decoded(side):
    data = jpeg()
    at = data.index(b'\xff\xc0') + 5
    bomb = data[:at] + struct.pack('>HH', side, side) + data[at + 4 :]
    tracemalloc.start()
    with pytest.raises(ObservationError, match=f'{side}x{side}'):
        read(bomb)
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


def test_the_header_of_a_png_is_looked_at_and_its_checksums():
    data = bytearray(cv2.imencode('.png', np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    assert read(bytes(data)).shape == (8, 8, 3)
    for at in (20, len(data) // 2, len(data) - 20):
        broken = data.copy()
        broken[at] ^= 1
        with pytest.raises(ObservationError, match='damaged'):
            read(bytes(broken))


@pytest.mark.parametrize('share', [0.2, 0.5, 0.9])
def test_a_jpeg_cut_short_is_refused_though_its_end_mark_is_there(share):
    data = jpeg()
    assert read(data).shape == (48, 64, 3)
    body = data.index(b'\xff\xda')
    cut = data[: body + int(share * (len(data) - body))] + b'\xff\xd9'
    with pytest.raises(ObservationError, match='damaged'):
        read(cut)


def test_jpegs_are_decoded_as_opencv_does():
    data = np.frombuffer(jpeg((97, 131)), np.uint8)
    np.testing.assert_array_equal(read(data.tobytes())[..., ::-1], cv2.imdecode(data, 1))


def test_bytes_before_the_end_mark_are_what_some_cameras_write():
    data = jpeg()
    np.testing.assert_array_equal(read(data[:-2] + b'\x00\x01\xff\xd9'), read(data))


@pytest.mark.parametrize('kind', [CompressionType.ZSTD, CompressionType.LZ4])
@pytest.mark.parametrize('stated', ['small', 'huge', 'true'])
def test_a_chunk_is_not_inflated_beyond_what_it_states(tmp_path, kind, stated):
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=2**30, compression=kind)
    writer.start(profile='ros2')
    schema = writer.register_schema('std_msgs/msg/String', 'ros2msg', b'string data')
    channel = writer.register_channel('/a', 'cdr', schema)
    writer.add_message(channel, 0, bytes(300 * 2**20), 0)
    writer.finish()
    content = bytearray(stream.getvalue())
    del stream
    at = content.index(b'\x06', 8)  # the chunk's opcode
    while struct.unpack_from('<Q', content, at + 1)[0] > len(content):
        at = content.index(b'\x06', at + 1)
    if stated != 'true':
        struct.pack_into('<Q', content, at + 9 + 16, 100 if stated == 'small' else 2**62)
    (tmp_path / 'bomb.mcap').write_bytes(content)
    tracemalloc.start()
    reader = BagReader(tmp_path / 'bomb.mcap')
    assert list(reader.messages()) == []
    assert 'cut off or damaged' in reader.truncated
    assert tracemalloc.get_traced_memory()[1] < 20 * 2**20
    tracemalloc.stop()


@pytest.mark.parametrize(
    'text',
    [
        'rosbag2_bagfile_information: {relative_file_paths: [3, {a: b}], custom_data: [1]}',
        'rosbag2_bagfile_information: 7',
        '&a [*a]',
        'rosbag2_bagfile_information: {relative_file_paths: x}',
    ],
)
def test_wild_metadata_is_a_problem_not_an_error(tmp_path, text):
    writer = Writer(str(tmp_path / 'a.mcap'))
    writer.start()
    writer.finish()
    os.mkfifo(tmp_path / 'b.mcap')
    (tmp_path / 'metadata.yaml').write_text(text)
    assert list(BagReader(tmp_path).messages()) == []


@pytest.mark.parametrize(
    ('template', 'text'),
    [
        ('chunk-{chunk:03d}/episode_{episode:06d}.mp4', 'chunk-007/episode_000042.mp4'),
        ('{key}/{chunk}-{chunk:4d}', 'front/7-   7'),
        ('a {{b}} {{{chunk}}}', 'a {b} {7}'),
        ('', ''),
    ],
)  # fmt: skip
def test_a_template_has_fields_of_texts_and_whole_numbers(template, text):
    values = {'chunk': 7, 'episode': 42, 'key': 'front'}
    assert fill_template(template, values) == text
    assert template.format(**values) == text  # as LeRobot fills them


@pytest.mark.parametrize(
    'template',
    [
        '{episode:>3000000000}',
        '{episode:03000000000d}',
        '{episode:100d}',
        '{episode:{episode}d}',
        '{episode!r}',
        '{episode.real}',
        '{episode.__class__.__mro__}',
        '{key[0]}',
        '{key:06d}',
        '{0}',
        '{}',
        '{other}',
        '{',
        '}',
        '{episode',
        'episode}',
        '{episode:.2f}',
        'x' * 5000,
        7,
        None,
        ['{episode}'],
    ],
)
def test_a_template_with_anything_else_is_refused_in_time_and_memory(template):
    tracemalloc.start()
    begin_s = time.process_time()
    with pytest.raises(ValueError, match='no field|whole number|no text|characters'):
        fill_template(template, {'episode': 42, 'key': 'front'})
    assert time.process_time() - begin_s < MOST_S
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()
