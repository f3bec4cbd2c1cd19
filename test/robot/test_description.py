"""A live robot's description: its own lengths and limits, or refused as another robot's."""

import re

import numpy as np
import pytest

from mtv_world_ros.core.errors import RobotError
from mtv_world_ros.robot.file import described_robot, load_robot, robot_path

FILE = robot_path('yam_bimanual')
YAM = load_robot(FILE)
URDF = (FILE.parent / 'yam_bimanual.urdf').read_text()


def with_joint(name, pattern, text):
    """The URDF with something else in one joint."""
    found = re.search(rf'<joint name="{name}".*?</joint>', URDF, re.S)[0]
    changed, count = re.subn(pattern, text, found)
    assert count == 1
    return URDF.replace(found, changed)


def test_the_same_description_is_the_same_robot():
    robot, offset_m = described_robot(YAM, URDF)
    assert offset_m == 0.0
    positions = np.clip(np.zeros((1, len(YAM.joint_names))), YAM.lower, YAM.upper)
    np.testing.assert_array_equal(robot.tool_poses(positions), YAM.tool_poses(positions))


def test_a_calibrated_offset_moves_the_tool_by_as_much():
    moved = with_joint(
        'left_joint1', r'(<origin xyz=")([^ ]+)', lambda m: f'{m[1]}{float(m[2]) + 0.01}'
    )
    robot, offset_m = described_robot(YAM, moved)
    assert offset_m == pytest.approx(0.01)
    positions = np.clip(np.zeros((1, len(YAM.joint_names))), YAM.lower, YAM.upper)
    way = robot.tool_poses(positions)[:, 0, :3, 3] - YAM.tool_poses(positions)[:, 0, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(way, axis=-1), [0.01, 0], atol=1e-9)
    assert (robot.name, robot.joint_names) == (YAM.name, YAM.joint_names)


def test_limits_are_the_described_ones():
    robot, _ = described_robot(YAM, with_joint('left_joint2', 'upper="3.66519"', 'upper="2.0"'))
    assert robot.upper[1] == 2.0


@pytest.mark.parametrize(
    'urdf, said',
    [
        (URDF.replace('left_joint3', 'left_elbow'), "no joint 'left_joint3'"),
        (
            with_joint('left_joint3', r'xyz="[^"]*" rpy', 'xyz="0.1 0.4 0" rpy'),
            'm and .* elsewhere',
        ),
        (with_joint('left_joint4', '<axis xyz="0 0 1"/>', '<axis xyz="0 1 0"/>'), 'rad elsewhere'),
    ],
)
def test_another_robot_is_refused(urdf, said):
    with pytest.raises(RobotError, match=f'another robot .*{said}'):
        described_robot(YAM, urdf)


@pytest.mark.parametrize('text', ['', 'not xml', '<robot name="x"/>', URDF[:5000]])
def test_what_is_no_description_is_refused(text):
    with pytest.raises(RobotError, match='robot description|another robot'):
        described_robot(YAM, text)
