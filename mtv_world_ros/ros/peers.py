"""Other nodes: their diagnostics, services and parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.ros.messages.conversions import values_of

#: a service that does not answer within this long is gone [s]
_ANSWER_S = 30.0
#: if several nodes offer a service and one was killed, a request is sent again after this [s]
_ASK_AGAIN_S = 2.0
#: rmw_fastrtps drops the answer to whom it has not matched yet: asked again after this [s]
_LOST_ANSWER_S = 8.0


class Peers:
    """Keeps the newest diagnostics of every node, and talks to their services.

    Nodes are distinguished by their full names, with the namespace.

    Args:
        node: owner of the subscription and the clients.
        spin_once: handles callbacks for a moment; raises where waiting makes no sense any more.
    """

    def __init__(self, node: Node, spin_once: Callable[[], None]) -> None:
        self._node, self._spin_once = node, spin_once
        self._clients: dict[str, Client] = {}
        self._newest: dict[str, tuple[float, dict[str, str]]] = {}
        node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 100)

    def silence_s(self, name: str) -> float:
        """Age of a node's newest diagnostics [s]; infinite = it never published."""
        newest = self._newest.get(self._status_name(name))
        return float('inf') if newest is None else time.monotonic() - newest[0]

    def state(self, name: str) -> Mapping[str, str]:
        """Values of a node's newest diagnostics."""
        name = self._status_name(name)
        return self._newest[name][1] if name in self._newest else {}

    def unconnected(self, topics: Iterable[str], least: int = 1) -> list[str]:
        """Return the topics whose publisher, by its node's diagnostics, has too few subscribers.

        Two that know of each other from the graph may still not be connected, and what is
        published until then is lost.
        """
        states = [state for _, state in self._newest.values()]

        def has_too_few(topic: str) -> bool:
            counts = (state.get(f'subscribers.{topic}') for state in states)
            return any(count is not None and _is_below(count, least) for count in counts)

        return [topic for topic in topics if has_too_few(topic)]

    def forget(self, name: str) -> None:
        """Drop a node's diagnostics, so that the next ones are new."""
        self._newest.pop(self._status_name(name), None)

    def wait(self, condition: Callable[[], bool], what: str, timeout_s: float) -> None:
        """Spin until the condition holds.

        Raises:
            ConfigError: the condition does not hold in time.
        """
        end_s = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > end_s:
                raise ConfigError(f'waited {timeout_s:g} s in vain for {what}')
            self._spin_once()

    def call(self, kind: Any, name: str, request: Any, wait_s: float = _ANSWER_S) -> Any:
        """Call an idempotent service and return its answer.

        Raises:
            ConfigError: the node is missing or does not answer in time.
        """
        if name not in self._clients:
            self._clients[name] = self._node.create_client(kind, name)
        client = self._clients[name]
        self.wait(client.service_is_ready, f"service '{name}'; is its node running?", wait_s)
        asked: list[tuple[float, Future]] = []

        def is_due() -> bool:
            silent_s = time.monotonic() - asked[-1][0] if asked else float('inf')
            if silent_s > _LOST_ANSWER_S:
                return True
            # the graph shows a killed node for a while: it may have been the one that was asked
            return silent_s > _ASK_AGAIN_S and self._node.count_services(client.srv_name) > 1

        def is_answered() -> bool:
            if is_due():
                asked.append((time.monotonic(), client.call_async(request)))
            return any(future.done() for _, future in asked)

        self.wait(is_answered, f"an answer of service '{name}'", _ANSWER_S)
        return next(future.result() for _, future in asked if future.done())

    def set_parameters(self, node: str, values: Mapping[str, object]) -> None:
        """Set parameters of a node.

        Raises:
            ConfigError: the node refuses a parameter, or is missing.
        """
        parameters = [Parameter(name, value=v).to_parameter_msg() for name, v in values.items()]
        request = SetParameters.Request(parameters=parameters)
        results = self.call(SetParameters, f'{node}/set_parameters', request).results
        for name, result in zip(values, results, strict=True):
            if not result.successful:
                raise ConfigError(f"'{node}' refuses parameter '{name}': {result.reason}")

    def _status_name(self, name: str) -> str:
        """A node's name, absolute or in this node's namespace, as diagnostics have it."""
        return self._node.resolve_service_name(name).lstrip('/')

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self._newest[status.name] = (time.monotonic(), values_of(status))


def _is_below(count: str, least: int) -> bool:
    """True if a count of another node's diagnostics is below `least`; others say nothing."""
    return count.isascii() and count.isdecimal() and len(count) < 10 and int(count) < least
