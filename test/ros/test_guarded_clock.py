"""Messages on `/clock` that are no time end no node and change no time."""

import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed (pip install .[ros])')

from builtin_interfaces.msg import Time  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402

from mtv_world_ros.ros.guarded_clock import guard_clock, MAX_CLOCK_S  # noqa: E402
from mtv_world_ros.ros.messages.conversions import NANO, to_stamp  # noqa: E402

NO_TIMES = (
    Time(sec=-1),
    Time(sec=-(2**31)),
    Time(sec=2**31 - 1, nanosec=2**32 - 1),
    Time(sec=MAX_CLOCK_S + 1),
    Time(sec=5, nanosec=NANO),
)
USE_SIM_TIME = Parameter('use_sim_time', value=True)


@pytest.fixture
def make_node():
    """Make nodes in a context of their own."""
    context = rclpy.Context()
    rclpy.init(context=context)
    nodes = []

    def make(*overrides):
        node = rclpy.create_node(
            f'node{len(nodes)}', context=context, parameter_overrides=list(overrides)
        )
        nodes.append(node)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        return node, executor

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)


@pytest.mark.parametrize('is_simulated_at_start', [True, False])
def test_a_clock_that_is_no_time_is_left_out(make_node, is_simulated_at_start):
    peer, _ = make_node()
    node, executor = make_node(*([USE_SIM_TIME] if is_simulated_at_start else []))
    for _ in range(2):
        guard_clock(node)
    if not is_simulated_at_start:  # as a peer may do
        node.set_parameters([USE_SIM_TIME])
    publisher = peer.create_publisher(Clock, '/clock', 10)

    def publish_until_taken(stamp, until_s):
        for _ in range(500):
            publisher.publish(Clock(clock=stamp))
            executor.spin_once(timeout_sec=0.01)  # an exception in a callback comes out here
            if node.get_clock().now().nanoseconds == until_s * NANO:
                return

    publish_until_taken(Time(sec=7), 7)
    assert node.get_clock().now().nanoseconds == 7 * NANO
    for stamp in NO_TIMES:
        for _ in range(3):
            publisher.publish(Clock(clock=stamp))
            executor.spin_once(timeout_sec=0.05)
        assert node.get_clock().now().nanoseconds == 7 * NANO
    publish_until_taken(Time(sec=8), 8)
    assert node.get_clock().now().nanoseconds == 8 * NANO


def test_predictions_after_the_greatest_time_have_a_stamp():
    """`max_horizon_s` is an hour at most."""
    assert to_stamp((MAX_CLOCK_S + 2 * 3600) * NANO).sec == MAX_CLOCK_S + 2 * 3600
