"""LeRobot's lists of timed actions, read from the pickles of an untrusted server.

A pickle is a program. This runs the few instructions that such lists consist of, on a stack of its
own: nothing is imported or called but what stands here, keys of mappings are text or numbers (so
that no hash takes exponential time), and instructions, values and bytes are counted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import io
from math import prod
import pickletools
import struct
from typing import Any

import numpy as np

from mtv_world_ros.core.bounded_input import check_limit, limits
from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import PolicyError
from mtv_world_ros.core.shown_text import shown

#: maximum number of instructions of a pickle; a chunk of 50 actions has about 3,000
_MOST_STEPS = 200_000
_MOST_DIMENSIONS = 8
#: magic number of `torch.save`'s older format, in pickles of tensors
_MAGIC = 0x1950A86A20F9469CFC6C
#: number formats by torch's classes of storages; bfloat16 is the upper half of a float32
_FORMATS = {
    'DoubleStorage': '<f8', 'FloatStorage': '<f4', 'HalfStorage': '<f2', 'BFloat16Storage': '<u2',
    'LongStorage': '<i8', 'IntStorage': '<i4', 'ShortStorage': '<i2', 'CharStorage': '<i1',
    'ByteStorage': '<u1', 'BoolStorage': '<u1',
}  # fmt: skip


def read_timed_actions(data: bytes) -> FloatArray:
    """Return (T, C) actions.

    Raises:
        PolicyError: it is no list of timed actions, or a larger one than is allowed.
    """
    try:
        return _stacked(_Machine(_Tensors().names).run(io.BytesIO(data)))
    except PolicyError:
        raise
    except (
        ValueError, TypeError, LookupError, AttributeError, ArithmeticError, MemoryError,
        struct.error,
    ) as error:  # fmt: skip
        raise PolicyError(f'the answer is no list of timed actions: {shown(error)}') from error


def _stacked(actions: Any) -> FloatArray:
    if not isinstance(actions, list) or not actions:
        raise PolicyError('the answer is no list of timed actions')
    check_limit('trajectory_points', len(actions), 'the answer')
    rows = []
    for action in actions:
        values = action.fields.get('action') if isinstance(action, _TimedAction) else None
        if not isinstance(values, np.ndarray):
            raise PolicyError('the answer is no list of timed actions')
        rows.append(values.ravel())
    check_limit('array_bytes', 8 * sum(map(len, rows)), 'the list of actions')
    return np.stack(rows).astype(np.float64)


class _TimedAction:
    """Fields of a received `TimedAction`."""

    def __init__(self) -> None:
        self.fields: dict[str, Any] = {}


class _Name:
    """A name in a pickle: what stands for it when it is called."""

    def __init__(self, text: str, call: Callable[..., Any] | None = None) -> None:
        self.text, self.call = text, call


class _Tensors:
    """The names that tensors are made of; all arrays together stay within the limit."""

    def __init__(self) -> None:
        self._left = limits().array_bytes

    def names(self, module: str, name: str) -> _Name:
        """Return what a name stands for; PolicyError for all other names."""
        if name == 'TimedAction' and module.startswith('lerobot.'):
            return _Name(name, _TimedAction)
        if (module, name) == ('torch._utils', '_rebuild_tensor_v2'):
            return _Name(name, self._tensor)
        if (module, name) == ('torch.storage', '_load_from_bytes'):
            return _Name(name, _storage)
        if (module, name) == ('collections', 'OrderedDict'):
            return _Name(name, lambda *_: {})  # hooks, unused
        raise PolicyError(
            f"the answer names '{module}.{name}', which does not belong into a list of actions; "
            'it was not looked up'
        )

    def _tensor(
        self,
        storage: FloatArray,
        offset: int,
        size: Sequence[int],
        stride: Sequence[int],
        *_: Any,
    ) -> FloatArray:
        if not isinstance(storage, np.ndarray) or len(size) > _MOST_DIMENSIONS:
            raise ValueError('a tensor without storage')
        if min((offset, *size, *stride), default=0) < 0:
            raise ValueError('a tensor of negative size')
        self._left -= 8 * prod(size)
        if self._left < 0:
            raise PolicyError(
                f'the answer has tensors of more than {limits().array_bytes} bytes (the '
                'environment variable MTV_WORLD_MAX_ARRAY_BYTES allows more)'
            )
        index = np.array(offset)
        for length, step in zip(size, stride, strict=True):
            index = index[..., None] + step * np.arange(length)
        return storage[index]


def _storage(data: bytes) -> FloatArray:
    """Return a storage as `torch.save` wrote it in its older format."""
    if not isinstance(data, bytes):
        raise TypeError('a storage is bytes')
    stream = io.BytesIO(data)
    if _Machine(_no_names).run(stream) != _MAGIC:
        raise ValueError('the storage is in another format')
    for _ in ('version', 'system'):
        _Machine(_no_names).run(stream)
    kind = _Machine(_storage_names, persistent=True).run(stream)
    _Machine(_no_names).run(stream)  # its key
    if not (isinstance(kind, tuple) and len(kind) > 1 and isinstance(kind[1], _Name)):
        raise ValueError('the storage is of no known kind')
    (count,) = struct.unpack('<q', stream.read(8))
    name = kind[1].text
    values = np.frombuffer(data, _FORMATS[name], count, stream.tell())
    if name == 'BFloat16Storage':
        values = (values.astype(np.uint32) << 16).view(np.float32)
    return values.astype(np.float64)


def _no_names(module: str, name: str) -> _Name:
    raise PolicyError(f"the answer names '{module}.{name}' in a tensor; it was not looked up")


def _storage_names(module: str, name: str) -> _Name:
    if module != 'torch' or name not in _FORMATS:
        return _no_names(module, name)
    return _Name(name)


_MARK = object()
_VALUES = frozenset({
    'BININT', 'BININT1', 'BININT2', 'LONG1', 'BINFLOAT', 'SHORT_BINBYTES', 'BINBYTES',
    'BINBYTES8', 'SHORT_BINUNICODE', 'BINUNICODE', 'BINUNICODE8',
})  # fmt: skip
_CONSTANTS = {'NONE': None, 'NEWTRUE': True, 'NEWFALSE': False, 'EMPTY_TUPLE': (), 'MARK': _MARK}


class _Machine:
    """Runs one pickle.

    Args:
        names: module names, by the names in the pickle.
        persistent: whether the pickle refers to something outside; it is the result then.
    """

    def __init__(self, names: Callable[[str, str], _Name], *, persistent: bool = False) -> None:
        self._names, self._persistent = names, persistent
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def run(self, stream: io.BytesIO) -> Any:
        """Return the pickle's value; the stream then stands behind it."""
        for count, (code, argument, _) in enumerate(pickletools.genops(stream)):
            if count > _MOST_STEPS:
                raise PolicyError(f'the answer has more than {_MOST_STEPS} instructions')
            if code.name in _VALUES:
                self._stack.append(argument)
            elif code.name in _CONSTANTS:
                self._stack.append(_CONSTANTS[code.name])
            elif code.name not in ('PROTO', 'FRAME', 'STOP'):
                step = _STEPS.get(code.name)
                if step is None:
                    raise PolicyError(f"the answer has the instruction '{code.name}'; not run")
                step(self, argument)
        return self._stack.pop()

    def _from_mark(self) -> list[Any]:
        at = len(self._stack) - 1
        while self._stack[at] is not _MARK:
            at -= 1
            if at < 0:
                raise ValueError('a list without a beginning')
        items = self._stack[at + 1 :]
        del self._stack[at:]
        return items

    def _tuple(self, length: int | None) -> None:
        items = self._from_mark() if length is None else self._stack[-length:]
        if length is not None:
            del self._stack[-length:]
        self._stack.append(tuple(items))

    def _append(self, items: list[Any]) -> None:
        target = self._stack[-1]
        if not isinstance(target, list):
            raise TypeError('only lists are appended to')
        target.extend(items)

    def _set(self, items: list[Any]) -> None:
        target = self._stack[-1]
        if not isinstance(target, dict) or len(items) % 2:
            raise TypeError('only mappings have keys')
        for key, value in zip(items[::2], items[1::2], strict=True):
            if not isinstance(key, str | int):
                raise TypeError(f'a key is a {type(key).__name__}')
            target[key] = value

    def _pair(self) -> list[Any]:
        items = self._stack[-2:]
        del self._stack[-2:]
        return items

    def _remember(self, index: int) -> None:
        self._memo[index] = self._stack[-1]

    def _global(self, module: Any, name: Any) -> None:
        if not (isinstance(module, str) and isinstance(name, str)):
            raise TypeError('names are text')
        self._stack.append(self._names(module, name))

    def _call(self) -> None:
        arguments, called = self._stack.pop(), self._stack.pop()
        if not (isinstance(called, _Name) and called.call and isinstance(arguments, tuple)):
            raise TypeError('only names are called')
        self._stack.append(called.call(*arguments))

    def _build(self) -> None:
        fields, target = self._stack.pop(), self._stack[-1]
        if not (isinstance(target, _TimedAction) and isinstance(fields, dict)):
            raise TypeError('only actions have fields')
        target.fields = fields

    def _refer(self) -> None:
        if not self._persistent:
            raise PolicyError('the answer refers to something outside of it')


