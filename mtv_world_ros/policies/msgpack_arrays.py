"""Arrays in msgpack as openpi writes them: the `openpi-client` package, `msgpack_numpy.py`.

An array is a map with the byte keys `__ndarray__`, `data`, `dtype` and `shape`, a NumPy scalar one
with `__npgeneric__`, `data` and `dtype`. Nothing in it is executed.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mtv_world_ros.errors import PolicyError

#: kinds of dtype that have no plain bytes: structures, objects, complex numbers
_REFUSED = 'VOc'


def pack(value: Any) -> bytes:
    """Returns the bytes of nested mappings and lists of arrays, numbers and text."""
    import msgpack

    packed = msgpack.packb(value, default=_encode)
    assert packed is not None
    return packed


def unpack(data: bytes) -> Any:
    """Returns what the bytes hold.

    Raises:
        PolicyError: they are not msgpack, or hold an array that is none.
    """
    import msgpack

    try:
        return msgpack.unpackb(data, object_hook=_decode)
    except (ValueError, TypeError, KeyError, msgpack.UnpackException) as error:
        raise PolicyError(f'the answer is not msgpack as openpi writes it: {error}') from error


def _encode(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind not in _REFUSED:
        if isinstance(value, np.generic):
            return {b'__npgeneric__': True, b'data': value.item(), b'dtype': value.dtype.str}
        data = np.ascontiguousarray(value).tobytes()
        kind, shape = value.dtype.str, list(value.shape)
        return {b'__ndarray__': True, b'data': data, b'dtype': kind, b'shape': shape}
    raise TypeError(f'a {type(value).__name__} cannot be sent')


def _decode(value: dict[Any, Any]) -> Any:
    if b'__ndarray__' in value:
        array = np.frombuffer(value[b'data'], _dtype(value))
        return array.reshape(tuple(value[b'shape']))
    if b'__npgeneric__' in value:
        return _dtype(value).type(value[b'data'])
    return value


def _dtype(value: dict[Any, Any]) -> np.dtype[Any]:
    dtype = np.dtype(value[b'dtype'])
    if dtype.kind in _REFUSED:
        raise ValueError(f'arrays of {dtype} are not read')
    return dtype
