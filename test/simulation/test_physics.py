"""Each shift of the truth changes what it says: measured, or from a closed form."""

from __future__ import annotations

import numpy as np
import pytest

from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.core.files import bundled
from mtv_world_ros.data.episode import NOMINAL
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.simulation.expert.expert import home_positions
from mtv_world_ros.simulation.physics import catalogue, Physics, physics_named
from mtv_world_ros.simulation.simulator import CONTROL_PERIOD_S, SimEpisode

ROBOT = load_robot(bundled('robots', 'yam_bimanual', '--robot'))
TASK, SEED, GRAVITY = 'place_block_a2b_left', 4, 9.81
BLOCK = 'a'


def episode(physics: str, *, rendering: bool = False) -> SimEpisode:
    sim = SimEpisode(ROBOT, home_positions(ROBOT), rendering=rendering, physics=physics)
    sim.reset(SEED, TASK)
    return sim


def settled(physics: str) -> SimEpisode:
    sim = episode(physics)
    for _ in range(50):
        sim.advance(sim.home)
    return sim


def weight_on_table(sim: SimEpisode) -> float:
    """What a block presses on the table with [N]."""
    import mujoco

    body, total = sim._model.body(BLOCK).id, 0.0
    for number, contact in enumerate(sim._data.contact):
        if body in sim._model.geom_bodyid[[contact.geom1, contact.geom2]]:
            force = np.zeros(6)
            mujoco.mj_contactForce(sim._model, sim._data, number, force)
            total += force[0]
    return total


def friction(sim: SimEpisode) -> float:
    """Coulomb's, by how far a block slides that begins with a speed."""
    address, speed = sim._model.joint(BLOCK).dofadr[0], 0.6
    before = np.array(sim._data.body(BLOCK).xpos)
    sim._data.qvel[address : address + 3] = speed, 0.0, 0.0
    for _ in range(20):
        sim.advance(sim.home)
    way = np.linalg.norm(sim._data.body(BLOCK).xpos - before)
    return float(speed**2 / (2 * GRAVITY * way))


def gripped(physics: str) -> tuple[float, float]:
    """Force [N] and friction of the left fingers that close on a block held in the air."""
    import mujoco

    sim = episode(physics)
    sim._model.opt.gravity[:] = 0.0
    tool = ROBOT.tools[0]
    address = sim._model.joint(BLOCK).qposadr[0]
    site = sim._data.site(f'{tool.arm}_tool')
    sim._data.qpos[address : address + 3] = site.xpos
    turn = np.zeros(4)
    mujoco.mju_mat2Quat(turn, site.xmat)
    sim._data.qpos[address + 3 : address + 7] = turn
    target = sim.home.copy()
    target[ROBOT.joint_names.index(tool.gripper_joint)] = tool.gripper_closed
    for _ in range(60):
        sim.advance(target)
    body, found = sim._model.body(BLOCK).id, []
    for number, contact in enumerate(sim._data.contact):
        if body in sim._model.geom_bodyid[[contact.geom1, contact.geom2]]:
            force = np.zeros(6)
            mujoco.mj_contactForce(sim._model, sim._data, number, force)
            found.append((force[0], contact.friction[0]))
    forces, frictions = np.array(found).T
    return float(forces.sum()) / 2, float(frictions.min())


def test_catalogue_has_shifts_and_a_nominal_physics_that_changes_nothing():
    assert len(catalogue()) >= 15
    assert next(iter(catalogue())) == NOMINAL
    nominal = physics_named(NOMINAL)
    assert nominal == Physics(text=nominal.text)
    changed = [p.model_dump(exclude={'text'}) for p in catalogue().values()]
    assert all(changed.count(one) == 1 for one in changed), 'two entries say the same'


def test_unknown_physics_names_the_nearest():
    with pytest.raises(SimulatorError, match=r"'delay_100'.*did you mean 'delay_100ms'"):
        physics_named('delay_100')


@pytest.mark.parametrize(('name', 'factor'), [(NOMINAL, 1.0), ('friction_half', 0.5)])
def test_friction_stops_a_sliding_block_by_coulombs_law(name, factor):
    assert friction(settled(name)) == pytest.approx(0.9 * factor, rel=0.1)


def test_double_friction_topples_a_cube_that_would_slide():
    # a cube topples where friction is above 1, and slides below
    sim = settled('friction_double')
    body = sim._model.body(BLOCK).id
    found = [
        contact.friction[0]
        for contact in sim._data.contact
        if body in sim._model.geom_bodyid[[contact.geom1, contact.geom2]]
    ]
    assert found and found == pytest.approx([1.8] * len(found))
    assert friction(sim) > 1.8


@pytest.mark.parametrize(
    ('name', 'factor'), [('grip_friction_quarter', 0.25), ('bold', 0.25), ('mild', 0.5)]
)
def test_fingers_are_as_slippery_as_stated(name, factor):
    assert gripped(name)[1] == pytest.approx(1.6 * factor)
    assert friction(settled(name)) == pytest.approx(0.9, rel=0.1)


@pytest.mark.parametrize(('name', 'factor'), [('mass_triple', 3.0), ('bold', 3.0), ('mild', 1.7)])
def test_objects_weigh_as_much_as_stated(name, factor):
    usual = weight_on_table(settled(NOMINAL))
    assert usual == pytest.approx(400.0 * np.prod(settled(NOMINAL).scene.objects[0].size) * 9.81)
    assert weight_on_table(settled(name)) == pytest.approx(factor * usual, rel=1e-3)


