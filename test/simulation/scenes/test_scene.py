from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.cameras.camera import camera_poses, project
from mtv_world_ros.cameras.silhouettes import draw_silhouettes
from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.core.files import bundled_names, share_path
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.shape import load_shape
from mtv_world_ros.simulation.arms.arm import actuators_of
from mtv_world_ros.simulation.opengl import load_mujoco, missing_opengl
from mtv_world_ros.simulation.scenes.cameras import camera_model
from mtv_world_ros.simulation.scenes.randomize import draw_scene
from mtv_world_ros.simulation.scenes.scene import box_corners, check_cameras, scene_xml
from mtv_world_ros.simulation.scenes.shapes import SHAPES
from mtv_world_ros.simulation.scenes.tasks import TASKS
from mtv_world_ros.simulation.scenes.workcell import workcell_of
from mtv_world_ros.simulation.simulator import SimEpisode
from test.support.tables import table


@pytest.fixture
def scene(workcell):
    return draw_scene(TASKS['stack_blocks_two'], np.random.default_rng(1), workcell)


def put(model, data, robot, row):
    """Put the simulated robot where its joints have these positions."""
    for actuator in actuators_of(robot):
        driven = actuator.multiplier * row[actuator.column] + actuator.offset
        data.joint(actuator.joint).qpos = driven
    load_mujoco(rendering=False).mj_forward(model, data)


@pytest.mark.parametrize('name', bundled_names('robots'))
def test_simulated_arms_stand_where_pinocchio_puts_them(name):
    mujoco = load_mujoco(rendering=False)
    robot = load_robot(share_path('config', 'robots', name, 'robot.yaml'))
    drawn = draw_scene(TASKS['stack_blocks_two'], np.random.default_rng(1), workcell_of(robot))
    model = mujoco.MjModel.from_xml_string(scene_xml(drawn, robot))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    positions = rng.uniform(robot.lower, robot.upper, (200, len(robot.joint_names)))
    tools = robot.tool_poses(positions)
    cameras = {c.view: camera_poses(c, robot, positions) for c in drawn.cameras}
    for t, row in enumerate(positions):
        put(model, data, robot, row)
        for a, tool in enumerate(robot.tools):
            site = data.site(f'{tool.arm}_tool')
            np.testing.assert_allclose(site.xpos, tools[a, t, :3, 3], atol=1e-6)
            np.testing.assert_allclose(site.xmat.reshape(3, 3), tools[a, t, :3, :3], atol=1e-6)
        for view, poses in cameras.items():
            pose = poses[t] if poses.ndim == 3 else poses
            seen = data.camera(view)
            np.testing.assert_allclose(seen.xpos, pose[:3, 3], atol=1e-6)
            # x right; MuJoCo's y is up and it looks along -z
            axes = pose[:3, :3] * [1, -1, -1]
            np.testing.assert_allclose(seen.xmat.reshape(3, 3), axes, atol=1e-6)


@pytest.mark.parametrize('name', bundled_names('robots'))
def test_the_urdf_is_drawn_where_the_simulator_draws_the_robot(name, opengl):
    mujoco = load_mujoco()
    robot = load_robot(share_path('config', 'robots', name, 'robot.yaml'))
    drawn = draw_scene(TASKS['stack_blocks_two'], np.random.default_rng(1), workcell_of(robot))
    fixed = [c for c in drawn.cameras if c.mount_link == robot.base_link]
    model = mujoco.MjModel.from_xml_string(scene_xml(replace(drawn, objects=()), robot))
    model.geom('table').rgba[3] = 0  # or it hides what reaches below it
    data = mujoco.MjData(model)
    positions = np.random.default_rng(0).uniform(robot.lower, robot.upper, (4, len(robot.lower)))
    for camera in fixed:
        outlines = draw_silhouettes(load_shape(robot).parts, camera, robot, positions) > 0
        with mujoco.Renderer(model, camera.height, camera.width) as renderer:
            renderer.enable_segmentation_rendering()
            for row, outline in zip(positions, outlines, strict=True):
                put(model, data, robot, row)
                renderer.update_scene(data, camera.view)
                seen = renderer.render()[..., 0] >= 0
                assert (outline & seen).sum() > 0.95 * (outline | seen).sum(), camera.view


