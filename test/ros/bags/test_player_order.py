"""The order of what is played, and when; how plans ended."""

from mtv_world_ros.core.clock_offset import Offset
from mtv_world_ros.data.bag.reader import BagMessage
from mtv_world_ros.ros.bags import player
from mtv_world_ros.ros.bags.player import (
    describe_failed,
    describe_left_out,
    in_order,
    PlayedPlan,
    Timeline,
    UNANSWERED,
)
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
    timeline = Timeline(bag_ns=100 * NANO, steady_ns=1000 * NANO, rate=4.0, offset=Offset(0, 0))
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


def test_a_pause_between_two_readings_of_clocks_changes_no_stamp(monkeypatch):
    """The process does not run for .15 s whenever one clock was read."""
    now, pause = [1000 * NANO], [0]

    def read(offset_ns):
        value = now[0] + offset_ns
        now[0] += pause[0]
        return value

    monkeypatch.setattr(player.time, 'monotonic_ns', lambda: read(0))
    monkeypatch.setattr(player.time, 'time_ns', lambda: read(4000 * NANO))
    timeline = Timeline.now(bag_ns=100 * NANO, rate=1.0)
    pause[0] = 150_000_000
    assert timeline.stamp(102 * NANO) == 5002 * NANO
    pause[0] = 0
    assert timeline.stamp(102 * NANO) == 5002 * NANO


def test_plans_that_were_not_imagined_are_listed_by_reason_and_others_are_no_failure():
    def plan(bag_s, state, reason=''):
        return PlayedPlan(
            topic='/joint_trajectory',
            bag_s=bag_s,
            stamp_ns=round(bag_s * NANO),
            state=state,
            reason=reason,
        )

    good = [plan(0.0, 'done'), plan(0.8, 'preempted')]
    assert describe_failed(good) == ''
    bare, silent = 'camera_info_missing: none of ext1', 'no answer within 2 s'
    bad = [plan(1.6, 'rejected', bare), plan(2.4, UNANSWERED, silent), plan(3.2, 'rejected', bare)]
    assert describe_failed([*good, *bad, plan(4.0, 'failed')]).splitlines() == [
        '4 of 6 plans were not imagined',
        f'  2 rejected, at 1.60, 3.20 s: {bare}',
        f'  1 unanswered, at 2.40 s: {silent}',
        '  1 failed, at 4.00 s',
    ]
    many = describe_failed([plan(float(k), 'rejected', bare) for k in range(11)])
    assert '11 rejected, at 0.00, ' in many and '7.00 and 3 more s: ' in many


def test_topics_that_the_node_does_not_read_are_named_with_what_makes_it_read_them():
    said = describe_left_out({'/right/plan': 3, '/left/plan': 12}, ['/joint_trajectory'])
    assert "'/left/plan' (12 plans), '/right/plan' (3 plans)" in said
    assert 'the node reads /joint_trajectory' in said
    assert said.endswith('--ros-args -r /left/plan:=/joint_trajectory')
