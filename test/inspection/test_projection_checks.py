"""Shares of tool points behind the camera and off the image, against plain geometry."""

import numpy as np
import pytest

from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.inspection.inspect import check_visibility, tool_visibility
from mtv_world_ros.robot.file import load_robot

ROBOT = """
name: slider
urdf: slider.urdf
tools: [{arm: one, link: cart}]
"""
URDF = """
<robot name="slider"><link name="base"/><link name="cart"/>
<joint name="slide" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="0 0 1"/>
<limit lower="-10" upper="10" effort="1" velocity="1"/></joint></robot>
"""


@pytest.fixture
def slider(tmp_path):
    """A tool that moves along the z axis of the base."""
    (tmp_path / 'slider.yaml').write_text(ROBOT)
    (tmp_path / 'slider.urdf').write_text(URDF)
    return load_robot(tmp_path / 'slider.yaml')


def camera(x):
    """Look along +z from (x, 0, 0); half its field of view is 45 degrees."""
    T = np.eye(4)
    T[0, 3] = x
    return CameraModel(
        view='front', width=100, height=100,
        K=np.array([[50.0, 0, 49.5], [0, 50, 49.5], [0, 0, 1]]),
        mount_link='base', T_mount_camera=T,
    )  # fmt: skip


def test_points_behind_and_beside_are_counted_apart(slider):
    # the tool is at x = -1 of the camera: it is in the image from z = 1 on
    positions = np.array([[-3.0], [-2], [-1], [0.5], [0.9], [1.1], [2], [3], [4], [5]])
    seen = tool_visibility(camera(1.0), slider, positions)
    assert seen.behind == pytest.approx([0.3])
    assert seen.outside == pytest.approx([0.2])


@pytest.mark.parametrize(
    ('depths', 'verdicts'),
    [
        ([2.0, 3, 4], []),
        ([0.5, 0.6, 0.7, 3.0], ['suspicious']),
        ([0.5, 0.6], ['broken']),
        ([-2.0, -3, 4], ['broken']),
    ],
)
def test_a_view_that_does_not_see_the_tool_is_found(slider, depths, verdicts):
    _, findings = check_visibility(camera(1.0), slider, np.array(depths)[:, None])
    assert [finding.verdict for finding in findings] == verdicts