_STEPS: dict[str, Callable[[_Machine, Any], None]] = {
    'EMPTY_LIST': lambda m, _: m._stack.append([]),
    'EMPTY_DICT': lambda m, _: m._stack.append({}),
    'TUPLE': lambda m, _: m._tuple(None),
    'TUPLE1': lambda m, _: m._tuple(1),
    'TUPLE2': lambda m, _: m._tuple(2),
    'TUPLE3': lambda m, _: m._tuple(3),
    'APPEND': lambda m, _: m._append([m._stack.pop()]),
    'APPENDS': lambda m, _: m._append(m._from_mark()),
    'SETITEM': lambda m, _: m._set(m._pair()),
    'SETITEMS': lambda m, _: m._set(m._from_mark()),
    'BINPUT': lambda m, index: m._remember(index),
    'LONG_BINPUT': lambda m, index: m._remember(index),
    'MEMOIZE': lambda m, _: m._remember(len(m._memo)),
    'BINGET': lambda m, index: m._stack.append(m._memo[index]),
    'LONG_BINGET': lambda m, index: m._stack.append(m._memo[index]),
    'GLOBAL': lambda m, text: m._global(*text.split(' ', 1)),
    'STACK_GLOBAL': lambda m, _: m._global(*m._pair()),
    'REDUCE': lambda m, _: m._call(),
    'NEWOBJ': lambda m, _: m._call(),
    'BUILD': lambda m, _: m._build(),
    'BINPERSID': lambda m, _: m._refer(),
}
