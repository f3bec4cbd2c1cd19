"""Counts faults and publishes a node's `~/report` and `/diagnostics`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_msgs.msg import Header

from mtv_world_ros.errors import ConfigError
from mtv_world_ros.ros.messages.conversions import make_header, to_diagnostics, to_status

#: a fault shows as a warning for this long [s]
_WARN_S = 5.0


class StatusPublisher:
    """What a node beside the world model has to say.

    Attributes:
        counts: whatever is counted, by name.

    Args:
        node: owner of the publishers and the logger.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.counts: Counter[str] = Counter()
        self._last: tuple[float, str] | None = None
        self._report = create_publisher(node, DiagnosticArray, '~/report', 100)
        self._diagnostics = create_publisher(node, DiagnosticArray, '/diagnostics', 10)

    def fault(self, kind: str, text: str) -> None:
        """Counts a fault; `/diagnostics` warns of it for a while."""
        self.counts[f'faults.{kind}'] += 1
        self._last = (time.monotonic(), f'{kind}: {text}')
        self._node.get_logger().warning(f'{kind}: {text}')

    def report(self, state: str, values: Mapping[str, object]) -> None:
        """Publishes a report at once."""
        status = to_status(
            f'{status_name(self._node)}: episode',
            '',
            DiagnosticStatus.OK,
            state,
            {'state': state, **values},
        )
        self._report.publish(to_diagnostics(self._header(), status))

    def publish_diagnostics(self, state: Mapping[str, object], warning: str = '') -> None:
        """Publishes `/diagnostics`: the state, the counts and the last fault.

        Args:
            state: keys and values.
            warning: current problem; empty = none.
        """
        values = {**state, **dict(sorted(self.counts.items()))}
        if self._last is not None:
            age = time.monotonic() - self._last[0]
            values |= {'last_fault': self._last[1], 'last_fault_age_s': age}
            recent = self._last[1] if age < _WARN_S else ''
            warning = '; '.join(filter(None, (recent, warning)))
        level = DiagnosticStatus.WARN if warning else DiagnosticStatus.OK
        status = to_status(status_name(self._node), '', level, warning or 'ready', values)
        self._diagnostics.publish(to_diagnostics(self._header(), status))

    def _header(self) -> Header:
        return make_header(self._node.get_clock().now().nanoseconds)


def status_name(node: Node) -> str:
    """Returns the node's name in diagnostics: with its namespace, without the first slash."""
    return node.get_fully_qualified_name().lstrip('/')


def create_publisher(node: Node, kind: Any, topic: str, depth: int) -> Publisher:
    """Returns a reliable publisher whose QoS can be overridden by parameters.

    Raises:
        ConfigError: an override is not one of the middleware's words.
    """
    try:
        return node.create_publisher(
            kind,
            topic,
            QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
    except (RuntimeError, InvalidParameterTypeException) as error:
        raise ConfigError(f"QoS override of '{topic}': {error}") from error
