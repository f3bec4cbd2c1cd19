"""Inputs that once crashed, hung, filled the memory or were believed: kept, and refused now."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from contextlib import closing
from functools import partial
import io
from pathlib import Path
import re
import sqlite3
import struct
import tempfile
from typing import Any

import cv2
from mcap.writer import CompressionType, Writer
import msgpack
import numpy as np
import yaml
import zstandard

from mtv_world_ros.core.files import share_path
from robustness.file_kinds import KINDS, timed_actions
from robustness.node_messages import ros, whole


def calibration(text: str, instead: str) -> bytes:
    """The bundled cameras with one thing replaced."""
    whole = share_path('config', 'robots', 'yam_bimanual', 'cameras.yaml').read_text()
    assert text in whole
    return whole.replace(text, instead, 1).encode()


def calibrated(**values: Any) -> bytes:
    """One camera with some values of its own."""
    view = {
        'width': 96,
        'height': 72,
        'K': [90.0, 90.0, 47.5, 35.5],
        'mount_link': 'base',
        'position': [0, 1, 1],
        'quaternion_xyzw': [0, 0, 0, 1],
    }
    return yaml.safe_dump({'views': {'low': {**view, **values}}}).encode()


def alias_bomb() -> bytes:
    """Nine levels of ten aliases."""
    lines = ['a0: &a0 [x]'] + [
        f'a{n}: &a{n} [{", ".join([f"*a{n - 1}"] * 10)}]' for n in range(1, 10)
    ]
    return '\n'.join(lines).encode()


def merge_bomb() -> bytes:
    """Maps that merge maps that merge maps."""
    lines = ['a0: &a0 {x: 1}']
    for n in range(1, 25):
        lines.append(f'a{n}: &a{n} {{<<: [*a{n - 1}, *a{n - 1}], k{n}: 1}}')
    return '\n'.join(lines).encode()


def jpeg_of(width: int, height: int) -> bytes:
    """A small JPEG whose header says another size."""
    data = bytearray(cv2.imencode('.jpg', np.zeros((16, 16, 3), np.uint8))[1].tobytes())
    at = data.index(b'\xff\xc0')
    data[at + 5 : at + 9] = struct.pack('>HH', height, width)
    return bytes(data)


def cut_jpeg() -> bytes:
    """The first half of one."""
    whole = KINDS['image'].samples()[0]
    return whole[: len(whole) // 2]


def chunk_bomb() -> bytes:
    """A bag whose 164 kB chunk inflates to gigabytes."""
    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.ZSTD)
    writer.start(profile='ros2', library='x')
    data = zstandard.ZstdCompressor().compressobj(size=-1)
    packed = b''.join(data.compress(bytes(2**24)) for _ in range(320)) + data.flush()
    body = struct.pack('<QQQI', 0, 1, 100, 0) + struct.pack('<I', 4) + b'zstd'
    body += struct.pack('<Q', len(packed)) + packed
    return stream.getvalue() + b'\x06' + struct.pack('<Q', len(body)) + body


def sqlite_bag(statement: str = '') -> bytes:
    """A recorded SQLite bag that something was done to."""
    with tempfile.NamedTemporaryFile() as file:
        file.write(KINDS['bag, sqlite3'].samples()[0])
        file.flush()
        with closing(sqlite3.connect(file.name)) as database:
            database.executescript(statement)
        return Path(file.name).read_bytes()


def endless_view() -> bytes:
    """A bag whose messages are computed, and never end."""
    return sqlite_bag(
        'DROP TABLE messages; CREATE VIEW messages AS WITH RECURSIVE n(id) AS '
        '(SELECT 1 UNION ALL SELECT id + 1 FROM n) '
        "SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM n"
    )


def nested_answer() -> bytes:
    """60 kB of maps in maps."""
    return b'\x81\xa1a' * 20_000 + b'\xc0'


def vast_answer() -> bytes:
    """An array that says it is of 4 GB."""
    array_of = {b'__ndarray__': True, b'data': b'', b'dtype': '<f4', b'shape': [2**15, 2**15]}
    return bytes(msgpack.packb({'actions': array_of}) or b'')


def stride_zero() -> bytes:
    """A pickle of a tensor whose elements all are the same one."""
    import torch

    return timed_actions([torch.zeros(1).expand(2**30)])


def os_system() -> bytes:
    """A pickle that runs a command."""
    return b"cos\nsystem\n(S'touch /tmp/owned'\ntR."


def altered(kind: str, pattern: bytes, instead: bytes) -> bytes:
    """The first sample of a kind that holds the pattern, with all that fits it replaced."""
    samples = (re.subn(pattern, instead, sample) for sample in KINDS[kind].samples())
    return next(sample for sample, count in samples if count)


def altered_checkpoint(pattern: bytes, instead: bytes) -> bytes:
    """A part of a checkpoint, altered; torch, which is large, is imported before it is read."""
    import mtv_world_ros.model.checkpoint as _  # noqa: F401

    return altered('checkpoint', pattern, instead)


def joints(**changes: Any) -> Any:
    """A joint state with some fields of its own."""
    message = whole('joints')
    for field, value in changes.items():
        setattr(message, field, value)
    return message


def plan(names: list[str], rows: int = 4) -> Any:
    """A plan of these joints, all at 0."""
    return ros().make_trajectory(
        names=names, positions=np.zeros((rows, len(names))), times=np.arange(1, rows + 1) * 0.2
    )


def info(**changes: Any) -> Any:
    """A camera info with some fields of its own."""
    message = whole('info_low')
    for field, value in changes.items():
        setattr(message, field, value)
    return message


def cut_compressed() -> Any:
    """A message with the first half of a JPEG."""
    message = whole('compressed_low')
    data = bytes(message.data)
    message.data = array('B', data[: len(data) // 2])
    return message


def urdf_of(make: Callable[[], str]) -> bytes:
    """A robot of a link and more."""
    return f'<robot name="r"><link name="root"/>{make()}</robot>'.encode()


def joint(parent: str, child: str, more: str = '', kind: str = 'fixed') -> str:
    """A joint that is called as its child."""
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    limit = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
    return f'<joint name="{child}" type="{kind}">{ends}{limit}{more}</joint>'


LINKS = '<link name="b"/><link name="c"/>'


def chain(count: int) -> str:
    """Links that are each fixed to the one before."""
    parents = ['root', *(f'l{n}' for n in range(count))]
    return ''.join(f'<link name="l{n}"/>{joint(parents[n], f"l{n}")}' for n in range(count))


def star(count: int, more: str = '', last: str = '') -> str:
    """Links that all turn on the root; `{next}` in what joints hold is the next one's number."""
    return ''.join(
        f'<link name="l{n}"/>'
        + joint('root', f'l{n}', last if n == count - 1 else more.format(next=n + 1), 'revolute')
        for n in range(count)
    )


