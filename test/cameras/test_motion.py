"""Poses along joint positions: equal to Pinocchio's, cameras that are carried, parts of it."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.errors import CalibrationError, RobotError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.robot.model import RobotModel


@pytest.fixture
def cameras(yam: RobotModel) -> tuple[CameraModel, ...]:
    """The bundled fixed cameras, and one on the wrist."""
    fixed = load_calibration(share_path('config', 'robots', 'yam_bimanual', 'cameras.yaml'))
    T = np.eye(4)
    T[:3, 3] = (0.02, 0.0, -0.05)
    values = {field: getattr(fixed['low'], field) for field in ('width', 'height', 'K')}
    wrist = CameraModel(view='wrist', mount_link=yam.tools[1].link, T_mount_camera=T, **values)
    return (*fixed.values(), wrist)


@pytest.fixture
def positions(yam: RobotModel) -> np.ndarray:
    rng = np.random.default_rng(3)
    return yam.lower + rng.random((5, len(yam.joint_names))) * (yam.upper - yam.lower)


def pose_of(robot: RobotModel, frame: str, row: np.ndarray) -> np.ndarray:
    """T_base_frame by Pinocchio alone."""
    model = robot.pinocchio_model
    data, (configuration,) = model.createData(), robot.configurations(row[None])
    pin.framesForwardKinematics(model, data, configuration)
    base, link = (
        data.oMf[model.getFrameId(name, pin.FrameType.BODY)] for name in (robot.base_link, frame)
    )
    return (base.inverse() * link).homogeneous


def test_poses_are_pinocchios_at_every_state(yam, cameras, positions):
    link = yam.link_names[3]
    motion = Motion.of(yam, cameras, positions, [link])
    for n, row in enumerate(positions):
        np.testing.assert_allclose(motion.links[link][n], pose_of(yam, link, row), atol=1e-12)
        for arm, tool in enumerate(yam.tools):
            expected = pose_of(yam, tool.link, row) @ tool.T_link_tool
            np.testing.assert_allclose(motion.tools[arm, n], expected, atol=1e-12)
            np.testing.assert_allclose(motion.arm_points[arm][-1, n], expected[:3, 3], atol=1e-12)
        for view, camera in enumerate(cameras):
            expected = pose_of(yam, camera.mount_link, row) @ camera.T_mount_camera
            np.testing.assert_allclose(motion.camera_poses[view, n], expected, atol=1e-12)
    np.testing.assert_array_equal(motion.openings, yam.gripper_openings(positions))


def test_the_first_states_are_those_of_the_whole(yam, cameras, positions):
    whole, part = (Motion.of(yam, cameras, rows) for rows in (positions, positions[:2]))
    first = whole.first(2)
    for name in ('positions', 'tools', 'camera_poses', 'openings'):
        np.testing.assert_array_equal(getattr(first, name), getattr(part, name))
    np.testing.assert_array_equal(first.arm_points[1], part.arm_points[1])


def test_arrays_are_read_only(yam, cameras, positions):
    motion = Motion.of(yam, cameras, positions, yam.link_names)
    for array in (motion.tools, motion.camera_poses, motion.openings, motion.positions):
        with pytest.raises(ValueError, match='read-only'):
            array[...] = 0
    with pytest.raises(TypeError):
        motion.links['elsewhere'] = np.eye(4)  # pyright: ignore[reportIndexIssue]


def test_wrong_shapes_and_unknown_links_are_refused(yam, cameras, positions):
    with pytest.raises(RobotError, match=r'needs \(T, 14\)'):
        Motion.of(yam, cameras, positions[:, :7])
    with pytest.raises(RobotError, match="no link 'elbow'"):
        Motion.of(yam, cameras, positions, ['elbow'])


def test_the_fraction_in_view_is_that_of_the_states_in_which_any_tool_is_in_the_image(yam):
    """The camera hangs where arm 0's tool is in the first of two states, looking at it."""
    home = np.clip(np.zeros(len(yam.joint_names)), yam.lower, yam.upper)
    away = home.copy()
    away[0] = yam.upper[0] / 2
    rows = np.stack([home, away])
    tool = yam.tool_poses(rows)[0, 0, :3, 3]
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    down[:3, 3] = tool + (0.0, 0.0, 0.1)
    K = np.array([[96.0, 0, 47.5], [0, 96.0, 35.5], [0, 0, 1]])
    camera = CameraModel(
        view='above', width=96, height=72, K=K, mount_link=yam.base_link, T_mount_camera=down
    )
    assert Motion.of(yam, [camera], rows[:1]).tools_in_view().tolist() == [1.0]
    assert Motion.of(yam, [camera], rows).tools_in_view().tolist() == [0.5]


def test_a_lens_that_moves_the_tool_out_of_the_image_is_refused(yam, cameras):
    home = np.clip(np.zeros(len(yam.joint_names)), yam.lower, yam.upper)[None]
    tool = yam.tool_poses(home)[0, 0, :3, 3]
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    down[:3, 3] = tool + (0.02, 0.0, 0.1)
    K = np.array([[96.0, 0, 47.5], [0, 96.0, 35.5], [0, 0, 1]])
    camera = CameraModel(
        view='above', width=96, height=72, K=K, mount_link=yam.base_link, T_mount_camera=down,
        distortion_model='plumb_bob', distortion=[90.0, 0, 0, 0, 0],
    )  # fmt: skip
    with pytest.raises(CalibrationError, match="'above', but its distortion"):
        Motion.of(yam, [camera], home).tools_in_view()
