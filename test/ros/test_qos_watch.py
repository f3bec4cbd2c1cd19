"""Peers whose quality of service does not match are named: topic, both policies and the fix."""

import time

import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed (pip install .[ros])')

from rclpy.duration import Duration  # noqa: E402
from rclpy.qos import (  # noqa: E402
    DurabilityPolicy,
    LivelinessPolicy,
    qos_check_compatible,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
)
from std_msgs.msg import String  # noqa: E402

from mtv_world_ros.ros.qos_profiles import _missing_policies, QosWatch  # noqa: E402

BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
PROFILES = [
    QoSProfile(
        depth=1,
        reliability=reliability,
        durability=durability,
        liveliness=liveliness,
        deadline=Duration(nanoseconds=deadline),
    )
    for reliability in (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE)
    for durability in (DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL)
    for liveliness in (LivelinessPolicy.AUTOMATIC, LivelinessPolicy.MANUAL_BY_TOPIC)
    for deadline in (0, 10**8, 10**9)
]


@pytest.fixture
def nodes():
    """The node that is watched, and a peer."""
    context = rclpy.Context()
    rclpy.init(context=context)
    made = [rclpy.create_node(name, context=context) for name in ('watched', 'policy')]
    yield made
    for node in made:
        node.destroy_node()
    rclpy.shutdown(context=context)


def mismatches(node):
    watch, end_s = QosWatch(node), time.monotonic() + 10
    while not watch.mismatches and time.monotonic() < end_s:
        time.sleep(0.01)
        watch.refresh()
    return watch.mismatches


def test_a_publisher_that_offers_less_is_named(nodes):
    node, peer = nodes
    node.create_subscription(String, '/joint_trajectory', print, RELIABLE)
    peer.create_publisher(String, '/joint_trajectory', BEST_EFFORT)
    (text,) = mismatches(node)
    assert text == (
        "nothing of '/policy' is received on /joint_trajectory: it offers reliability "
        'best_effort, asked for is reliable. Publish with reliability reliable, or start this '
        "node with 'qos_overrides./joint_trajectory.subscription.reliability:=best_effort', "
        'which may lose messages'
    )


def test_a_subscription_that_asks_for_more_is_named(nodes):
    node, peer = nodes
    node.create_publisher(String, '/report', RELIABLE)
    peer.create_subscription(String, '/report', print, LATCHED)
    (text,) = mismatches(node)
    assert text == (
        "'/policy' receives nothing on /report: this node offers durability volatile, asked for "
        'is transient_local. Subscribe with durability volatile'
    )


def test_what_matches_is_not_named(nodes):
    node, peer = nodes
    node.create_subscription(String, '/a', print, BEST_EFFORT)
    peer.create_publisher(String, '/a', LATCHED)
    while not node.count_publishers('/a'):
        time.sleep(0.01)
    watch = QosWatch(node)
    watch.refresh()
    assert watch.mismatches == []


@pytest.mark.parametrize('offered', PROFILES)
def test_whenever_the_middleware_does_not_connect_two_a_policy_is_named(offered):
    """Independent source: rmw's own check of two profiles."""
    for asked in PROFILES:
        missing = _missing_policies(offered, asked)
        is_refused = qos_check_compatible(offered, asked)[0] == QoSCompatibility.ERROR
        assert bool(missing) == is_refused, (offered, asked)
