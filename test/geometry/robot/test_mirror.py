from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.errors import RobotError
from mtv_world_ros.files import share_path
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.lab.evaluation.references import mirrored

FLIP = np.diag([-1.0, 1.0, 1.0])


@pytest.fixture(scope='module')
def yam():
    return load_robot(share_path('config', 'robots', 'yam_bimanual.yaml'))


@pytest.fixture(scope='module')
def positions(yam):
    share = np.random.default_rng(5).uniform(0.1, 0.9, (40, len(yam.joint_names)))
    return yam.lower + share * (yam.upper - yam.lower)


def test_tool_poses_are_those_of_the_other_arm_in_a_mirror(yam, positions):
    left, right = yam.tool_poses(positions)
    new_left, new_right = yam.tool_poses(mirrored(yam, positions))
    assert np.allclose(new_right[:, :3, 3], left[:, :3, 3] * [-1, 1, 1], atol=1e-9)
    assert np.allclose(new_left[:, :3, 3], right[:, :3, 3] * [-1, 1, 1], atol=1e-9)
    # z runs along the fingers and y along their travel, whose sense a mirror does not show
    turned = FLIP @ left[:, :3, :3]
    assert np.allclose(new_right[:, :3, 2], turned[..., 2], atol=1e-9)
    travel = (new_right[:, :3, 1] * turned[..., 1]).sum(-1)
    assert np.allclose(np.abs(travel), 1, atol=1e-9)


def test_every_link_is_mirrored_not_the_tool_alone(yam, positions):
    before = yam.forward_kinematics(positions)
    after = yam.forward_kinematics(mirrored(yam, positions))
    for k in range(1, 7):
        elbow = before[f'left_link_{k}'][:, :3, 3] * [-1, 1, 1]
        assert np.allclose(after[f'right_link_{k}'][:, :3, 3], elbow, atol=1e-3)


def test_grippers_change_sides_and_keep_their_opening(yam, positions):
    openings = yam.gripper_openings(positions)
    assert np.allclose(yam.gripper_openings(mirrored(yam, positions)), openings[::-1])


def test_mirrored_twice_is_the_motion_itself(yam, positions):
    assert np.allclose(mirrored(yam, mirrored(yam, positions)), positions)


def test_robot_without_a_mirror_image_is_an_error(yam, positions):
    with pytest.raises(RobotError, match="arm 'left' of robot 'yam_bimanual'"):
        mirrored(yam, positions, axis=1)
    moved = yam.tools[1].T_link_tool.copy()
    moved[2, 3] += 0.01
    lopsided = RobotModel(
        name='lopsided',
        model=yam.pinocchio_model,
        joint_names=yam.joint_names,
        tools=(yam.tools[0], replace(yam.tools[1], T_link_tool=moved)),
        base_link=yam.base_link,
    )
    with pytest.raises(RobotError, match='no mirror image'):
        mirrored(lopsided, positions)
