"""The order of what is played, and when."""

from mtv_world_ros.data.bag.reader import BagMessage
from mtv_world_ros.ros.bags import player
from mtv_world_ros.ros.bags.player import in_order, Timeline
from mtv_world_ros.ros.messages.conversions import NANO


def message(topic, stamp_s, msgtype='sensor_msgs/msg/Image'):
    return BagMessage(topic, msgtype, round(stamp_s * NANO), b'')


def test_messages_play_by_time_with_the_plan_after_what_it_is_made_from():
    plan = message('/plan', 1.0, 'trajectory_msgs/msg/JointTrajectory')
    recorded = [plan, message('/low', 1.0), message('/late', 0.9), message('/high', 1.0)]
    recorded += [message('/low', 5.0), message('/high', 4.5), message('/low', 9.0)]
    assert [(m.topic, m.stamp_ns / NANO) for m in in_order(recorded)] == [
        ('/late', 0.9),
        ('/low', 1.0),
        ('/high', 1.0),
        ('/plan', 1.0),
        ('/high', 4.5),
        ('/low', 5.0),
        ('/low', 9.0),
    ]


def test_timeline_follows_rate_and_pauses():
    timeline = Timeline(bag_ns=100 * NANO, steady_ns=1000 * NANO, rate=4.0, offset_ns=0)
    assert timeline.due(108 * NANO) == 1002 * NANO
    assert timeline.bag_time(1001 * NANO) == 104 * NANO
    timeline.pause(3 * NANO)
    assert timeline.due(108 * NANO) == 1005 * NANO


def test_a_system_clock_that_is_set_changes_stamps_and_not_the_pace(monkeypatch):
    """A step of -90 s: nothing waits for 90 s, and what is stamped from then on is not stale."""
    steady, system = [1000 * NANO], [5000 * NANO]
    monkeypatch.setattr(player.time, 'monotonic_ns', lambda: steady[0])
    monkeypatch.setattr(player.time, 'time_ns', lambda: system[0])
    timeline = Timeline.now(bag_ns=100 * NANO, rate=1.0)
    assert timeline.stamp(102 * NANO) == 5002 * NANO
    steady[0] += NANO
    system[0] += NANO + 3_000_000  # two clocks that are read one after the other
    assert timeline.stamp(102 * NANO) == 5002 * NANO
    system[0] -= 90 * NANO
    assert timeline.due(102 * NANO) == 1002 * NANO
    assert timeline.stamp(102 * NANO) == 4912 * NANO + 3_000_000