def diamonds(count: int) -> str:
    """Links that each can be reached in two ways, so that the last can in 2^count."""
    text, top = '', 'root'
    for n in range(count):
        text += f'<link name="b{n}"/><link name="c{n}"/><link name="d{n}"/>'
        text += joint(top, f'b{n}') + joint(top, f'c{n}')
        text += joint(f'b{n}', f'd{n}') + joint(f'c{n}', f'd{n}').replace('name="d', 'name="e', 1)
        top = f'd{n}'
    return text


def nested(count: int) -> str:
    """Elements in one another."""
    return '<a>' * count + '</a>' * count


def arm_of(count: int) -> bytes:
    """A Denavit-Hartenberg table of joints in a row."""
    row = {'a': 0.1, 'alpha': 0.0, 'd': 0.0, 'lower': -1.0, 'upper': 1.0}
    joints = [{'joint': f'j{n}', **row} for n in range(count)]
    tools = [{'arm': 'a', 'link': 'j0_link'}]
    values = {'name': 'r', 'dh': [{'arm': 'a', 'joints': joints}], 'tools': tools}
    return yaml.safe_dump(values, default_flow_style=True).encode()


def entity_bomb() -> bytes:
    """Ten levels of ten entities."""
    rows = ''.join(f'<!ENTITY a{n + 1} "{f"&a{n};" * 10}">' for n in range(10))
    return f'<!DOCTYPE a [<!ENTITY a0 "ha">{rows}]><robot name="&a10;"/>'.encode()


