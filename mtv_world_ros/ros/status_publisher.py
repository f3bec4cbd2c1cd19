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

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.ros.messages.conversions import make_header, to_status
from mtv_world_ros.ros.namesakes import Namesakes, PROCESS

#: a fault shows as a warning for this long [s]
_WARN_S = 5.0
#: message of a node without problems
READY = 'ready'


class StatusPublisher:
    """Publishes a node's `~/report` and `/diagnostics`, and counts faults.

    Attributes:
        counts: whatever is counted, by name.
        hardware_id: hardware id of its statuses; empty = none.

    Args:
        node: owner of the publishers and the logger.
        subject: subject of the reports.
        reports_kept: number of reports kept for a busy subscriber.
    """

    def __init__(self, node: Node, subject: str = 'episode', reports_kept: int = 100) -> None:
        self._node, self._subject, self.hardware_id = node, subject, ''
        self.counts: Counter[str] = Counter()
        self._last: tuple[float, str] | None = None
        self._report = create_publisher(node, DiagnosticArray, '~/report', reports_kept)
        self._diagnostics = create_publisher(node, DiagnosticArray, '/diagnostics', 10)
        self._namesakes = Namesakes(node)

    def fault(self, kind: str, text: str) -> None:
        """Count a fault; `/diagnostics` warns of it for a while."""
        self.counts[f'faults.{kind}'] += 1
        self._last = (time.monotonic(), f'{kind}: {text}')
        self._node.get_logger().warning(f'{kind}: {text}')

    def report(
        self, state: str, values: Mapping[str, object], level: bytes = DiagnosticStatus.OK
    ) -> None:
        """Publish a report at once."""
        name = f': {self._subject}'
        self._publish(self._report, name, level, state, {'state': state, **values})

    def publish_diagnostics(self, state: Mapping[str, object], warning: str = '') -> None:
        """Publish `/diagnostics`: the state, the counts and the last fault.

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
        self.diagnose(level, warning or READY, values)

    def diagnose(self, level: bytes, message: str, values: Mapping[str, object]) -> None:
        """Publish `/diagnostics` as they are given, with the process and others of its name."""
        others = self._namesakes.warning()
        if others:
            level = max(level, DiagnosticStatus.WARN)
            message = others if message == READY else f'{message} | {others}'
        values = {**values, PROCESS: self._namesakes.process}
        self._publish(self._diagnostics, '', level, message, values)

    def _publish(
        self,
        publisher: Publisher,
        suffix: str,
        level: bytes,
        message: str,
        values: Mapping[str, object],
    ) -> None:
        node = self._node
        # in diagnostics a node has its namespace in its name, without the first slash
        name = f'{node.get_fully_qualified_name().lstrip("/")}{suffix}'
        status = to_status(name, self.hardware_id, level, message, values)
        header = make_header(node.get_clock().now().nanoseconds)
        publisher.publish(DiagnosticArray(header=header, status=[status]))


def create_publisher(node: Node, kind: Any, topic: str, depth: int) -> Publisher:
    """Return a reliable publisher whose QoS can be overridden by parameters.

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