def test_projected_block_corners_bound_the_rendered_mask(robot, expert, opengl):
    sim = SimEpisode(robot, expert.home)
    seen = 0
    for seed in range(3):
        frame = sim.reset(seed, 'place_block_a2b_left')
        for camera in sim.scene.cameras:
            for number, item in enumerate(sim.scene.objects, 1):
                pixels, _ = project(camera, camera.T_mount_camera, box_corners(item))
                ys, xs = np.nonzero(frame.masks[camera.view] == number)
                drawn = [xs.min(), ys.min(), xs.max(), ys.max()]
                np.testing.assert_allclose(
                    drawn, [*pixels.min(0), *pixels.max(0)], atol=1.3, err_msg=item.name
                )
                seen += 1
    sim.close()
    assert seen >= 12


@table('name', SHAPES)
def test_every_shape_fills_its_bounding_box_and_rests_on_the_table(robot, expert, scene, name):
    mujoco, shape = load_mujoco(rendering=False), SHAPES[name]
    item = replace(
        scene.objects[0], shape=name, size=shape.largest, yaw=0.0,
        position=(0.0, 0.28, shape.largest[2] / 2),
    )  # fmt: skip
    model = mujoco.MjModel.from_xml_string(scene_xml(replace(scene, objects=(item,)), robot))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    body = model.body(item.role)
    for geom in range(body.geomadr[0], body.geomadr[0] + body.geomnum[0]):
        turn, centre, half = data.geom_xmat[geom].reshape(3, 3), model.geom_aabb[geom], None
        half = np.abs(turn) @ centre[3:]
        middle = data.geom_xpos[geom] + turn @ centre[:3]
        low, high = np.minimum(low, middle - half), np.maximum(high, middle + half)
    np.testing.assert_allclose(high - low, shape.largest, atol=0.006)
    assert low[2] == pytest.approx(0.0, abs=0.003)
    # let go, it stays where it is
    start = data.qpos.copy()
    for _ in range(500):
        mujoco.mj_step(model, data)
    rest = data.joint(item.role).qpos[:3]
    np.testing.assert_allclose(rest, start[-7:-4], atol=0.004)


def test_blocks_show_in_their_own_colour(robot, expert, opengl):
    sim = SimEpisode(robot, expert.home)
    frame = sim.reset(5, 'stack_blocks_two')
    for number, item in enumerate(sim.scene.objects, 1):
        colour = frame.images['low'][frame.masks['low'] == number].mean(axis=0)
        wanted = np.asarray(item.rgb)
        cosine = colour @ wanted / np.linalg.norm(colour) / np.linalg.norm(wanted)
        assert cosine > 0.99
    sim.close()


def test_camera_that_misses_an_object_is_refused(scene, workcell):
    away = replace(workcell.cameras[0], view='away', target=(1.5, 0.0, 0.0))
    with pytest.raises(SimulatorError, match=f"'away' does not see {scene.objects[0].name}"):
        check_cameras(replace(scene, cameras=(camera_model(away, 96, 72),)), 'base')


def test_unknown_shape_names_the_nearest(robot, scene):
    odd = replace(scene.objects[0], shape='blok')
    with pytest.raises(SimulatorError, match="did you mean 'block'"):
        scene_xml(replace(scene, objects=(odd,)), robot)


def test_missing_opengl_names_the_debian_packages(monkeypatch):
    monkeypatch.setattr('mtv_world_ros.simulation.opengl._loads', lambda name: False)
    monkeypatch.delenv('MUJOCO_GL', raising=False)
    with pytest.raises(SimulatorError, match=r'libegl1.*libosmesa6'):
        load_mujoco()
    monkeypatch.setenv('MUJOCO_GL', 'osmesa')
    assert 'libosmesa6' in str(missing_opengl())
    monkeypatch.setenv('MUJOCO_GL', 'glfw')
    assert "'egl' or 'osmesa'" in str(missing_opengl())
