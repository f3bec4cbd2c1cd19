"""Each folder of `config/robots` is a robot that can be used; a new folder is tested as it is."""

from pathlib import Path

import numpy as np
import pytest

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.core.files import share_path
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.robot.shape import load_shape
from mtv_world_ros.simulation.expert.expert import Expert
from mtv_world_ros.simulation.scenes.randomize import draw_scene
from mtv_world_ros.simulation.scenes.scene import scene_xml
from mtv_world_ros.simulation.scenes.tasks import TASKS
from mtv_world_ros.simulation.scenes.workcell import workcell_of

FOLDERS = sorted(path.parent for path in share_path('config', 'robots').glob('*/robot.yaml'))
WITH_WORKCELL = [folder for folder in FOLDERS if (folder / 'workcell.yaml').is_file()]


def name_of(folder: Path) -> str:
    return folder.name


@pytest.mark.parametrize('folder', FOLDERS, ids=name_of)
def test_it_is_found_by_the_name_of_its_folder_and_has_a_shape(folder):
    robot = load_robot(robot_path(folder.name))
    assert robot.name == folder.name
    shape = load_shape(robot)
    assert shape.parts
    assert not (shape.missing or shape.doubts)
    middle = (robot.lower + robot.upper) / 2
    poses = robot.tool_poses(np.stack([robot.lower, middle, robot.upper]))
    np.testing.assert_allclose(np.linalg.det(poses[..., :3, :3]), 1, atol=1e-9)
    for tool in robot.tools:
        assert tool.gripper_closed != tool.gripper_open


@pytest.mark.parametrize('folder', FOLDERS, ids=name_of)
def test_its_cameras_are_on_its_links_and_see_a_tool(folder):
    robot = load_robot(robot_path(folder.name))
    cameras = tuple(load_calibration(folder / 'cameras.yaml').values())
    assert cameras
    assert {camera.mount_link for camera in cameras} <= {robot.base_link, *robot.link_names}
    rest = Expert(robot).home if folder in WITH_WORKCELL else (robot.lower + robot.upper) / 2
    assert Motion.of(robot, cameras, rest[None]).tools_in_view().any()


@pytest.mark.parametrize('folder', WITH_WORKCELL, ids=name_of)
def test_its_workcell_draws_scenes_that_mujoco_builds_and_the_expert_plans(folder):
    mujoco = pytest.importorskip('mujoco')
    robot = load_robot(robot_path(folder.name))
    task, rng = TASKS['place_cup_plate'], np.random.default_rng(0)
    scene = draw_scene(task, rng, workcell_of(robot))
    assert mujoco.MjModel.from_xml_string(scene_xml(scene, robot)).nu > 0
    expert = Expert(robot)
    plan = expert.plan(task, scene, rng, miss=False)
    assert plan.joint_names == robot.joint_names
    np.testing.assert_allclose(plan.positions[0], expert.home, atol=1e-9)
    assert (plan.positions >= robot.lower - 1e-6).all()
    assert (plan.positions <= robot.upper + 1e-6).all()
