"""Feedback and tolerances of goals, from the plan that is imagined; without control_msgs."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from mtv_world_ros.core.data_types import JointTrajectory, Observation
from mtv_world_ros.core.files import share_path
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.plan import Plan, PlanLimits
from mtv_world_ros.ros.world_model.follow_joint_trajectory import FollowJointTrajectory

YAM = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
HOME = np.array([0.0, 1.047, 1.047, 0.0, 0.0, 0.0, 0.03] * 2)
JOINTS = ('left_joint2', 'left_joint1')


def feedback_of(actual_last: float, tolerance: float = 0.0, offset_s: float = 0.25):
    """Feedback and violation of a goal that moves left_joint1 by 0.2 rad within a second.

    Args:
        actual_last: imagined position of that joint at the end of the chunk [rad].
        tolerance: of its path [rad]; 0 = none.
        offset_s: time from the observation to the goal's stamp [s].
    """
    start_ns = 10**11
    none = np.zeros((0, 1, 1, 3), np.uint8)
    seen = Observation(cameras=(), frames=none, positions=HOME, stamp_ns=start_ns)
    sent = JointTrajectory(joint_names=JOINTS, times=[1.0], positions=[[HOME[1], 0.2]])
    plan = Plan.of(
        sent, YAM, seen, PlanLimits(may_omit_joints=True), stamp_ns=start_ns + int(offset_s * 1e9)
    )
    times = np.array([0.5, 1.25])
    actual = plan.positions_at(times).copy()
    actual[-1, 0] = actual_last
    prediction = SimpleNamespace(
        stamp_ns=start_ns, chunk=0, num_chunks=1, positions=actual,
        video=SimpleNamespace(times=times),
    )  # fmt: skip
    sent_back, given_up = [], []
    path = [SimpleNamespace(name='left_joint1', position=tolerance)] if tolerance else []
    handle = SimpleNamespace(
        request=SimpleNamespace(path_tolerance=path, goal_tolerance=[]),
        publish_feedback=sent_back.append,
    )
    goal = SimpleNamespace(handle=handle, violation=None)
    server = object.__new__(FollowJointTrajectory)
    server._robot = YAM
    server._action = SimpleNamespace(Feedback=lambda **fields: SimpleNamespace(**fields))
    server._events = SimpleNamespace(give_up=lambda *told: given_up.append(told))
    request = SimpleNamespace(rollout=7)
    chunk = SimpleNamespace(prediction=prediction, request=request, plan=plan)
    server._follow(goal, chunk)
    (feedback,) = sent_back
    return feedback, goal.violation, given_up


def test_feedback_has_the_goals_joints_in_the_robots_order_on_the_goals_clock():
    feedback, violation, given_up = feedback_of(0.19)
    assert feedback.joint_names == ['left_joint1', 'left_joint2']
    assert list(feedback.desired.positions) == pytest.approx([0.2, HOME[1]])
    assert list(feedback.actual.positions) == pytest.approx([0.19, HOME[1]])
    assert list(feedback.error.positions) == pytest.approx([0.01, 0.0])
    after = feedback.desired.time_from_start
    assert after.sec + after.nanosec * 1e-9 == pytest.approx(1.0)
    assert violation is None and not given_up


def test_a_path_outside_of_its_tolerance_gives_the_plan_up():
    _, violation, given_up = feedback_of(0.1, tolerance=0.05)
    assert violation[0] == 'PATH_TOLERANCE_VIOLATED' and "'left_joint1' is 0.1000" in violation[1]
    assert given_up == [(7, violation[1])]
    assert feedback_of(0.16, tolerance=0.05)[1] is None
