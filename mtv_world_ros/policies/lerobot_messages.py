"""The messages of LeRobot's asynchronous inference: protobuf frames with pickled contents.

Taken from LeRobot: `transport/services.proto`, `transport/utils.py`, `async_inference/helpers.py`.
Contents are pickles there. What is sent is written as such; of what is received nothing is looked
up or called but the few names that a list of actions is made of, and tensors are read with
`weights_only`.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping
import io
import pickle
from typing import Any
import warnings

import numpy as np

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import PolicyError

_HELPERS = 'lerobot.async_inference.helpers'
#: a stream of parts no larger than this, as gRPC's limit is 4 MB
_PART_BYTES = 2 * 1024 * 1024
_BEGIN, _MIDDLE, _END = 1, 2, 3
_VARINT, _BYTES = 0, 2


def policy_setup(values: Mapping[str, Any]) -> bytes:
    """Message `PolicySetup` of a `RemotePolicyConfig` with these fields."""
    return _tagged(1, _pickled('RemotePolicyConfig', values))


def observation_parts(values: Mapping[str, Any]) -> Iterator[bytes]:
    """Messages `Observation` of a `TimedObservation` with these fields, in parts."""
    data = _pickled('TimedObservation', values)
    for begin in range(0, len(data), _PART_BYTES):
        part = data[begin : begin + _PART_BYTES]
        is_last = begin + _PART_BYTES >= len(data)
        state = _END if is_last else _MIDDLE if begin else _BEGIN
        yield bytes((1 << 3 | _VARINT, state)) + _tagged(2, part)


def read_actions(message: bytes) -> FloatArray:
    """Returns the (T, C) actions of a message `Actions`.

    Raises:
        PolicyError: there are none in it, or it holds something else.
    """
    data = _first_bytes(message)
    if not data:
        raise PolicyError(
            "the policy server gave no actions; its log says why (LeRobot's server answers "
            'failures with an empty message)'
        )
    try:
        actions = _ActionReader(io.BytesIO(data)).load()
        return np.stack([np.asarray(action.action, np.float64).ravel() for action in actions])
    except PolicyError:
        raise
    except Exception as error:  # whatever bytes that are no such pickle make it raise
        raise PolicyError(f'the answer is no list of timed actions: {error}') from error


def _pickled(name: str, values: Mapping[str, Any]) -> bytes:
    """Pickle of an object of one of LeRobot's dataclasses, which need not be installed here.

    Protocol 3, since it has no frames: the class by name, an instance without arguments, then its
    fields as state.
    """
    fields = pickle.dumps(dict(values), protocol=3)
    header, body = fields[:2], fields[2:-1]
    made = f'c{_HELPERS}\n{name}\n'.encode() + b')\x81'
    return header + made + body + b'b.'


class _TimedAction:
    """What a `TimedAction` is read into."""

    action: Any


class _ActionReader(pickle.Unpickler):
    """Reads lists of `TimedAction` with tensors, and refuses all other names."""

    def find_class(self, module: str, name: str) -> Any:
        if name == 'TimedAction' and module.startswith('lerobot.'):
            return _TimedAction
        allowed = {
            ('torch._utils', '_rebuild_tensor_v2'): _tensor,
            ('torch.storage', '_load_from_bytes'): _storage,
            ('collections', 'OrderedDict'): OrderedDict,
        }
        if (module, name) not in allowed:
            raise PolicyError(
                f"the answer names '{module}.{name}', which does not belong into a list of "
                'actions; it was not looked up'
            )
        return allowed[module, name]


def _storage(data: bytes) -> FloatArray:
    import torch

    storage = torch.load(io.BytesIO(data), weights_only=True, map_location='cpu')
    with warnings.catch_warnings():  # typed storages are deprecated, pickles of tensors have them
        warnings.simplefilter('ignore', UserWarning)
        values = torch.tensor([], dtype=storage.dtype).set_(storage.untyped())
    return values.double().numpy()


def _tensor(
    storage: FloatArray, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any
) -> FloatArray:
    index = np.array(offset)
    for length, step in zip(size, stride, strict=True):
        index = index[..., None] + step * np.arange(length)
    return storage[index]


def _tagged(field: int, data: bytes) -> bytes:
    return bytes((field << 3 | _BYTES,)) + _varint(len(data)) + data


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _first_bytes(message: bytes) -> bytes:
    """Field 1 of a message of byte fields; empty where it has none."""
    at = 0
    while at < len(message):
        tag, at = _read_varint(message, at)
        if tag & 7 != _BYTES:
            raise PolicyError(f'the answer has a field of wire type {tag & 7}; expected bytes')
        length, at = _read_varint(message, at)
        if tag >> 3 == 1:
            return message[at : at + length]
        at += length
    return b''


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value, shift = 0, 0
    while at < len(data):
        value |= (data[at] & 0x7F) << shift
        at += 1
        if not data[at - 1] & 0x80:
            return value, at
        shift += 7
    raise PolicyError('the answer is cut off')
