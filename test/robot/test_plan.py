"""Plans: joints, times and limits are settled once; what cannot be a plan is refused by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.core.data_types import JointTrajectory, Observation, WorldModelSpec
from mtv_world_ros.core.errors import PlanError, PlanFault
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.plan import Plan, PlanLimits

NANO = 10**9
START_NS = 100 * NANO
HOME = np.array([0.0, 1.047, 1.047, 0.0, 0.0, 0.0, 0.03] * 2)
LIVE = PlanLimits(max_age_s=1.0, max_horizon_s=10.0, may_omit_joints=True)
SPEC = WorldModelSpec(views=(), fps=5.0, num_frames=4, width=64, height=48, robot='yam_bimanual')


def standing(positions=HOME, stamp_ns: int = START_NS) -> Observation:
    """An observation without views."""
    none = np.zeros((0, 1, 1, 3), np.uint8)
    return Observation(cameras=(), frames=none, positions=positions, stamp_ns=stamp_ns)


def moving(
    robot: RobotModel, times=(0.5, 1.0), joint: int = 0, by: float = 0.1
) -> JointTrajectory:
    """One joint of the robot moves away from home, the others rest."""
    rows = np.repeat(HOME[None], len(times), axis=0)
    rows[:, joint] += by * np.arange(1, len(times) + 1)
    return JointTrajectory(joint_names=robot.joint_names, times=times, positions=rows)


def only(trajectory: JointTrajectory, names: tuple[str, ...]) -> JointTrajectory:
    """The trajectory of some of its joints."""
    columns = [trajectory.joint_names.index(name) for name in names]
    return JointTrajectory(
        joint_names=names, times=trajectory.times, positions=trajectory.positions[:, columns]
    )


def test_joints_come_in_the_robots_order(yam):
    given = moving(yam)
    turned = only(given, yam.joint_names[::-1])
    plan = Plan.of(turned, yam, standing())
    assert plan.trajectory.joint_names == yam.joint_names
    np.testing.assert_array_equal(plan.trajectory.positions, given.positions)


@pytest.mark.parametrize(('offset_s', 'times'), [(0.25, [0.75, 1.25]), (-0.75, [-0.25, 0.25])])
def test_times_count_from_the_observation(yam, offset_s, times):
    stamp_ns = START_NS + round(offset_s * NANO)
    plan = Plan.of(moving(yam), yam, standing(), LIVE, stamp_ns=stamp_ns)
    np.testing.assert_allclose(plan.trajectory.times, times)
    assert plan.stamp_ns == START_NS and plan.given_ns == stamp_ns


def test_without_a_stamp_it_starts_at_the_observation(yam):
    given = moving(yam)
    assert Plan.of(given, yam, standing(), LIVE).trajectory.times is given.times


def test_joints_that_are_not_named_stay_where_they_are_even_beyond_their_limits(yam):
    """A measured gripper overshoots; the plan does not command it."""
    start = HOME.copy()
    gripper = yam.joint_names.index('left_gripper')
    start[gripper] = yam.upper[gripper] + 0.05
    some = only(moving(yam), yam.joint_names[:3])
    plan = Plan.of(some, yam, standing(start), LIVE)
    assert (plan.trajectory.positions[:, gripper] == start[gripper]).all()
    with pytest.raises(PlanError, match='are missing') as refused:
        Plan.of(some, yam, standing(start))
    assert refused.value.fault == PlanFault.NAMES


@pytest.mark.parametrize(
    ('changes', 'stamp_s', 'limits', 'fault'),
    [
        ({}, 98.5, LIVE, PlanFault.STALE),
        ({}, 98.9, replace(LIVE, max_age_s=5.0), PlanFault.STALE),  # is over
        ({}, 109.5, LIVE, PlanFault.TOO_LONG),
        ({'by': 9.0}, 100.0, LIVE, PlanFault.LIMITS),
        ({'by': 0.55, 'times': (0.5, 0.55)}, 100.0, LIVE, PlanFault.SPEEDS),
    ],
)
def test_what_is_wrong_is_named_by_its_fault(yam, changes, stamp_s, limits, fault):
    trajectory = moving(yam, **changes)
    with pytest.raises(PlanError) as refused:
        Plan.of(trajectory, yam, standing(), limits, stamp_ns=round(stamp_s * NANO))
    assert refused.value.fault == fault


def test_a_plan_is_checked_anew_where_the_robot_stands_elsewhere_alone(yam):
    plan = Plan.of(moving(yam), yam, standing(), LIVE)
    assert plan.after(standing()) is plan
    later = plan.after(standing(stamp_ns=START_NS + NANO // 4))
    np.testing.assert_allclose(later.trajectory.times, [0.25, 0.75])
    elsewhere = HOME.copy()
    elsewhere[0] -= 2.5
    with pytest.raises(PlanError, match='left_joint1') as refused:
        plan.after(standing(elsewhere, START_NS + NANO // 2))
    assert refused.value.fault == PlanFault.SPEEDS


@pytest.mark.parametrize(
    ('end_s', 'kept'), [(0.8, [4]), (0.81, [4, 1]), (0.1, [1]), (1.6, [4, 4]), (2.0, [4, 4, 2])]
)
def test_chunks_cover_the_plan_and_no_more(yam, end_s, kept):
    plan = Plan.of(moving(yam, times=(end_s,)), yam, standing())
    chunks = plan.chunks(SPEC)
    assert [chunk.num_frames for chunk in chunks] == kept
    assert {len(chunk.times) for chunk in chunks} == {5}
    times = np.concatenate([chunk.times[1:] for chunk in chunks])
    np.testing.assert_allclose(times, np.arange(1, 4 * len(kept) + 1) / 5.0)
    # linear from home on, then held
    expected = HOME[0] + 0.1 * np.minimum(times / end_s, 1.0)
    rows = np.concatenate([chunk.positions[1:, 0] for chunk in chunks])
    np.testing.assert_allclose(rows, expected, atol=1e-12)
    for before, after in zip(chunks, chunks[1:], strict=False):
        np.testing.assert_array_equal(before.positions[-1], after.positions[0])


def test_arrays_of_plans_and_chunks_are_read_only(yam):
    (chunk, *_) = Plan.of(moving(yam), yam, standing()).chunks(SPEC)
    for array in (chunk.times, chunk.positions, chunk.plan.start_positions):
        with pytest.raises(ValueError, match='read-only'):
            array[...] = 0


def test_a_first_point_before_the_stamp_is_refused(yam):
    for times, is_refused in (((-5.0, 1.0), True), ((0.0, 1.0), False)):
        plan = moving(yam, times=times, by=0.0)
        if not is_refused:
            Plan.of(plan, yam, standing(), LIVE)
            continue
        with pytest.raises(PlanError, match='point 0 is 5 s before the stamp') as refused:
            Plan.of(plan, yam, standing(), LIVE)
        assert refused.value.fault is PlanFault.TIMES
