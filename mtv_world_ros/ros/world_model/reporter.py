"""Counts and publishes what happens: `~/report` at once, `/diagnostics` once a period."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import time
import traceback
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from rclpy.publisher import Publisher

from mtv_world_ros.ros.messages.conversions import to_diagnostics, to_status
from mtv_world_ros.ros.messages.rejection import Reason, Rejection
from mtv_world_ros.ros.messages.stamps import make_header
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.status_publisher import create_publisher
from mtv_world_ros.ros.world_model import report
from mtv_world_ros.ros.world_model.diagnostics import Tally
from mtv_world_ros.ros.world_model.live_fidelity import Scored
from mtv_world_ros.ros.world_model.prediction_publisher import Sent
from mtv_world_ros.ros.world_model.worker import Chunk, Ended

_LEVELS = {
    'rejected': DiagnosticStatus.WARN,
    'failed': DiagnosticStatus.ERROR,
}


class Reporter:
    """Publishes reports and diagnostics.

    Args:
        node: owner of the publishers and the logger.
        hardware_id: name of the robot.
        settings: the present parameters.
        state: what else `/diagnostics` shows, asked each time.
    """

    def __init__(
        self,
        node: Node,
        hardware_id: str,
        settings: Callable[[], Settings],
        state: Callable[[], Mapping[str, object]],
    ) -> None:
        self._node, self._hardware_id = node, hardware_id
        self._settings, self._state = settings, state
        self._tally = Tally()
        self._report = create_publisher(node, DiagnosticArray, '~/report', 100)
        self._diagnostics = create_publisher(node, DiagnosticArray, '/diagnostics', 10)

    def count(self, what: str) -> None:
        """Counts something that is no rejection."""
        self._tally.counts[what] += 1

    def reject(self, error: Rejection) -> None:
        """Counts a refused message; `/diagnostics` says why at its next period."""
        self._tally.reject(error, time.monotonic())
        self._node.get_logger().warning(
            f'rejected ({error.reason}): {error}', throttle_duration_sec=1.0
        )

    def reject_trajectory(self, error: Rejection, trajectory_stamp_ns: int) -> None:
        """Counts and reports a refused trajectory; `/diagnostics` says why at once."""
        self.reject(error)
        values = report.rejection_values(error, trajectory_stamp_ns)
        self._publish_report('rejected', values)
        self.publish_diagnostics()

    def guarded(self, handle: Callable[[Any], None]) -> Callable[[Any], None]:
        """Returns the handler as a callback that no message makes raise."""

        def callback(message: Any) -> None:
            try:
                handle(message)
            except Rejection as error:
                self.reject(error)
            except Exception as error:  # the node never dies of a message
                self.crash(error)

        return callback

    def crash(self, error: Exception) -> None:
        """Counts an error that nobody raised on purpose."""
        if not self._node.context.ok():
            return  # ROS was shut down under a callback
        self._node.get_logger().error(''.join(traceback.format_exception(error)))
        text = f'{type(error).__name__}: {error}'
        self._tally.reject(Rejection(Reason.INTERNAL_ERROR, text), time.monotonic())

    def sent(self, chunk: Chunk, sent: Sent) -> None:
        """Counts and reports a chunk that is out, or whose rest was dropped."""
        values = report.chunk_values(chunk, sent, self._settings())
        counts = self._tally.counts
        counts['chunks'] += 1
        counts['frames_published'] += sent.num_frames
        counts['frames_dropped'] += len(chunk.prediction.rollout.video.times) - sent.num_frames
        self._tally.add_seconds(
            {
                name: value
                for name, value in values.items()
                if name.startswith('stage_s.') or name in ('latency_s', 'real_time_factor')
                if isinstance(value, float)
            }
        )
        values['frames_published_total'] = counts['frames_published']
        self._publish_report('chunk', values)

    def scored(self, scored: Scored) -> None:
        """Reports how a chunk compares with the real frames that came for it."""
        self._publish_report('fidelity', report.fidelity_values(scored))

    def ended(self, ended: Ended) -> None:
        """Counts and reports the end of a rollout."""
        self._tally.end(ended.state, ended.num_chunks)
        if ended.trace:
            self._node.get_logger().error(ended.trace)
        if ended.reason is not None:
            self.reject(Rejection(ended.reason, ended.text))
        self._publish_report(ended.state, report.ended_values(ended))
        if ended.reason is not None:
            self.publish_diagnostics()

    def publish_diagnostics(self) -> None:
        """Publishes `/diagnostics`."""
        now_s = time.monotonic()
        state = self._state()
        level, message = self._tally.level(now_s, num_policies=int(str(state['policies'])))
        values = {**state, **self._tally.values(now_s)}
        self._publish(self._diagnostics, '', level, message, values)

    def _publish_report(self, state: str, values: Mapping[str, object]) -> None:
        level = _LEVELS.get(state, DiagnosticStatus.OK)
        self._publish(self._report, ': rollout', level, state, {'state': state, **values})

    def _publish(
        self,
        publisher: Publisher,
        suffix: str,
        level: bytes,
        message: str,
        values: Mapping[str, object],
    ) -> None:
        name = f'{self._node.get_name()}{suffix}'
        status = to_status(name, self._hardware_id, level, message, values)
        header = make_header(self._node.get_clock().now().nanoseconds)
        publisher.publish(to_diagnostics(header, status))
