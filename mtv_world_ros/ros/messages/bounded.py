"""Subscriptions whose messages are refused by their size before rclpy decodes them."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from trajectory_msgs.msg import JointTrajectory

from mtv_world_ros.core.bounded_input import LimitError
from mtv_world_ros.data.bag.message_sizes import check_size
from mtv_world_ros.ros.messages.rejection import Reason, Rejection


def decode(kind: Any, data: bytes, limit: str = '') -> Any:
    """Deserialise a message after its size was checked.

    Args:
        kind: class of the message.
        data: CDR bytes, as a raw subscription gives them.
        limit: field of `Limits`; empty = that of the type.

    Raises:
        Rejection: it is too large, or no such message.
    """
    package, name = kind.__module__.partition('.')[0], kind.__name__
    is_plan = kind is JointTrajectory
    try:
        check_size(f'{package}/msg/{name}', data, limit)
        return deserialize_message(data, kind)
    except LimitError as error:
        reason = Reason.TRAJECTORY_MALFORMED if is_plan else Reason.MESSAGE_TOO_LARGE
        raise Rejection(reason, str(error)) from error
    except RuntimeError as error:  # rclpy's own class for this is private
        reason = Reason.TRAJECTORY_MALFORMED if is_plan else Reason.MESSAGE_MALFORMED
        raise Rejection(reason, f'{len(data)} bytes hold no whole {name}') from error


def bounded(kind: Any, handle: Callable[..., None], limit: str = '') -> Callable[..., None]:
    """Return a callback for raw subscriptions, which deserialises messages by `decode`.

    Args:
        kind: class of the message.
        handle: receiver of the messages; with two arguments also of rclpy's information.
        limit: see `decode`.
    """

    @wraps(handle)  # rclpy looks at its signature
    def take(data: bytes, *info: Any) -> None:
        handle(decode(kind, data, limit), *info)

    return take


def subscribe_bounded(
    node: Node, kind: Any, topic: str, handle: Callable[[Any], None], qos: QoSProfile | int
) -> Subscription:
    """Subscribe to a topic; refused messages are only logged."""
    take = bounded(kind, handle)

    def logged(data: bytes) -> None:
        try:
            take(data)
        except Rejection as error:
            node.get_logger().warning(f'{topic}: {error}', throttle_duration_sec=5.0)

    return node.create_subscription(kind, topic, logged, qos, raw=True)
