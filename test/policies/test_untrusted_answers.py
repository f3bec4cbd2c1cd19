"""Whatever a policy server answers is used or refused, in bounded time and memory."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
import io
import pickle
import sys
import time
import tracemalloc
import types

import msgpack
import numpy as np
import pytest
import torch

from mtv_world_ros.core.errors import PolicyError
from mtv_world_ros.policies.lerobot_client import read_actions
from mtv_world_ros.policies.openpi_client import pack, unpack
from mtv_world_ros.policies.timed_actions import read_timed_actions
from test.support.tables import table


@pytest.fixture(autouse=True)
def budget():
    begin = time.process_time()
    tracemalloc.start()
    yield
    assert tracemalloc.get_traced_memory()[1] < 300 * 2**20
    tracemalloc.stop()
    assert time.process_time() - begin < 10.0


@dataclass
class TimedAction:
    timestamp: float
    timestep: int
    action: torch.Tensor


@pytest.fixture
def as_lerobot(monkeypatch):
    """As if LeRobot were installed: pickles name its class by module."""
    module = types.ModuleType('lerobot.async_inference.helpers')
    module.TimedAction = TimedAction
    monkeypatch.setitem(sys.modules, 'lerobot', types.ModuleType('lerobot'))
    monkeypatch.setitem(sys.modules, 'lerobot.async_inference', types.ModuleType('x'))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(TimedAction, '__module__', module.__name__)


@pytest.mark.parametrize('dtype', [torch.float32, torch.float64, torch.float16, torch.bfloat16])
@pytest.mark.parametrize('protocol', [3, 4, 5])
def test_tensors_of_all_kinds_are_read(as_lerobot, dtype, protocol):
    table = torch.arange(12, dtype=dtype).reshape(3, 4)
    actions = [TimedAction(0.5 * n, n, row) for n, row in enumerate(table)]  # share a storage
    read = read_timed_actions(pickle.dumps(actions, protocol=protocol))
    np.testing.assert_array_equal(read, table.double().numpy())
    assert read.dtype == np.float64


def nested_hash(levels: int = 60) -> bytes:
    """A mapping whose key is a pair of pairs of pairs ..., which takes 2^60 steps to hash."""
    body = b'\x80\x02}(K\x01q\x00'
    for level in range(levels):
        last = bytes([level])
        body += b'0h' + last + b'h' + last + b'\x86q' + bytes([level + 1])
    return body + b'K\x01u.'


def with_stride_0(length: int) -> bytes:
    storage = io.BytesIO()
    torch.save(torch.zeros(1).storage(), storage, _use_new_zipfile_serialization=False)
    data = storage.getvalue()
    out = b'\x80\x03]ctorch._utils\n_rebuild_tensor_v2\n(ctorch.storage\n_load_from_bytes\n'
    out += b'B' + len(data).to_bytes(4, 'little') + data + b'\x85RK\x00'
    out += b'J' + length.to_bytes(4, 'little') + b'\x85K\x00\x85\x89}tRa.'
    return out


WILD = {
    'empty': b'',
    'no pickle': b'\x00\x01\x02',
    'cut': pickle.dumps([1, 2, 3])[:-3],
    'no list': pickle.dumps({'a': 1}),
    'no actions': pickle.dumps([1, 2]),
    'hashes': nested_hash(),
    'stride 0': with_stride_0(2**29),
    'many strides': with_stride_0(2**31 - 1),
    'call': b'cos\nsystem\n(X\x02\x00\x00\x00lstR.',
    'dotted': b'ctorch._utils\n_rebuild_tensor_v2.__globals__\n.',
    'builtins': b'c__builtin__\neval\n(X\x01\x00\x00\x001tR.',
    'steps': b'\x80\x02' + b'N' * 2**20 + b'.',
    'memo': b'\x80\x02]r\xff\xff\xff\xff.',
    'long': b'\x80\x02\x8b\xff\xff\xff\x7f' + b'\x01' * 100,
    'bytes': b'\x80\x02B\xff\xff\xff\xff.',
    'frozen set': pickle.dumps(frozenset({1}), protocol=4),
    'append to nothing': b'\x80\x02K\x01a.',
    'build on a name': b'\x80\x02clerobot.x\nTimedAction\n}b.',
    'persistent': b'\x80\x02K\x01Q.',
    'recursive': b'\x80\x02]q\x00h\x00a.',
}


@pytest.mark.parametrize('name', WILD)
def test_pickles_that_are_no_actions_are_refused(name):
    with pytest.raises(PolicyError):
        read_timed_actions(WILD[name])


def test_the_hash_bomb_is_one():
    """The same instructions with few levels are a pickle that Python reads."""
    assert pickle.loads(nested_hash(2)) == {((1, 1), (1, 1)): 1}  # noqa: S301


@table('seed', range(20))
def test_mutated_answers_end_in_an_answer_or_a_refusal(as_lerobot, seed):
    rng = np.random.default_rng(seed)
    actions = [TimedAction(0.0, n, torch.full((3,), float(n))) for n in range(3)]
    data = pickle.dumps(actions)
    message = b'\x0a' + bytes([len(data) & 0x7F | 0x80, len(data) >> 7]) + data
    for _ in range(100):
        mutated = bytearray(message)
        for at in rng.integers(0, len(mutated), rng.integers(1, 6)):
            mutated[at] = rng.integers(256)
        with suppress(PolicyError):
            assert read_actions(bytes(mutated)).ndim == 2


def packed_array(data, dtype, shape) -> bytes:
    values = {b'__ndarray__': True, b'data': data, b'dtype': dtype, b'shape': shape}
    return bytes(msgpack.packb(values) or b'')


def deep(levels: int) -> bytes:
    return b'\x91' * levels + b'\xc0'


@pytest.mark.parametrize(
    'data',
    [
        b'',
        b'\xc1',
        deep(100_000),
        b'\xdd\xff\xff\xff\xff',
        b'\xc6\xff\xff\xff\xff',
        packed_array(b'1234', '<f4', [2**40]),
        packed_array(b'1234', 'f4,' * 10**6, [1]),
        packed_array(b'1234', 7, [1]),
        packed_array('x', '<f4', 'x'),
        msgpack.packb({b'__ndarray__': True}),
        msgpack.packb({b'__npgeneric__': True, b'data': [[1]], b'dtype': 'O'}),
    ],
)
def test_msgpack_that_is_no_answer_is_refused(data):
    with pytest.raises(PolicyError):
        unpack(data)


@pytest.mark.parametrize('seed', range(10))
def test_mutated_msgpack_ends_in_an_answer_or_a_refusal(seed):
    rng = np.random.default_rng(seed)
    whole = pack({'actions': np.ones((4, 7)), 'policy_timing': {'infer_ms': 1.5}})
    for _ in range(200):
        mutated = bytearray(whole)
        for at in rng.integers(0, len(mutated), rng.integers(1, 6)):
            mutated[at] = rng.integers(256)
        with suppress(PolicyError):
            unpack(bytes(mutated))