@pytest.mark.parametrize(('name', 'factor'), [('gripper_weak', 0.4), ('bold', 0.4), ('mild', 0.6)])
def test_grippers_press_as_hard_as_stated(name, factor):
    assert gripped(name)[0] == pytest.approx(factor * gripped(NOMINAL)[0], rel=0.03)


@pytest.mark.parametrize(
    ('name', 'delay_s'), [('delay_100ms', 0.1), ('delay_150ms', 0.15), ('mild', 0.05)]
)
def test_commands_arrive_late(name, delay_s):
    late, usual = episode(name), episode(NOMINAL)
    times = np.arange(60) * CONTROL_PERIOD_S
    columns = [ROBOT.joint_names.index(f'left_joint{n}') for n in (1, 2)]
    tracks = []
    for sim in (late, usual):
        rows = []
        for time in times:
            target = sim.home.copy()
            target[columns] += 0.1 * np.sin(3.0 * time)
            sim.advance(target)
            rows.append(sim.positions()[columns])
        tracks.append(np.array(rows))
    expected = [np.interp(times - delay_s, times, column) for column in tracks[1].T]
    moving = times > delay_s + 0.1
    assert tracks[0].T[:, moving] == pytest.approx(np.array(expected)[:, moving], abs=5e-4)
    assert np.abs(tracks[0] - tracks[1])[moving].max() > 0.01


def test_joint_zeros_move_the_tool_and_not_what_is_reported():
    sim = episode('joint_zeros_1deg')
    zeros = sim._zeros
    grippers = [ROBOT.joint_names.index(tool.gripper_joint) for tool in ROBOT.tools]
    arms = np.delete(np.arange(len(zeros)), grippers)
    assert np.abs(zeros[arms]) == pytest.approx(np.deg2rad(1.0))
    assert (zeros[grippers] == 0).all() and len(set(np.sign(zeros[arms]))) == 2
    assert sim.positions() == pytest.approx(sim.home)
    true, told = (ROBOT.tool_poses(q[None])[:, 0, :3, 3] for q in (sim.home - zeros, sim.home))
    sites = [sim._data.site(f'{tool.arm}_tool').xpos for tool in ROBOT.tools]
    assert np.array(sites) == pytest.approx(true, abs=1e-4)
    assert np.linalg.norm(true - told, axis=-1).min() > 0.003


def test_soft_contacts_sink_with_the_square_of_their_time_constant():
    def depth(sim: SimEpisode) -> float:
        item = next(one for one in sim.scene.objects if one.role == BLOCK)
        return item.size[2] / 2 - sim._data.body(BLOCK).xpos[2]

    usual, soft = (depth(settled(name)) for name in (NOMINAL, 'contacts_soft'))
    assert soft == pytest.approx(25 * usual, rel=0.1)
    assert 1e-4 < soft < 5e-3


@pytest.mark.parametrize(('name', 'height'), [('table_high_1cm', 0.01), ('table_low_1cm', -0.01)])
def test_objects_stand_on_a_table_of_another_height(name, height):
    sim, usual = settled(name), settled(NOMINAL)
    poses, other = sim.object_poses(), usual.object_poses()
    assert poses[:, 2, 3] - other[:, 2, 3] == pytest.approx(height, abs=1e-5)
    assert poses[:, :2, 3] == pytest.approx(other[:, :2, 3], abs=1e-4)
    # relations are evaluated from the table up
    first, same = sim.situation(), usual.situation()
    assert first.positions[BLOCK] == pytest.approx(same.positions[BLOCK], abs=1e-4)


@pytest.mark.parametrize(('name', 'factor'), [('objects_large', 1.1), ('objects_small', 0.9)])
def test_objects_are_of_another_size(name, factor):
    sim = settled(name)
    block = next(item for item in sim.scene.objects if item.role == BLOCK)
    assert 0.04 * factor <= block.size[0] <= 0.055 * factor
    geom = int(sim._model.body(BLOCK).geomadr[0])
    assert 2 * sim._model.geom_size[geom] == pytest.approx(block.size)
    assert sim._data.body(BLOCK).xpos[2] == pytest.approx(block.size[2] / 2, abs=5e-4)


def test_cameras_are_told_elsewhere_and_see_the_same():
    sim, usual = episode('camera_off', rendering=True), episode(NOMINAL, rendering=True)
    for told, true in zip(sim.calibrated_cameras, sim.scene.cameras, strict=True):
        a, b = np.asarray(told.T_mount_camera), np.asarray(true.T_mount_camera)
        angle = np.arccos((np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2)
        assert np.linalg.norm(a[:3, 3] - b[:3, 3]) == pytest.approx(0.01)
        assert np.rad2deg(angle) == pytest.approx(1.0)
    assert usual.calibrated_cameras == usual.scene.cameras
    for view, image in sim.observe().images.items():
        assert np.array_equal(image, usual.observe().images[view])


def test_poor_pictures_are_noisy_and_blurred():
    poor = episode('pictures_poor', rendering=True).observe().images
    usual = episode(NOMINAL, rendering=True).observe().images
    view = next(iter(usual))
    difference = poor[view].astype(float) - usual[view]
    flat = np.abs(np.diff(usual[view].astype(float), axis=1)).max(-1)[:, :-1] == 0
    # JPEG at this quality takes a part of the noise away
    assert 3.0 < difference[:, :-2][flat].std() < 9.0
    edges = np.abs(np.diff(usual[view].astype(float), axis=1)).max(-1) > 60
    steps = [np.abs(np.diff(p[view].astype(float), axis=1)).max(-1)[edges] for p in (poor, usual)]
    assert steps[0].mean() < 0.7 * steps[1].mean()
