"""Random glitches of commands: each of its own kind, none beyond what is published."""

from __future__ import annotations

import numpy as np
import pytest

from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.simulation.faults import glitches
from mtv_world_ros.simulation.faults.glitches import with_glitches
from mtv_world_ros.simulation.faults.signals import Commands

PERIOD, GRIPPERS = 0.02, [6, 13]


def commands(name: str = 'yam_bimanual') -> Commands:
    """The second arm, if there is one, rests; the first moves evenly and closes its gripper."""
    robot = load_robot(robot_path(name))
    positions = np.zeros((400, len(robot.joint_names)))
    positions[:, :3] = np.linspace(0.0, 1.0, 400)[:, None] * [0.5, 1.0, -0.5]
    tool = robot.tools[0]
    gripper = robot.joint_names.index(tool.gripper_joint)
    ends = (tool.gripper_open, tool.gripper_closed)
    positions[:, gripper] = np.interp(np.arange(400), (195, 200), ends)
    return Commands(positions, PERIOD, robot)


def test_the_same_seed_gives_the_same_glitches_and_points_tell_them_all():
    given = commands()
    one, same, other = (with_glitches(given, 4, np.random.default_rng(s)) for s in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 1e-3
    assert one.shape == given.positions.shape and np.isfinite(one).all()
    # straight between the points that a policy publishes
    bends = np.abs(np.diff(one, n=2, axis=0)).max(axis=1)
    assert bends[np.arange(1, len(one) - 1) % 5 != 0][:-4].max() < 1e-12
    points = np.arange(400) // 5 * 5 == np.arange(400)
    plain = with_glitches(given, 0, np.random.default_rng(1))
    np.testing.assert_allclose(plain[points], given.positions[points])


@pytest.mark.parametrize('seed', range(6))
def test_grippers_jerk_within_their_range_and_joints_stay_or_the_other_way_round(seed):
    given, rng = commands(), np.random.default_rng(seed)
    arms = [j for j in range(14) if j not in GRIPPERS]
    jerked = glitches._gripper(given, rng)
    np.testing.assert_array_equal(jerked[:, arms], given.positions[:, arms])
    assert (
        jerked[:, GRIPPERS].min() >= 0
        and jerked[:, GRIPPERS].max() <= given.robot.tools[0].gripper_open + 1e-9
    )
    assert np.abs(jerked - given.positions).max() > 0
    for glitch in (glitches._joints, glitches._other_arm):
        off = glitch(given, rng)
        np.testing.assert_array_equal(off[:, GRIPPERS], given.positions[:, GRIPPERS])
        assert np.abs(off - given.positions)[:, arms].max() > 1e-4


def test_time_stands_jumps_or_runs_and_brings_nothing_that_was_not_commanded():
    given = commands()
    drawn = [glitches._time(given, np.random.default_rng(seed)) for seed in range(20)]
    low, high = given.positions.min(axis=0), given.positions.max(axis=0)
    for warped in drawn:
        assert warped.shape == given.positions.shape
        assert (warped >= low - 1e-9).all() and (warped <= high + 1e-9).all()
        np.testing.assert_allclose(warped[0], given.positions[0])
        # joints of one arm stay in step
        np.testing.assert_allclose(warped[:, 1], 2 * warped[:, 0], atol=1e-9)
    ends = {round(float(warped[-1, 1]), 2) for warped in drawn}
    assert 1.0 in ends and len(ends) > 3
    stands = [(np.diff(warped[:, 1]) == 0).sum() for warped in drawn]
    assert max(stands) > 20


def test_an_arm_at_rest_moves_along_and_one_arm_alone_has_joints_that_are_off():
    rest = slice(7, 13)
    moved = [glitches._other_arm(commands(), np.random.default_rng(s))[:, rest] for s in range(8)]
    assert min(np.abs(other).max() for other in moved) > 0.1
    one = commands('franka')
    alone = glitches._other_arm(one, np.random.default_rng(0))
    assert np.abs(alone - one.positions).max() > 1e-4
