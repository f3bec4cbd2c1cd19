"""Where finger tips are when fingers slide, turn, or are not there: by hand from the drawing."""

import numpy as np
import pytest

from mtv_world_ros.inspection.cameras.finger_tips import num_tips, tip_middles
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.shape import load_shape

#: an arm of one joint; its hand is 0.3 m up and has two fingers 0.1 m long
ROBOT = """
name: tongs
urdf: tongs.urdf
base_link: base
tools:
  - {{arm: arm, link: hand, position: [0, 0, 0.09]{gripper}}}
"""
GRIPPER = ', gripper_joint: left, gripper_closed: 0.0, gripper_open: 0.8'
LINK = (
    '<link name="{0}"><visual><origin xyz="0 0 {1}"/><geometry>'
    '<box size="0.02 0.02 {2}"/></geometry></visual></link>'
)
JOINT = (
    '<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/>'
    '<origin xyz="{3}"/><axis xyz="{4}"/>'
    '<limit lower="-2" upper="2" effort="1" velocity="1"/>{5}</joint>'
)
URDF = '\n'.join(
    [
        '<robot name="tongs">',
        LINK.format('base', 0.1, 0.2),
        LINK.format('hand', 0.0, 0.02),
        LINK.format('left_finger', 0.05, 0.1),
        LINK.format('right_finger', 0.05, 0.1),
        JOINT.format('lift', 'base', 'hand', '0 0 0.3', '0 1 0', ''),
        JOINT.format('left', 'hand', 'left_finger', '0 0.03 0', '-1 0 0', ''),
        JOINT.format('right', 'hand', 'right_finger', '0 -0.03 0', '1 0 0',
                     '<mimic joint="left"/>'),
        '</robot>',
    ]
)  # fmt: skip


@pytest.fixture(params=['with a gripper joint', 'without'])
def robot(request, tmp_path):
    gripper = GRIPPER if request.param == 'with a gripper joint' else ''
    (tmp_path / 'tongs.yaml').write_text(ROBOT.format(gripper=gripper))
    (tmp_path / 'tongs.urdf').write_text(URDF)
    return load_robot(tmp_path / 'tongs.yaml')


def test_fingers_that_turn_reach_less_far_when_they_open(robot):
    lift = robot.joint_names.index('lift')
    positions = np.zeros((3, len(robot.joint_names)))
    positions[2, lift] = np.pi / 2
    turn = np.zeros(3)
    if 'left' in robot.joint_names:
        turn[1:] = 0.5
        positions[:, robot.joint_names.index('left')] = turn
    found = tip_middles(robot, load_shape(robot).parts, positions)
    if robot.tools[0].gripper_joint:
        # a finger's lowest corner lies 0.01 m beside its axis, on the outer side when it turns in
        reach = 0.1 * np.cos(turn) + 0.01 * np.abs(np.sin(turn))
    else:
        reach = np.full(3, 0.09)  # the tool point
    wanted = np.array([[0, 0, 0.3 + reach[0]], [0, 0, 0.3 + reach[1]], [reach[2], 0, 0.3]])
    np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_each_finger_has_a_tip(robot):
    parts = load_shape(robot).parts
    assert num_tips(robot, parts) == (2 if robot.tools[0].gripper_joint else 1)
    assert num_tips(robot, []) == 1


def test_without_shapes_it_is_the_tool_point(robot):
    positions = np.zeros((1, len(robot.joint_names)))
    np.testing.assert_allclose(tip_middles(robot, [], positions), [[0, 0, 0.39]], atol=1e-12)


def test_a_finger_of_phalanges_has_one_tip_however_it_bends(tmp_path):
    """Bent, the first phalanx of a hand's finger ends 10 mm behind the second, and is no tip."""
    urdf = '\n'.join(
        [
            '<robot name="hand">',
            LINK.format('base', 0.1, 0.2),
            LINK.format('hand', 0.0, 0.02),
            LINK.format('finger', 0.05, 0.1),
            LINK.format('end', 0.02, 0.04),
            JOINT.format('lift', 'base', 'hand', '0 0 0.3', '0 1 0', ''),
            JOINT.format('left', 'hand', 'finger', '0 0.03 0', '-1 0 0', ''),
            JOINT.format('knuckle', 'finger', 'end', '0 0 0.1', '-1 0 0',
                         '<mimic joint="left"/>'),
            '</robot>',
        ]
    )  # fmt: skip
    (tmp_path / 'tongs.yaml').write_text(ROBOT.format(gripper=GRIPPER))
    (tmp_path / 'tongs.urdf').write_text(urdf)
    robot = load_robot(tmp_path / 'tongs.yaml')
    parts = load_shape(robot).parts
    assert num_tips(robot, parts) == 1
    positions = np.zeros((2, 2))
    positions[1, robot.joint_names.index('left')] = 0.7
    heights = tip_middles(robot, parts, positions)[:, 2]
    bent = 0.3 + 0.1 * np.cos(0.7) + 0.04 * np.cos(1.4) + 0.01 * np.sin(1.4)
    np.testing.assert_allclose(heights, [0.44, bent], atol=1e-9)
