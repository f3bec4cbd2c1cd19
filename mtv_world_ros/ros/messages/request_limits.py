"""Service requests that are refused by the lengths of their lists, before rclpy makes objects.

rclpy has no raw services. It takes a request into a C structure, which costs little, and then
makes a Python object of every nested message, 9 microseconds each. A request class with another
conversion looks at the lengths in the structure first (rosidl_generator_c defines its layout).
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rosidl_parser.definition import (
    AbstractGenericString,
    AbstractSequence,
    Array,
    BasicType,
    NamespacedType,
)

#: items of all lists of a request together; nodes have fewer than 200 parameters
MOST_ITEMS = 2_000
_BASIC = {
    'boolean': 1, 'octet': 1, 'char': 1, 'int8': 1, 'uint8': 1, 'int16': 2, 'uint16': 2,
    'int32': 4, 'uint32': 4, 'float': 4, 'int64': 8, 'uint64': 8, 'double': 8,
}  # fmt: skip
_WORD = ctypes.sizeof(ctypes.c_size_t)
_get_pointer = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ('PyCapsule_GetPointer', ctypes.pythonapi)
)
_make_capsule = ctypes.PYFUNCTYPE(
    ctypes.py_object, ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p
)(('PyCapsule_New', ctypes.pythonapi))
_Convert = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_void_p)


@dataclass(frozen=True, slots=True)
class RefusedRequest:
    """Stand-in for a request whose lists are too long.

    Attributes:
        count: items of its lists together.
        most: items that are read.
    """

    count: int
    most: int

    def __str__(self) -> str:
        """Return the reason in words."""
        return f'the request has {self.count} items; at most {self.most} are read'


@cache
def bounded_request(kind: type, most: int = MOST_ITEMS) -> type:
    """Return a substitute of a request class that refuses lists which are too long.

    What it takes is a message of `kind`, or a `RefusedRequest`. A request without lists keeps its
    own class.
    """
    layout: list[int] = []
    _walk(kind, 0, layout)
    if not layout:
        return kind
    metaclass: Any = type(kind)
    if metaclass._CONVERT_TO_PY is None:
        metaclass.__import_type_support__()
    convert = _Convert(_get_pointer(metaclass._CONVERT_TO_PY, None))

    def checked(address: int) -> Any:
        count = sum(ctypes.c_size_t.from_address(address + at).value for at in layout)
        return convert(address) if count <= most else RefusedRequest(count, most)

    called = _Convert(checked)
    capsule = _make_capsule(ctypes.cast(called, ctypes.c_void_p), None, None)
    bounded = type(metaclass.__name__, (metaclass,), {'_CONVERT_TO_PY': capsule})
    return bounded(
        kind.__name__, (kind,), {'__slots__': (), '__module__': kind.__module__, 'called': called}
    )


def _walk(kind: Any, begin: int, lengths: list[int]) -> tuple[int, int]:
    """Collect the offsets of the lengths of a structure's lists; return its end and alignment."""
    at, widest = begin, 1
    for slot in kind.SLOT_TYPES:
        size, alignment, inner = _measure(slot)
        at += -at % alignment
        lengths.extend(at + offset for offset in inner)
        at, widest = at + size, max(widest, alignment)
    return at + -at % widest, widest


def _measure(slot: Any) -> tuple[int, int, list[int]]:
    """Return size, alignment and the offsets of lengths of a field."""
    if isinstance(slot, BasicType):
        size = _BASIC[slot.typename]
        return size, size, []
    if isinstance(slot, AbstractGenericString):
        return 3 * _WORD, _WORD, []
    if isinstance(slot, AbstractSequence):
        return 3 * _WORD, _WORD, [_WORD]
    if isinstance(slot, Array):
        size, alignment, inner = _measure(slot.value_type)
        found = [n * size + at for n in range(slot.size) for at in inner]
        return size * slot.size, alignment, found
    assert isinstance(slot, NamespacedType)
    found = []
    size, alignment = _walk(_class_of(slot), 0, found)
    return size, alignment, found


def _class_of(slot: NamespacedType) -> Any:
    module = import_module('.'.join(slot.namespaces))
    if hasattr(module, slot.name):
        return getattr(module, slot.name)
    action, _, part = slot.name.rpartition('_')  # e.g. the Goal of an action
    return getattr(getattr(module, action), part)


def bounded_action(action: Any, most: int) -> Any:
    """Return a substitute of an action type whose goals are limited by `bounded_request`."""
    goals = action.Impl.SendGoalService
    bounded = type('SendGoalService', (goals,), {'Request': bounded_request(goals.Request, most)})
    impl = type('Impl', (action.Impl,), {'SendGoalService': bounded})
    return type(action)(action.__name__, (action,), {'Impl': impl})


def guard_services(node: Node) -> None:
    """Let a node's services refuse requests with too many items; a second call changes nothing."""
    for service in node.services:
        kind: Any = service.srv_type
        bounded = bounded_request(kind.Request)
        if bounded is not kind.Request and not isinstance(service.callback, RefusingCallback):
            service.srv_type = type(kind.__name__, (), {**vars(kind), 'Request': bounded})
            service.callback = RefusingCallback(node, service.srv_name, service.callback)


class RefusingCallback:
    """Service callback that answers a refused request, with the reason if the type has a text.

    Args:
        node: node of the service.
        name: name of the service.
        serve: callback of the service.
    """

    def __init__(self, node: Node, name: str, serve: Any) -> None:
        self._log, self._name, self._serve = node.get_logger(), name, serve

    def __call__(self, request: Any, response: Any) -> Any:
        """Serve the request, or refuse it."""
        if not isinstance(request, RefusedRequest):
            return self._serve(request, response)
        self._log.warning(f'{self._name}: {request}', throttle_duration_sec=1.0)
        refused = SetParametersResult(successful=False, reason=str(request))
        if isinstance(response, SetParameters.Response):
            response.results = [refused]
        elif isinstance(response, SetParametersAtomically.Response):
            response.result = refused
        return response
