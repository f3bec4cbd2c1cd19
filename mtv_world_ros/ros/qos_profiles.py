"""Quality of service: the profiles that nodes share, and the best that publishers offer."""

from __future__ import annotations

from collections.abc import Sequence

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

#: late subscribers get the last message
LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


def is_latched(profile: QoSProfile) -> bool:
    """Whether late subscribers get earlier messages."""
    return profile.durability == DurabilityPolicy.TRANSIENT_LOCAL


def best_offer(publishers: Sequence[TopicEndpointInfo], depth: int) -> QoSProfile:
    """Returns the best profile that all publishers of a topic can serve.

    Args:
        publishers: of the topic, as the graph knows them.
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
