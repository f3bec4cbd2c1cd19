"""What of a plan a robot cannot follow: names the joint, its speed and the limit."""

from __future__ import annotations

import numpy as np
import pytest

from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.errors import TrajectoryError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.plan_limits import check_speeds, speed_limits

#: speeds in the URDF of the bundled robot's shoulders and wrists [rad/s], twice that is accepted
SHOULDER, WRIST = 5.4, 20.0


@pytest.fixture(scope='module')
def yam():
    return load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))


def plan_of(
    robot, joint: str, times, values, velocities=None
) -> tuple[JointTrajectory, np.ndarray]:
    """One joint moves, the others rest in the middle of their range, where it was at first."""
    middle = (robot.lower + robot.upper) / 2
    rows, column = np.repeat(middle[None], len(times), axis=0), robot.joint_names.index(joint)
    rows[:, column] += values
    speeds = None
    if velocities is not None:
        speeds = np.zeros_like(rows)
        speeds[:, column] = velocities
    plan = JointTrajectory(
        joint_names=robot.joint_names,
        times=np.array(times),
        positions=rows,
        velocities=speeds,
    )
    return plan, middle


@pytest.mark.parametrize(('joint', 'speed'), [('left_joint1', SHOULDER), ('left_joint4', WRIST)])
def test_twice_the_speed_of_the_description_is_accepted_and_no_more(yam, joint, speed):
    for share, times in ((1.99, (0.2, 0.225)), (2.01, (0.2, 0.225))):
        plan, start = plan_of(yam, joint, times, (0.0, share * speed * 0.025))
        if share < 2:
            check_speeds(yam, plan, start)
        else:
            with pytest.raises(
                TrajectoryError, match=rf"'{joint}'.*{2 * speed:g} rad/s.*accepted"
            ):
                check_speeds(yam, plan, start)


def test_a_joint_without_a_speed_has_the_default_and_a_gripper_any(yam, tmp_path):
    text = share_path('config', 'robots', 'yam_bimanual', 'yam_bimanual.urdf').read_text()
    (tmp_path / 'yam_bimanual.urdf').write_text(text.replace('velocity="5.4"', 'velocity="0"'))
    yaml = share_path('config', 'robots', 'yam_bimanual', 'robot.yaml').read_text()
    (tmp_path / 'r.yaml').write_text(yaml)
    limits = dict(zip(yam.joint_names, speed_limits(load_robot(tmp_path / 'r.yaml')), strict=True))
    assert limits['left_joint1'] == 20.0
    assert limits['left_joint4'] == 40.0
    assert limits['left_gripper'] == np.inf


def test_a_gripper_may_close_from_one_row_to_the_next(yam):
    plan, start = plan_of(yam, 'left_gripper', (0.02, 0.04, 0.06), (0.018, -0.018, 0.018))
    check_speeds(yam, plan, start)


def test_an_arm_that_lags_may_catch_up_and_does_not_jump(yam):
    near, start = plan_of(yam, 'left_joint1', (0.0, 0.1), (0.3, 0.3))
    check_speeds(yam, near, start)
    far, start = plan_of(yam, 'left_joint1', (0.0, 0.1), (2.5, 2.5))
    with pytest.raises(TrajectoryError, match='12.5 rad/s'):
        check_speeds(yam, far, start)


def test_what_is_over_is_not_looked_at(yam):
    plan, start = plan_of(yam, 'left_joint1', (-0.2, -0.1, 0.1), (2.5, 0.0, 0.0))
    check_speeds(yam, plan, start)


def test_velocities_of_points_are_held_to_the_limit(yam):
    plan, start = plan_of(yam, 'left_joint1', (0.1, 0.2), (0.0, 0.0), (0.0, 1e300))
    with pytest.raises(TrajectoryError, match=r"'left_joint1' is to move at 1e\+300"):
        check_speeds(yam, plan, start)


def test_a_curve_is_held_to_the_limits_between_its_points(yam):
    # a cubic with velocities of 5 rad/s at both ends, 6 s apart: 4 / 27 * 5 * 6 = 4.4 rad away
    plan, start = plan_of(yam, 'left_joint1', (0.2, 6.2), (0.0, 0.0), (5.0, 0.0))
    with pytest.raises(TrajectoryError, match="'left_joint1' swings to 4.6"):
        check_speeds(yam, plan, start)
    # from rest to rest it is fastest in the middle: 1.5 times the mean of 2.8 rad in 0.05 s
    plan, start = plan_of(yam, 'left_joint4', (0.2, 0.25), (-1.4, 1.4), (0.0, 0.0))
    with pytest.raises(TrajectoryError, match="'left_joint4' is to move at 84 rad/s"):
        check_speeds(yam, plan, start)
