"""Requests and diagnostics of peers that rclpy or a node's code fails on end no node."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import signal
import time

import pytest

rclpy = pytest.importorskip('rclpy')
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue  # noqa: E402
from rcl_interfaces import srv  # noqa: E402
from rcl_interfaces.msg import Parameter, ParameterValue  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402

from mtv_world_ros.core.files import share_path  # noqa: E402
from mtv_world_ros.ros import run_node  # noqa: E402
from mtv_world_ros.ros.bags.player import Player  # noqa: E402
from mtv_world_ros.ros.bags.recorder import Recorder  # noqa: E402
from mtv_world_ros.ros.live_viewer import LiveViewer  # noqa: E402
from mtv_world_ros.ros.parameters import guard_parameter_services  # noqa: E402
from mtv_world_ros.ros.peers import Peers  # noqa: E402

EPISODE = share_path('resource', 'demo_episode')
STRANGE = [
    Parameter(name='use_sim_time', value=ParameterValue(type=kind)) for kind in (200, 11, 255)
] + [Parameter(name='x', value=ParameterValue(type=200))]


def player(folder) -> Node:
    from mtv_world_ros.ros.bags import player as module

    return Player(module._parse([str(EPISODE), '--no-wait']))


def recorder(folder) -> Node:
    from mtv_world_ros.ros.bags import recorder as module

    return Recorder(module.parse([str(folder / 'bag'), '/x']))


def viewer(folder) -> Node:
    return LiveViewer(None)


@contextmanager
def ended(node: Node) -> Iterator[Node]:
    try:
        yield node
    finally:
        getattr(node, 'close', node.destroy_node)()


@pytest.fixture
def signals() -> Iterator[None]:
    """Handlers of signals, which `run` sets, are put back."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


@pytest.fixture
def context() -> Iterator[None]:
    rclpy.init(args=['x', '--ros-args', '--log-level', 'FATAL'])
    yield
    rclpy.try_shutdown()


@pytest.mark.parametrize('make', [player, recorder, viewer, lambda _: Node('any')])
@pytest.mark.parametrize('name', ['set_parameters', 'set_parameters_atomically'])
def test_a_request_with_a_value_of_no_type_is_refused_with_a_reason(make, name, tmp_path, signals):
    """By what `run` does with every node of the package."""
    kind = srv.SetParameters if name == 'set_parameters' else srv.SetParametersAtomically
    answers = []

    def ask(node: Node) -> None:
        served = next(s for s in node.services if s.srv_name.endswith(f'/{name}'))
        for rows in ([one] for one in STRANGE):
            response = served.callback(kind.Request(parameters=rows), kind.Response())
            answers.append(getattr(response, 'results', None) or [response.result])

    arguments = ['x', '--ros-args', '--log-level', 'FATAL']
    assert run_node.run(lambda: make(tmp_path), arguments, spin=ask) == 0
    assert len(answers) == len(STRANGE) and all(len(results) == 1 for results in answers)
    assert all(not one.successful and one.reason for results in answers for one in results)


def test_services_are_guarded_once(context):
    with ended(Node('any')) as node:
        guard_parameter_services(node)
        callbacks = [service.callback for service in node.services]
        guard_parameter_services(node)
        assert [service.callback for service in node.services] == callbacks


@pytest.mark.parametrize(
    ('kind', 'named'), [('subscribers', Peers.unconnected), ('publishers', Peers.unheard)]
)
@pytest.mark.parametrize('count', ['', 'x', '-1', '1e9', '\N{SUPERSCRIPT TWO}', '9' * 5000, '٣'])
def test_a_count_of_diagnostics_that_is_no_number_says_nothing(context, count, kind, named):
    with ended(Node('any')) as node:
        peers = Peers(node)
        values = [KeyValue(key=f'{kind}./plan', value=count)]
        peers._on_diagnostics(DiagnosticArray(status=[DiagnosticStatus(name='n', values=values)]))
        assert named(peers, ['/plan']) == []
        values = [KeyValue(key=f'{kind}./plan', value='0')]
        peers._on_diagnostics(DiagnosticArray(status=[DiagnosticStatus(name='n', values=values)]))
        assert named(peers, ['/plan']) == ['/plan']


def test_a_message_that_cannot_be_shown_does_not_end_the_viewer(context, monkeypatch):
    with ended(LiveViewer(None)) as node:
        monkeypatch.setattr(node, '_show', lambda *_: 1 / 0)
        node._handler('/topic', 'std_msgs/msg/String')(b'')
        assert node._num_refused == 1


@pytest.mark.parametrize('name', ['SetParameters', 'SetParametersAtomically', 'GetParameters'])
def test_a_request_of_many_items_is_refused_before_it_is_decoded(name, context):
    kind = getattr(srv, name)
    field, item = ('names', 'x') if name == 'GetParameters' else ('parameters', Parameter())
    with ended(Node('many')) as node, ended(Node('client')) as client:
        run_node.guard_node(node)
        run_node.guard_node(node)
        (served,) = (s for s in node.services if isinstance(s.srv_type.Request(), kind.Request))
        caller = client.create_client(kind, served.srv_name)
        assert caller.wait_for_service(60.0)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        for count in (100_000, 1):
            answer, spent_s = caller.call_async(kind.Request(**{field: [item] * count})), 0.0
            while not answer.done():
                begin_s = time.thread_time()
                executor.spin_once(timeout_sec=0.1)
                spent_s += time.thread_time() - begin_s
                rclpy.spin_once(client, timeout_sec=0.1)
            assert spent_s < 0.1
            values = list(results_of(answer.result()))
            said = [value.reason for value in values if hasattr(value, 'reason')]
            is_refused = any('100000 items; at most 2000 are read' in text for text in said)
            assert is_refused == (count > 1 and name != 'GetParameters')
            assert len(values) == 1 or name == 'GetParameters' and not values


def results_of(response) -> list:
    """Return the results of a response, whether it has one or several."""
    one = getattr(response, 'result', None)
    several = getattr(response, 'results', getattr(response, 'values', []))
    return [one] if one is not None else list(several)
