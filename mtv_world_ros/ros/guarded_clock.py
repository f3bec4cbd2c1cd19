"""Guard of a node's clock against `/clock` messages that are no time."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node

from mtv_world_ros.ros.messages.conversions import NANO

#: greatest time that is taken [s]: stamps of predictions after it still fit a ROS time
MAX_CLOCK_S = 2**31 - 1 - 86_400


def guard_clock(node: Node) -> None:
    """Make the node ignore `/clock` messages with a negative time.

    rclpy raises on one, which ends the executor and the node. A second call
    changes nothing.
    """
    source: Any = node._time_source  # rclpy has no public way
    if isinstance(source.clock_callback, _GuardedClock):
        return
    taken = source.clock_callback
    source.clock_callback = _GuardedClock(node, taken)  # for subscriptions to come
    for subscription in node.subscriptions:
        if subscription.callback == taken:
            subscription.callback = source.clock_callback


class _GuardedClock:
    """Callback of `/clock` that takes times only.

    Args:
        node: node that the clock belongs to.
        take: rclpy's callback.
    """

    def __init__(self, node: Node, take: Any) -> None:
        self._log, self._take = node.get_logger(), take

    def __call__(self, message: Any) -> None:
        time = message.clock
        if 0 <= time.sec <= MAX_CLOCK_S and time.nanosec < NANO:
            self._take(message)
            return
        self._log.warning(
            f'/clock has {time.sec} s and {time.nanosec} ns, which is left out; it must be 0 to '
            f'{MAX_CLOCK_S} s and less than {NANO} ns. Is another program publishing /clock?',
            throttle_duration_sec=5.0,
        )
