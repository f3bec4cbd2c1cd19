"""Quality of service: the profiles that nodes share, and the best that publishers offer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    LivelinessPolicy,
    qos_check_compatible,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.topic_endpoint_info import TopicEndpointInfo

#: deadlines from here on are none [ns]
_NO_DEADLINE_NS = 2**63 - 2**31
#: late subscribers get the last message
LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


def is_latched(profile: QoSProfile) -> bool:
    """Return True if the profile is transient local: late subscribers get earlier messages."""
    return profile.durability == DurabilityPolicy.TRANSIENT_LOCAL


def best_offer(publishers: Sequence[TopicEndpointInfo], depth: int) -> QoSProfile:
    """Return the strongest profile that is compatible with all publishers of a topic.

    Args:
        publishers: publishers of the topic, as the graph knows them.
        depth: messages that the subscription keeps.
    """
    offers = [publisher.qos_profile for publisher in publishers]
    is_reliable = all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if is_reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL
        if all(map(is_latched, offers))
        else DurabilityPolicy.VOLATILE,
    )


class QosWatch:
    """Reports peers whose quality of service is incompatible, so that no message arrives.

    Attributes:
        mismatches: present ones, as text with topic, both policies and the fix.

    Args:
        node: node whose subscriptions and publishers are compared with their peers.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._said: set[str] = set()
        self.mismatches: list[str] = []

    def refresh(self) -> None:
        """Look at the peers again and log new mismatches; to be called now and then."""
        node = self._node
        found: dict[str, None] = {}
        for subscription in tuple(node.subscriptions):
            topic, asked = subscription.topic_name, subscription.qos_profile
            for peer in node.get_publishers_info_by_topic(topic):
                found |= dict.fromkeys(_publisher_mismatch(topic, peer, asked))
        for publisher in tuple(node.publishers):
            topic, offered = publisher.topic_name, publisher.qos_profile
            for peer in node.get_subscriptions_info_by_topic(topic):
                found |= dict.fromkeys(_subscription_mismatch(topic, peer, offered))
        self.mismatches = list(found)
        for text in self.mismatches:
            if text not in self._said:
                self._said.add(text)
                node.get_logger().warning(text)


def _publisher_mismatch(topic: str, peer: TopicEndpointInfo, asked: QoSProfile) -> list[str]:
    """Return what a publisher does not offer, as at most one text."""
    policies = _missing_policies(peer.qos_profile, asked)
    if not policies:
        return []
    fix = ' and '.join(f'{policy} {wanted}' for policy, _, wanted in policies)
    text = f"nothing of '{_name(peer)}' is received on {topic}: it offers {_offers(policies)}"
    text += f'. Publish with {fix}'
    if any(policy == 'reliability' for policy, *_ in policies):
        name = f'qos_overrides.{topic}.subscription.reliability'
        text += f", or start this node with '{name}:=best_effort', which may lose messages"
    return [text]


def _subscription_mismatch(topic: str, peer: TopicEndpointInfo, offered: QoSProfile) -> list[str]:
    """Return what a subscription asks for beyond the offer, as at most one text."""
    policies = _missing_policies(offered, peer.qos_profile)
    if not policies:
        return []
    fix = ' and '.join(f'{policy} {held}' for policy, held, _ in policies)
    text = f"'{_name(peer)}' receives nothing on {topic}: this node offers {_offers(policies)}"
    return [f'{text}. Subscribe with {fix}']


def _missing_policies(offered: QoSProfile, asked: QoSProfile) -> list[tuple[str, str, str]]:
    """Return policy, offered and asked value of each policy that keeps two from connecting."""
    compatibility, _ = qos_check_compatible(offered, asked)
    if compatibility != QoSCompatibility.ERROR:
        return []
    pairs = {
        name: (getattr(offered, name), getattr(asked, name))
        for name in ('reliability', 'durability', 'liveliness', 'deadline')
    }
    missing = [
        (name, _word(held), _word(wanted))
        for name, (held, wanted) in pairs.items()
        if held != wanted and not _serves(name, held, wanted)
    ]
    return missing


def _serves(policy: str, offered: Any, asked: Any) -> bool:
    """Return whether an offer is at least what is asked for."""
    if policy == 'deadline':
        return _deadline_ns(offered) <= _deadline_ns(asked)
    strongest = {
        'reliability': ReliabilityPolicy.RELIABLE,
        'durability': DurabilityPolicy.TRANSIENT_LOCAL,
        'liveliness': LivelinessPolicy.MANUAL_BY_TOPIC,
    }[policy]
    return offered == strongest or asked != strongest


def _offers(policies: Sequence[tuple[str, str, str]]) -> str:
    return ' and '.join(
        f'{policy} {held}, asked for is {wanted}' for policy, held, wanted in policies
    )


def _deadline_ns(deadline: Duration) -> int:
    """Return a deadline [ns]; the graph has an infinite one, profiles have 0 for none."""
    return min(deadline.nanoseconds or _NO_DEADLINE_NS, _NO_DEADLINE_NS)


def _word(value: Any) -> str:
    if hasattr(value, 'name'):
        return str(value.name).lower()
    is_none = _deadline_ns(value) >= _NO_DEADLINE_NS
    return 'none' if is_none else f'{value.nanoseconds * 1e-9:g} s'


def _name(peer: TopicEndpointInfo) -> str:
    return f'{peer.node_namespace.rstrip("/")}/{peer.node_name}'
