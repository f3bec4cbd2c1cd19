"""A subscription that asks for what its publishers offer: reliable, latched, or neither."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from mtv_world_ros.errors import ConfigError

_RELIABILITIES = ('match', 'reliable', 'best_effort')
#: what every publisher can serve
_LOWEST = (ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE)
_HIGHEST = (ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)


class MatchedSubscription:
    """Starts with what every publisher can serve and asks for more once all of them offer it.

    Nothing is lost between the two: the first goes only at a refresh after the second is
    connected. Until then a message may come twice, so that this is for messages of which the
    newest counts. `qos_overrides.<topic>.subscription.reliability` (match, reliable, best_effort)
    and `.depth` override what it does.

    Args:
        node: owner.
        kind: message type.
        topic: relative or absolute name.
        callback: gets the messages.
        depth: messages kept.
        default: `match`, or `reliable`, `best_effort` for a plain subscription.
    """

    def __init__(
        self,
        node: Node,
        kind: Any,
        topic: str,
        callback: Callable[[Any], None],
        *,
        depth: int,
        default: str = 'match',
    ) -> None:
        self._node, self._kind, self._callback = node, kind, callback
        self.topic = node.resolve_topic_name(topic)
        prefix = f'qos_overrides.{self.topic}.subscription'
        read_only = ParameterDescriptor(read_only=True)
        choice = node.declare_parameter(f'{prefix}.reliability', default, read_only).value
        if choice not in _RELIABILITIES:
            raise ConfigError(
                f"parameter '{prefix}.reliability' is '{choice}'; it must be one of "
                f'{", ".join(_RELIABILITIES)}'
            )
        self._depth = node.declare_parameter(f'{prefix}.depth', depth, read_only).value
        self._matches = choice == 'match'
        self._qos = _LOWEST
        if choice == 'reliable':
            self._qos = (ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)
        self._current = self._create(self._qos)
        self._next: Subscription | None = None
        self._is_next_connected = False

    @property
    def num_publishers(self) -> int:
        """Publishers it is connected to."""
        return self._current.get_publisher_count()

    def refresh(self) -> None:
        """Looks at the publishers again; to be called now and then."""
        if self._next is not None and self._is_next_connected:
            self._node.destroy_subscription(self._current)
            self._current, self._next = self._next, None
        if not self._matches or self._next is not None:
            return
        offered = [
            (info.qos_profile.reliability, info.qos_profile.durability)
            for info in self._node.get_publishers_info_by_topic(self.topic)
        ]
        if not offered:
            return
        wanted = tuple(
            high if all(offer[at] == high for offer in offered) else _LOWEST[at]
            for at, high in enumerate(_HIGHEST)
        )
        if wanted != self._qos:
            self._qos = wanted
            self._is_next_connected = False
            self._next = self._create(wanted)

    def _create(self, qos: tuple[Any, ...]) -> Subscription:
        profile = QoSProfile(depth=self._depth, reliability=qos[0], durability=qos[1])
        try:
            events = SubscriptionEventCallbacks(
                matched=lambda event: self._on_matched(event, qos),
                incompatible_qos=lambda _: self.refresh(),
            )
            return self._node.create_subscription(
                self._kind, self.topic, self._callback, profile, event_callbacks=events
            )
        except UnsupportedEventTypeError:
            return self._node.create_subscription(self._kind, self.topic, self._callback, profile)

    def _on_matched(self, event: Any, qos: tuple[Any, ...]) -> None:
        if self._next is None:
            self.refresh()
        elif qos == self._qos and event.current_count:
            self._is_next_connected = True