Make = Callable[[], Any]


#: name -> (kind, what makes it)
def found(kind: str, case: int) -> Make:
    """A case of `fuzz.py --seed 20261127`."""

    def make() -> Any:
        of = KINDS[kind]
        return of.damage(of.samples(), np.random.default_rng([20261127, case]))

    return make


ACCIDENTS: dict[str, tuple[str, Make]] = {
    **{f'mesh {case}': ('mesh', found('mesh', case)) for case in (267, 1157, 1889)},
    'distortion of letters': ('camera parameters', found('camera parameters', 778)),
    'image path of no text': ('LeRobot v2.1', found('LeRobot v2.1', 1496)),
    **{
        name: ('urdf', partial(urdf_of, make))
        for name, make in {
            'URDF of 200,000 elements in one another': lambda: nested(200_000),
            'URDF of 4,000 links in a row': lambda: chain(4_000),
            'URDF of 1,900 links in a row': lambda: chain(1_900),
            'URDF of 20,000 links': lambda: star(20_000),
            'URDF of 40 diamonds': lambda: diamonds(40),
            'URDF that is a circle': lambda: joint('b', 'c') + joint('c', 'b') + LINKS,
            'URDF of comments without end': lambda: '<!--' * 2_000_000,
            'URDF that follows itself': lambda: star(
                1_000, '<mimic joint="l{next}"/>', last='<mimic joint="l0"/>'
            ),
        }.items()
    },
    'URDF whose entities laugh': ('urdf', entity_bomb),
    'COLLADA of elements in one another': (
        'COLLADA',
        lambda: b'<COLLADA>' + b'<node>' * 100_000 + b'</node>' * 100_000 + b'</COLLADA>',
    ),
    'COLLADA whose entities laugh': ('COLLADA', entity_bomb),
    'fps 0': ('LeRobot v2.1', lambda: altered('LeRobot v2.1', rb'"fps": [\d.]+', b'"fps": 0')),
    'arm of 2,100 joints': ('robot', lambda: arm_of(2_100)),
    'arm of 250 joints': ('robot', lambda: arm_of(250)),
    'data path of 3 GB': (
        'LeRobot v2.1',
        lambda: altered('LeRobot v2.1', rb'\{episode_index:06d\}', b'{episode_index:>3000000000}'),
    ),
    'data path that asks an object': (
        'LeRobot v3.0',
        lambda: altered('LeRobot v3.0', rb'\{file_index:03d\}', b'{file_index.__class__}'),
    ),
    **{
        f'checkpoint of {field} {value}': (
            'checkpoint',
            partial(
                altered_checkpoint,
                rf'"{field}": (?:\[[\d, \n]+\]|\d+)'.encode(),
                f'"{field}": {value}'.encode(),
            ),
        )
        for field, value in (
            ('num_layers', 10**9),
            ('num_layers', 10**40),
            ('num_attention_heads', 10**9),
            ('attention_head_dim', 10**9),
            ('ffn_dim', 10**12),
            ('rope_max_seq_len', 10**9),
            ('num_views', 10**12),
            ('patch_size', [10**6] * 3),
            ('stem_widths', [10**12] * 3),
            ('block_size', 10**6),
            ('num_train_timesteps', 10**9),
            ('width', 20_000),
            ('num_frames', 20_000),
        )
    },
    'instruction of 15 kB': ('instruction', lambda: b'put the red block ' * 5_000),
    'width .inf': ('calibration', lambda: calibrated(width=float('inf'))),
    'nesting': ('calibration', lambda: b'[' * 100_000),
    'alias bomb': ('calibration', alias_bomb),
    'merge bomb': ('calibration', merge_bomb),
    'number of a megabyte': ('calibration', lambda: b'views: ' + b'9' * 10**6),
    'focal length 1e308': (
        'calibration',
        lambda: calibrated(K=[1e308, 90.0, 47.5, 35.5]),
    ),
    'python object': ('calibration', lambda: b'!!python/object/apply:os.system [ls]'),
    'JPEG of 20000x20000': ('image', lambda: jpeg_of(20_000, 20_000)),
    'JPEG of 65500x65500': ('image', lambda: jpeg_of(65_500, 65_500)),
    'JPEG cut short': ('image', cut_jpeg),
    'video whose names are no UTF-8': (
        'video',
        lambda: KINDS['video'].samples()[0].replace(b'Lavf', b'\xd6\xd6\xd6\xd6'),
    ),
    'chunk of 5 GB': ('bag', chunk_bomb),
    'SQLite topic that is no UTF-8': (
        'bag, sqlite3',
        lambda: sqlite_bag().replace(b'std_msgs', b'std\xfdmsgs'),
    ),
    'SQLite message that is a number': (
        'bag, sqlite3',
        lambda: sqlite_bag('UPDATE messages SET data = 4000000000'),
    ),
    'SQLite time that is a text': (
        'bag, sqlite3',
        lambda: sqlite_bag("UPDATE messages SET timestamp = 'x'"),
    ),
    'SQLite messages without end': ('bag, sqlite3', endless_view),
    'split that is a number': (
        'data set card',
        lambda: b'dataset.json\n{"splits": {"test": 1.5}, "episodes": []}',
    ),
    'scene that is a list': (
        'data set card',
        lambda: b'dataset.json\n{"splits": {}, "episodes": [{"name": "a", "scene": ["x"]}]}',
    ),
    'state of 142 billion columns': (
        'policy',
        lambda: altered('policy', rb'left_joint1: 0', b'left_joint1: 142949672961'),
    ),
    'policy whose name is no file name': (
        'policy list',
        lambda: f'policies:\n- {{name: a, policy: {"9" * 400}a.yaml}}\n'.encode(),
    ),
    'box of 400 digits': (
        'answer, language model',
        lambda: altered('answer, language model', rb'\[\d+, ', b'[' + b'9' * 400 + b', '),
    ),
    'box of 400 digits that was kept': (
        'kept description',
        lambda: altered('kept description', rb'412.0', b'9' * 400),
    ),
    'Jaccard index of 400 digits': (
        'ranking',
        lambda: altered('ranking', rb'"jaccard": \[\s*\[\s*[\d.]+', b'"jaccard": [[' + b'9' * 400),
    ),
    'focal length of 400 digits': (
        'camera parameters',
        lambda: altered('camera parameters', rb'70\.0', b'9' * 400),
    ),
    'shard whose name is no file name': (
        'weights in shards',
        lambda: altered('weights in shards', rb'"model-00002', b'"' + b'9' * 400),
    ),
    'mesh without a file': ('mesh', lambda: altered('mesh', rb'filename=', b'file=')),
    'nested answer': ('answer, msgpack', nested_answer),
    'vast answer': ('answer, msgpack', vast_answer),
    'tensor of stride 0': ('answer, pickle', stride_zero),
    'pickle that runs a command': ('answer, pickle', os_system),
}
if 'message, plan' in KINDS:
    ACCIDENTS |= {
        '20,000 joint names': (
            'message, plan', lambda: plan([f'joint{n}' for n in range(20_000)], 1)),
        'joint name twice in a plan': ('message, plan', lambda: plan(['left_joint1'] * 2)),
        '20,000 measured joints': (
            'message, joints',
            lambda: joints(name=[f'j{n}' for n in range(20_000)], position=[0.0] * 20_000)),
        'measured joints of 1e300': ('message, joints', lambda: joints(position=[1e300] * 14)),
        'measured joint twice': (
            'message, joints', lambda: joints(name=['left_joint1'] * 2, position=[0.0, 0.1])),
        'distortion NaN': ('message, info_low', lambda: info(d=[float('nan')] * 5)),
        'distortion inf': ('message, info_low', lambda: info(d=[float('inf')] * 5)),
        'distortion 1e30': ('message, info_low', lambda: info(d=[1e30] * 5)),
        'focal length 1e308 in a message': (
            'message, info_low',
            lambda: info(k=[1e308, 0, 47.5, 0, 1e308, 35.5, 0, 0, 1.0])),
        'JPEG cut short in a message': ('message, compressed_low', cut_compressed),
    }  # fmt: skip
