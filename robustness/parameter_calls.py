"""Calls of a node's parameter services with values of every type, size and kind.

The services are called in process, as the executor calls them. Each call must be answered; what
is refused has a reason, and a node that was asked anything still reads its own parameters.
"""

from __future__ import annotations

from functools import cache
import os
from typing import Any

import numpy as np

from robustness import wild_plans
from robustness.folder_kinds import clean_up, new_folder
from robustness.node_messages import FLOATS, WORDS

#: beyond those of tests that start nodes as processes of their own (1 to 100)
_DOMAIN = 101
NODES = ('world_model', 'policy')
#: names that nobody declared
STRANGE_NAMES = ('', 'x', 'adapter.x', 'x' * 300, 'use_sim_time', '\N{SNOWMAN}', 'a\nb', 'qos')
INTEGERS = (0, 1, -1, 2**31 - 1, 2**31, 2**63 - 1, -(2**63), 7)


@cache
def _texts() -> tuple[str, ...]:
    folder = new_folder()
    fifo, loop = folder / 'fifo', folder / 'loop'
    os.mkfifo(fifo)
    loop.symlink_to(loop)
    (folder / 'broken.yaml').write_text('views: {low: [}')
    (folder / 'broken.safetensors').write_bytes(b'\xff' * 40)
    paths = (
        folder,
        fifo,
        loop,
        folder / 'none',
        *folder.glob('broken*'),
        '/dev/zero',
        '/proc/self/mem',
    )
    long = (
        'a' * 300,
        '/'.join(['a' * 200] * 40),
        '\N{SNOWMAN}' * 300,
        '~',
        '~nobody/x',
        '.',
        '..',
    )
    return (*WORDS, *map(str, paths), *long, 'a\nb', 'none', 'bundled', 'observe', 'true', '1e999')


@cache
def _node(name: str) -> Any:
    """A configured node; its worker and publishers are the real ones."""
    import rclpy

    from mtv_world_ros.ros.policy.node import PolicyNode
    from mtv_world_ros.ros.world_model.node import WorldModelNode

    if not rclpy.ok():
        # a domain of its own: tests of other processes look for nodes of the same names
        rclpy.init(args=['x', '--ros-args', '--log-level', 'FATAL'], domain_id=_DOMAIN)
    if name == 'policy':
        return PolicyNode(load=lambda settings, robot: None)  # type: ignore[arg-type,return-value]
    node = WorldModelNode(load=lambda settings: wild_plans.bundled())
    node.start()
    return node


def close() -> None:
    """End the nodes, and ROS in this process if they began it; remove the folders."""
    if _node.cache_info().currsize:
        import rclpy

        for name in NODES:
            _node(name).close()
        _node.cache_clear()
        rclpy.shutdown()
    _texts.cache_clear()
    clean_up()


def _value(rng: np.random.Generator) -> Any:
    """A `ParameterValue` of any type, right or wrong."""
    from rcl_interfaces.msg import ParameterValue

    value = ParameterValue(type=int(rng.choice([0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 200])))
    texts = _texts()
    value.bool_value = bool(rng.random() < 0.5)
    value.integer_value = int(rng.choice(np.array(INTEGERS, dtype=object)))
    value.double_value = float(rng.choice(FLOATS))
    value.string_value = texts[rng.integers(len(texts))]
    count = int(rng.choice([0, 0, 1, 2, 1000]))
    value.byte_array_value = [b'\0'] * count
    value.bool_array_value = [True] * count
    value.integer_array_value = [int(rng.choice(np.array(INTEGERS, dtype=object)))] * count
    value.double_array_value = [float(rng.choice(FLOATS)) for _ in range(count)]
    value.string_array_value = [texts[rng.integers(len(texts))] for _ in range(count)]
    return value


def _fitting(rng: np.random.Generator, node: Any, name: str, value: Any) -> None:
    """Give the value the type that the parameter has, mostly: it is looked at then."""
    if node.has_parameter(name) and rng.random() < 0.7:
        value.type = node.get_parameter(name).type_.value


def samples() -> list[Any]:
    """A call that asks for nothing."""
    return [('world_model', 'set_parameters', [])]


def damaged(_: list[Any], rng: np.random.Generator) -> Any:
    """A call with a few parameters."""
    from rcl_interfaces.msg import Parameter

    kind = str(rng.choice(NODES))
    node = _node(kind)
    names = [*node._parameters, *STRANGE_NAMES]
    rows = []
    for _row in range(int(rng.choice([1, 1, 1, 2, 5]))):
        name = names[rng.integers(len(names))]
        value = _value(rng)
        _fitting(rng, node, name, value)
        rows.append(Parameter(name=name, value=value))
    service = str(rng.choice(['set_parameters', 'set_parameters', 'set_parameters_atomically']))
    return kind, service, rows


def call(case: Any, _: Any) -> None:
    """Call the service and ask the node how it is.

    Raises:
        MtvWorldError: a value was refused with a reason.
        AssertionError: one was refused without, or the node does not have its parameters any more.
    """
    from rcl_interfaces import srv

    from mtv_world_ros.core.errors import ConfigError
    from mtv_world_ros.ros import parameters
    from mtv_world_ros.ros.parameters import Settings
    from mtv_world_ros.ros.policy.loop import PolicySettings

    kind, service, rows = case
    node = _node(kind)
    kinds = {'set_parameters': srv.SetParameters}
    request_kind = kinds.get(service, srv.SetParametersAtomically)
    served = next(s for s in node.services if s.srv_name.endswith(f'/{service}'))
    response = served.callback(request_kind.Request(parameters=rows), request_kind.Response())
    results = response.results if service == 'set_parameters' else [response.result]
    parameters.read(node, PolicySettings if kind == 'policy' else Settings)
    if kind == 'world_model':
        node._on_period()
    refused = [result for result in results if not result.successful]
    assert all(result.reason for result in refused), 'refused without a reason'
    if refused:
        raise ConfigError(refused[0].reason)
