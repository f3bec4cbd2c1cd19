"""Newest diagnostics of other nodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from mtv_world_ros.ros.messages.bounded import subscribe_bounded
from mtv_world_ros.ros.messages.conversions import values_of


class Peers:
    """Keeps the newest diagnostics of every node.

    Nodes are distinguished by their full names, with the namespace.

    Args:
        node: owner of the subscription.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._newest: dict[str, dict[str, str]] = {}
        subscribe_bounded(node, DiagnosticArray, '/diagnostics', self._on_diagnostics, 100)

    def state(self, name: str) -> Mapping[str, str]:
        """Return the values of a node's newest diagnostics."""
        return self._newest.get(self._status_name(name), {})

    def unconnected(self, topics: Iterable[str]) -> list[str]:
        """Return the topics whose publisher, by its node's diagnostics, has no subscriber.

        Nodes that know each other from the graph may still not be connected, and what is
        published until then is lost.
        """
        return self._counted_zero('subscribers', topics)

    def unheard(self, topics: Iterable[str]) -> list[str]:
        """Return the topics whose subscriber, by its node's diagnostics, has no publisher.

        A publisher may count a subscriber that does not know it yet, and hears nothing.
        """
        return self._counted_zero('publishers', topics)

    def _counted_zero(self, kind: str, topics: Iterable[str]) -> list[str]:
        def is_counted(topic: str) -> bool:
            counts = (state.get(f'{kind}.{topic}') for state in self._newest.values())
            return any(count is not None and _is_zero(count) for count in counts)

        return [topic for topic in topics if is_counted(topic)]

    def _status_name(self, name: str) -> str:
        """Return a node's name, absolute or in this node's namespace, as diagnostics have it."""
        return self._node.resolve_service_name(name).lstrip('/')

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self._newest[status.name] = values_of(status)


def _is_zero(count: str) -> bool:
    """Return True if a count of another node's diagnostics is 0.

    What is no number says nothing.
    """
    return count.isascii() and count.isdecimal() and len(count) < 10 and int(count) == 0
