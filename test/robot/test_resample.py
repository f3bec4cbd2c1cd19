import numpy as np
import pytest

from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.errors import TrajectoryError
from mtv_world_ros.robot.resample import match_joints, resample


def cubic(times):
    """Positions and velocities of two joints that move along cubic polynomials."""
    t = np.asarray(times, float)[:, None]
    polynomials = (np.poly1d([0.3, -1.0, 0.5, 0.2]), np.poly1d([-0.1, 0.4, 0.0, -1.0]))
    positions = np.concatenate([p(t) for p in polynomials], axis=1)
    return positions, np.concatenate([p.deriv()(t) for p in polynomials], axis=1)


def test_with_velocities_a_cubic_motion_is_met_exactly():
    knots = np.array([0.0, 0.3, 0.35, 1.1, 2.0])
    positions, velocities = cubic(knots)
    trajectory = JointTrajectory(
        joint_names=('a', 'b'), times=knots, positions=positions, velocities=velocities
    )
    wanted = np.linspace(0, 2, 81)
    found = resample(trajectory, np.zeros(2), wanted)
    np.testing.assert_allclose(found, cubic(wanted)[0], atol=1e-12)


def test_without_velocities_it_runs_straight_from_point_to_point():
    generator = np.random.default_rng(0)
    knots, values = np.array([0.0, 0.1, 0.5, 0.7]), generator.normal(size=(4, 2))
    trajectory = JointTrajectory(joint_names=('a', 'b'), times=knots, positions=values)
    wanted = generator.uniform(0, 0.7, 50)
    expected = np.stack([np.interp(wanted, knots, column) for column in values.T], axis=1)
    np.testing.assert_allclose(resample(trajectory, np.zeros(2), wanted), expected, atol=1e-12)


@pytest.mark.parametrize('velocities', [None, np.array([[4.0], [0.0]])])
def test_it_starts_where_the_robot_stands(velocities):
    trajectory = JointTrajectory(
        joint_names=('a',), times=[0.5, 1.0], positions=[[2.0], [3.0]], velocities=velocities
    )
    found = resample(trajectory, np.array([1.0]), np.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(found[:, 0], [1, 2, 3])
    early = resample(trajectory, np.array([1.0]), np.array([0.01]))[0, 0]
    assert early == pytest.approx(1.02, abs=0.002)


def test_a_first_point_at_zero_replaces_the_start_positions():
    trajectory = JointTrajectory(joint_names=('a',), times=[0.0, 1.0], positions=[[5.0], [6.0]])
    assert resample(trajectory, np.array([1.0]), np.array([0.0]))[0, 0] == 5


def test_a_trajectory_that_began_in_the_past_is_entered_where_it_stands_now():
    trajectory = JointTrajectory(joint_names=('a',), times=[-1.0, 1.0], positions=[[0.0], [2.0]])
    found = resample(trajectory, np.array([9.0]), np.array([0.0, 0.5]))
    np.testing.assert_allclose(found[:, 0], [1.0, 1.5])


def test_after_the_last_point_it_holds():
    positions, velocities = cubic([0.0, 1.0])
    trajectory = JointTrajectory(
        joint_names=('a', 'b'), times=[0.0, 1.0], positions=positions, velocities=velocities
    )
    found = resample(trajectory, np.zeros(2), np.array([1.0, 1.5, 10.0]))
    np.testing.assert_allclose(found, np.repeat(positions[1:], 3, axis=0))


@pytest.mark.parametrize('velocities', [None, [[0.0]]])
def test_a_single_point_is_approached_and_held(velocities):
    trajectory = JointTrajectory(
        joint_names=('a',), times=[1.0], positions=[[2.0]], velocities=velocities
    )
    found = resample(trajectory, np.array([0.0]), np.array([0.0, 1.0, 2.0]))
    np.testing.assert_allclose(found[:, 0], [0, 2, 2], atol=1e-12)
    now = JointTrajectory(joint_names=('a',), times=[0.0], positions=[[2.0]])
    np.testing.assert_array_equal(resample(now, np.zeros(1), np.array([0.0, 5.0])), [[2.0], [2.0]])


def test_points_are_met_at_their_own_times_whatever_their_spacing():
    generator = np.random.default_rng(1)
    knots = np.cumsum(generator.uniform(1e-3, 1, 30))
    trajectory = JointTrajectory(
        joint_names=('a', 'b'), times=knots, positions=generator.normal(size=(30, 2)),
        velocities=generator.normal(size=(30, 2)),
    )  # fmt: skip
    found = resample(trajectory, np.zeros(2), knots)
    np.testing.assert_allclose(found, trajectory.positions, atol=1e-12)


def shuffled(yam, extra=()):
    generator = np.random.default_rng(4)
    names = [*yam.joint_names, *extra]
    order = generator.permutation(len(names))
    columns = np.arange(len(names), dtype=float)
    return JointTrajectory(
        joint_names=tuple(names[i] for i in order),
        times=[0.0, 1.0],
        positions=np.stack([columns[order], columns[order] + 100]),
        velocities=np.stack([columns[order] + 200] * 2),
    )


def test_joints_are_matched_by_name_in_any_order_and_extra_ones_dropped(yam):
    matched = match_joints(shuffled(yam, ('head_pan', 'torso')), yam)
    assert matched.joint_names == yam.joint_names
    np.testing.assert_array_equal(matched.positions[0], np.arange(14))
    np.testing.assert_array_equal(matched.positions[1], np.arange(14) + 100)
    assert matched.velocities is not None
    np.testing.assert_array_equal(matched.velocities[0], np.arange(14) + 200)


def without(trajectory: JointTrajectory, joint: str) -> JointTrajectory:
    kept = [i for i, name in enumerate(trajectory.joint_names) if name != joint]
    assert trajectory.velocities is not None
    return JointTrajectory(
        joint_names=tuple(trajectory.joint_names[i] for i in kept), times=trajectory.times,
        positions=trajectory.positions[:, kept], velocities=trajectory.velocities[:, kept],
    )  # fmt: skip


def test_missing_joints_are_named(yam):
    trajectory = without(shuffled(yam), 'left_joint3')
    with pytest.raises(TrajectoryError, match=r"\['left_joint3'\] of robot 'yam_bimanual'"):
        match_joints(trajectory, yam)


def test_missing_joints_hold_their_position_where_that_is_allowed(yam):
    trajectory = without(shuffled(yam), 'left_joint3')
    current = np.full(14, -7.0)
    matched = match_joints(trajectory, yam, current)
    np.testing.assert_array_equal(matched.positions[:, 2], [-7, -7])
    np.testing.assert_array_equal(matched.positions[0, 3:], np.arange(3, 14))
    assert matched.velocities is not None
    np.testing.assert_array_equal(matched.velocities[:, 2], [0, 0])


def test_joints_named_twice_and_broken_velocities_are_refused(yam):
    names = (*yam.joint_names, 'left_joint1')
    trajectory = JointTrajectory(joint_names=names, times=[0.0], positions=np.zeros((1, 15)))
    with pytest.raises(TrajectoryError, match=r"\['left_joint1'\] are named more than once"):
        match_joints(trajectory, yam)
    velocities = np.zeros((1, 14))
    velocities[0, 4] = np.nan
    trajectory = JointTrajectory(
        joint_names=yam.joint_names, times=[0.0], positions=np.zeros((1, 14)),
        velocities=velocities,
    )  # fmt: skip
    with pytest.raises(TrajectoryError, match="velocity of joint 'left_joint5'"):
        match_joints(trajectory, yam)
