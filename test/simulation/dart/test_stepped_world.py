"""Objects as rigid bodies, under the bundled episode's commands and under others."""

from __future__ import annotations

from dataclasses import replace
import shutil

import numpy as np
import pytest

pytest.importorskip('dartpy', reason='dartpy is not installed (pip install .[dart])')

from mtv_world_ros.core.errors import RobotError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.physics.arms.mechanics import RobotMechanics
from mtv_world_ros.physics.contact_settings import ContactSettings
from mtv_world_ros.physics.fitting.contact_fit import _Trial, read_contact
from mtv_world_ros.physics.solids import Solid
from mtv_world_ros.robot.arm_solver import ArmSolver
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.simulation.dart.rigid_bodies import _COMPLIANT_PAD, RigidBodies
from mtv_world_ros.simulation.dart.stepped_world import STEP_S, SteppedWorld

SETTINGS = ContactSettings(
    finger_stiffness=190.0,
    finger_damping=7.0,
    finger_mass_kg=0.02,
    grip_friction=1.0,
    table_friction=0.5,
    density=300.0,
    tray_kg=0.4,
)
#: out of the arms' reach
AWAY = Solid(centre=np.array([1.0, 1.0, 0.025]), size=np.full(3, 0.05), yaw=0.3)


@pytest.fixture(scope='module')
def recording(robot):
    read = read_contact(share_path('resource', 'demo_episode'), robot, ('low', 'high'))
    return _Trial.of(read, SETTINGS, robot)


def masses_of(solids) -> list[float]:
    return [max(300.0 * float(np.prod(solid.size)), 0.01) for solid in solids]


def world_of(robot, response, pose, *solids: Solid, **changed) -> SteppedWorld:
    settings = SETTINGS.model_copy(update=changed)
    free = replace(response, floor=None)
    return SteppedWorld(robot, free, settings, solids, masses_of(solids), pose)


def bodies_of(robot, response, pose, *solids: Solid, **changed) -> RigidBodies:
    settings = SETTINGS.model_copy(update=changed)
    return RigidBodies(robot, response, solids, settings, STEP_S, pose, masses_of(solids))


def commanded(world, positions) -> tuple[np.ndarray, np.ndarray]:
    """Poses (1 + T, O, 4, 4) and joints (1 + T, J) under commands (1 + T, J)."""
    poses, joints = [world.poses], [world.joints]
    for command in positions[1:]:
        world.advance(command)
        poses.append(world.poses)
        joints.append(world.joints)
    return np.stack(poses), np.stack(joints)


def acted(robot, response, recording, positions=None, **changed) -> tuple[np.ndarray, np.ndarray]:
    """Centres (1 + T, O, 3) and joints in the recording's scene, under its or other commands."""
    positions = recording.positions if positions is None else positions
    world = world_of(robot, response, positions[0], *recording.solids, **changed)
    poses, joints = commanded(world, positions)
    return poses[..., :3, 3], joints


def still(robot, seconds: float) -> np.ndarray:
    joints = np.clip(np.zeros(len(robot.joint_names)), robot.lower, robot.upper)
    return np.repeat(joints[None], round(seconds / 0.02) + 1, axis=0)


@pytest.mark.slow
def test_a_block_is_carried_to_where_the_recorded_one_was(robot, response, recording):
    """And fingers are where it stops them, whatever they are commanded to."""
    points, joints = acted(robot, response, recording)
    way = points[-1] - points[0]
    assert np.linalg.norm(way[0] - recording.displacements[-1, 0]) < 0.025
    assert np.linalg.norm(way[0]) > 0.1
    assert np.linalg.norm(way[1]) < 0.01
    widest = robot.gripper_openings(joints) - robot.gripper_openings(recording.positions)
    assert 0.3 < widest.max() < 0.8
    np.testing.assert_allclose(robot.gripper_openings(joints)[:, -1], 1, atol=0.02)


def test_a_gripper_that_stays_open_carries_nothing(robot, response, recording):
    opened = recording.positions.copy()
    for tool in robot.tools:
        opened[:, robot.joint_names.index(tool.gripper_joint)] = tool.gripper_open
    points, _ = acted(robot, response, recording, opened)
    assert np.ptp(points[..., 2], axis=0).max() < 0.005


@pytest.mark.slow
def test_fingers_that_do_not_rub_lose_the_block(robot, response, recording):
    points, _ = acted(robot, response, recording, grip_friction=0.02)
    assert np.linalg.norm(points[-1, 0] - points[0, 0] - recording.displacements[-1, 0]) > 0.05


def shaken(robot, seconds: float = 2.0) -> np.ndarray:
    """Commands (N, J) of arms that turn to and fro about their first joints, grippers open."""
    positions = still(robot, seconds)
    turn = 0.3 * np.sin(2 * np.pi * 1.5 * np.arange(len(positions)) * 0.02)
    for tool in robot.tools:
        positions[:, robot.joint_names.index(f'{tool.arm}_joint1')] += turn
        positions[:, robot.joint_names.index(tool.gripper_joint)] = tool.gripper_open
    return positions


def test_fingers_of_a_hand_that_gains_speed_stay_behind_as_the_course_says(
    robot, response, monkeypatch
):
    """So that arms may pass by without dynamics."""
    positions = shaken(robot)
    world = world_of(robot, response, positions[0])
    arms, courses = world._bodies.arms, []
    monkeypatch.setattr(world, '_run', lambda course: (courses.append(course), run(course)))
    run = SteppedWorld._run.__get__(world)
    monkeypatch.setattr(RigidBodies, 'passes', lambda *_: False)
    offs, worst = [], 0.0
    for command in positions[1:]:
        world.advance(command)
        course = courses[-1]
        off = course.free - course.ways
        offs.append(off[:, arms.fingers])
        # never outwards, where the stops are: left fingers open upwards, their mirrors downwards
        assert (offs[-1] * np.sign(course.ways[0, arms.fingers])).max() < 1e-4
        assert (np.delete(off, arms.fingers, axis=1) == 0).all()
        worst = max(worst, np.abs(arms.skeleton.getPositions() - course.free[-1]).max())
    assert 0.001 < np.abs(offs).max() < 0.03
    assert worst < 0.006


def test_an_arm_feels_its_own_rotors_alone(robot, response, recording):
    """The engine has none; its bodies come near to what joints feel."""
    pose = recording.positions[0]
    arms = bodies_of(robot, response, pose).arms
    arms.skeleton.setPositions(arms.ways(pose[None])[0])
    names = [arms.skeleton.getDof(i).getName() for i in range(arms.skeleton.getNumDofs())]
    strong = [f'{arm}_joint{number}' for arm in ('left', 'right') for number in (1, 2, 3)]
    felt = np.diag(arms.skeleton.getMassMatrix())[[names.index(name) for name in strong]]
    mass, _ = RobotMechanics(robot).inertia(pose, np.zeros(len(pose)))
    wanted = np.diag(mass) + response.armature / response.compliance
    wanted = wanted[[robot.joint_names.index(name) for name in strong]]
    np.testing.assert_allclose(felt, wanted, rtol=0.12)


def test_arms_hit_each_other(robot, response, recording):
    """Both tools are sent to the middle; one alone gets there."""
    rest, ends = recording.positions[0], recording.positions[0].copy()
    for tool in robot.tools:
        solver = ArmSolver(robot, tool)
        pose = robot.tool_poses(rest[None])[robot.tools.index(tool), 0].copy()
        pose[:3, 3] = 0.0, 0.2, 0.12
        ends[solver.indices] = solver.solve(pose, ends[solver.indices])
    share = np.clip(np.linspace(0, 1.5, 151), 0, 1)[:, None]
    both = rest + share * (ends - rest)
    alone = both.copy()
    alone[:, len(rest) // 2 :] = rest[len(rest) // 2 :]
    reached = []
    for positions in (both, alone):
        _, joints = commanded(world_of(robot, response, rest), positions)
        reached.append(np.abs(joints[-1] - positions[-1]).max())
    assert reached[0] > 0.05 > 0.01 > reached[1]


def shut_over_the_table(robot, recording):
    """Of the lowest tool that was recorded: its arm, joints with its gripper shut, its pose."""
    lowest = robot.tool_poses(recording.positions)[..., 2, 3]
    arm, row = np.unravel_index(lowest.argmin(), lowest.shape)
    tool, joints = robot.tools[arm], recording.positions[row].copy()
    joints[robot.joint_names.index(tool.gripper_joint)] = tool.gripper_closed
    return arm, joints, robot.tool_poses(joints[None])[arm, 0]


def straight(robot, arm, joints, pose, places, shares) -> np.ndarray:
    """Commands of an arm whose tool goes straight from one place to another, by shares."""
    solver, ends = ArmSolver(robot, robot.tools[arm]), []
    for place in places:
        there = pose.copy()
        there[:3, 3] = place
        ends.append(joints.copy())
        ends[-1][solver.indices] = solver.solve(there, joints[solver.indices])
    return ends[0] + np.clip(shares, 0, 1)[:, None] * (ends[1] - ends[0])


def test_both_shut_fingers_bear_on_what_they_press(robot, response, recording):
    """Where tips do not give way one bears it all, and slides away from the other."""
    arm, joints, pose = shut_over_the_table(robot, recording)
    block = Solid(centre=np.array([*pose[:2, 3], 0.025]), size=np.full(3, 0.05))
    # 2 cm too deep, 1 cm beside the middle
    places = [(pose[0, 3] + 0.01, pose[1, 3], height) for height in (0.11, 0.03)]
    positions = straight(robot, arm, joints, pose, places, np.linspace(-0.5, 2, 50))
    openings = []
    for pads in (1e4, None):
        given = {'grip_friction': 1.6, 'pad_stiffness': pads}
        poses, found = commanded(
            world_of(robot, response, positions[0], block, **given), positions
        )
        openings.append(robot.gripper_openings(found)[arm].max())
        assert np.linalg.norm(poses[-1, 0, :3, 3] - poses[0, 0, :3, 3]) < 0.005
    assert openings[0] <= 0.01 and openings[1] >= 0.03


def test_what_is_pushed_off_its_middle_goes_along_with_the_fingers(robot, response, recording):
    """It rubs on them as much as what is held, and does not slide off to one side."""
    arm, joints, pose = shut_over_the_table(robot, recording)
    places = [(pose[0, 3] + x, pose[1, 3] + y, 0.03) for x, y in ((0.0, 0.0), (0.02, 0.05))]
    positions = straight(robot, arm, joints, pose, places, np.linspace(-0.5, 1.5, 100))
    middle = np.array([pose[0, 3] + 0.012, pose[1, 3] + 0.05, 0.025])
    block = Solid(centre=middle, size=np.full(3, 0.05))
    given = {'grip_friction': 1.6, 'table_friction': 0.8}
    poses, _ = commanded(world_of(robot, response, positions[0], block, **given), positions)
    way = poses[-1, 0, :3, 3] - poses[0, 0, :3, 3]
    # bounded by forces that do without friction, it would go half as far aside, and turn
    np.testing.assert_allclose(way[:2], [0.0126, 0.0336], atol=0.002)
    assert (poses[-1, 0, :3, :3] @ poses[0, 0, :3, :3].T)[0, 0] > np.cos(np.radians(5))


def test_where_cones_diverge_a_pyramid_goes_on(robot, response, recording, monkeypatch):
    goes_on = RigidBodies.step

    def diverges(bodies, forces):
        goes_on(bodies, forces)
        if bodies._world.getConstraintSolver().getBoxedLcpSolver() is bodies._cone:
            lost.append(bodies)
            bodies._solids[0].setPositions(np.full(6, np.nan))

    lost = []
    monkeypatch.setattr(RigidBodies, 'step', diverges)
    points, _ = acted(robot, response, recording)
    assert lost and np.isfinite(points).all()
    assert np.linalg.norm(points[-1] - points[0], axis=-1).max() > 0.05  # carried, as by cones


def test_pads_give_way_on_objects_and_not_on_the_table(robot, response):
    rest = still(robot, 0.0)[0]
    for tool in robot.tools:
        rest[robot.joint_names.index(tool.gripper_joint)] = tool.gripper_closed
    tip = robot.tool_poses(rest[None])[0, 0, :3, 3]
    for table, is_soft in ((tip[2] - 0.2, True), (tip[2], False)):
        changed = {'pad_stiffness': 1e4, 'table_m': table}
        bodies = bodies_of(robot, response, rest, replace(AWAY, centre=tip), **changed)
        assert len(bodies.arms.pads) == 2 * len(robot.tools)
        bodies.notice_touch()
        kinds = {pad.getActuatorType() for pad in bodies.arms.pads}
        assert (_COMPLIANT_PAD in kinds) == is_soft


@pytest.mark.parametrize(('is_open', 'height'), [(True, 0.02), (False, 0.07)])
def test_what_falls_into_a_cup_lies_on_its_floor(robot, response, is_open, height):
    cup = Solid(
        centre=np.array([0.0, 0.3, 0.03]),
        size=np.array([0.05, 0.05, 0.06]),
        is_round=True,
        is_open=is_open,
    )
    ball = Solid(centre=np.array([0.0, 0.3, 0.09]), size=np.full(3, 0.02))
    bodies = bodies_of(robot, response, still(robot, 0.0)[0], cup, ball)
    for _ in range(round(0.8 / STEP_S)):
        bodies.step(np.zeros(bodies.arms.skeleton.getNumDofs()))
    # the engine hardly lifts out what sinks in within the step of an impact
    assert bodies.poses()[1, 2, 3] == pytest.approx(height, abs=0.008)
    assert bodies.poses()[0, 2, 3] == pytest.approx(0.03, abs=0.002)


def test_what_fingers_touch_holds_to_them_and_slides_on_others(robot, response):
    """Of two that rub, the lower friction counts."""
    rest = still(robot, 0.0)[0]
    for tool in robot.tools:
        rest[robot.joint_names.index(tool.gripper_joint)] = tool.gripper_closed
    between = replace(AWAY, centre=robot.tool_poses(rest[None])[0, 0, :3, 3] - [0, 0, 0.024])
    bodies = bodies_of(robot, response, rest, AWAY, between)

    def frictions():
        bodies.notice_touch()
        nodes = [solid.getBodyNode(0).getShapeNode(0) for solid in bodies._solids]
        return [node.getDynamicsAspect().getFrictionCoeff() for node in nodes]

    def solver():
        return bodies._world.getConstraintSolver().getBoxedLcpSolver()

    table, grip = SETTINGS.table_friction, SETTINGS.grip_friction
    assert frictions() == [table, grip] and solver() is bodies._pyramid  # shut, they press on it
    apart = rest.copy()
    for tool in robot.tools:
        apart[robot.joint_names.index(tool.gripper_joint)] += 0.2 * (
            tool.gripper_open - tool.gripper_closed
        )
    bodies.arms.skeleton.setPositions(bodies.arms.ways(apart[None])[0])
    assert frictions() == [table, grip] and solver() is bodies._cone  # and hold it
    aside = rest + np.where([name.endswith('joint1') for name in robot.joint_names], 1.0, 0.0)
    bodies.arms.skeleton.setPositions(bodies.arms.ways(aside[None])[0])
    assert frictions() == [table, table] and solver() is bodies._pyramid


@pytest.mark.parametrize('degrees', [0, 45])
def test_friction_is_the_same_in_all_directions_where_fingers_touch(robot, response, degrees):
    bodies = bodies_of(robot, response, still(robot, 0.0)[0], replace(AWAY, yaw=0.0))
    bodies._world.getConstraintSolver().setBoxedLcpSolver(bodies._cone)
    turn, speed = np.radians(degrees), 0.6
    velocity = [0, 0, 0, speed * np.cos(turn), speed * np.sin(turn), 0]
    start = bodies.poses()[0, :2, 3]
    bodies._solids[0].setVelocities(velocity)
    for _ in range(round(0.5 / STEP_S)):
        bodies.step(np.zeros(bodies.arms.skeleton.getNumDofs()))
    way = np.linalg.norm(bodies.poses()[0, :2, 3] - start)
    assert way == pytest.approx(speed**2 / 2 / SETTINGS.table_friction / 9.81, rel=0.1)


@pytest.mark.slow
def test_arms_that_pass_by_save_the_dynamics_and_nothing_else(
    robot, response, recording, monkeypatch
):
    steps = []
    step = RigidBodies.step
    monkeypatch.setattr(RigidBodies, 'step', lambda self, f: (steps.append(0), step(self, f)))
    points, _ = acted(robot, response, recording)
    short = len(steps)
    monkeypatch.setattr(RigidBodies, 'passes', lambda *_: False)
    steps.clear()
    whole, _ = acted(robot, response, recording)
    assert short < 0.75 * len(steps)
    np.testing.assert_allclose(points[-1], whole[-1], atol=0.005)


def test_arms_that_touch_nothing_go_as_they_are_expected_to(robot, response, recording):
    """Nor does the table stop them in these one and a half seconds."""
    commands = recording.positions[:76]
    poses, joints = commanded(world_of(robot, response, commands[0], AWAY), commands)
    assert np.abs(poses[:, 0, :3, 3] - AWAY.centre).max() < 0.001
    expected = replace(response, floor=None).follow(robot, commands)[0]
    np.testing.assert_allclose(joints, expected, atol=0.002)


@pytest.mark.parametrize('is_round', [False, True])
def test_what_is_wide_and_low_is_hollow(robot, response, is_round):
    """A block that stands in it does not stand on it."""
    dish = replace(
        AWAY,
        centre=AWAY.centre - [0, 0, 0.005],
        size=np.array([0.15, 0.15, 0.04]),
        is_round=is_round,
    )
    block = replace(AWAY, centre=AWAY.centre + [0, 0, 0.005], size=np.full(3, 0.03))
    commands = still(robot, 1.0)
    poses, _ = commanded(world_of(robot, response, commands[0], dish, block), commands)
    assert poses[-1, 1, 2, 3] == pytest.approx(0.006 + 0.015, abs=0.003)
    assert np.linalg.norm(poses[-1, 1, :2, 3] - AWAY.centre[:2]) < 0.01


def test_a_robot_without_a_urdf_is_named(robot, response):
    bare = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
    bare.file = None
    with pytest.raises(RobotError, match='has no URDF'):
        bodies_of(bare, response, still(robot, 0.0)[0])


def test_meshes_are_refused_by_name(response, tmp_path):
    source = share_path('config', 'robots', 'yam_bimanual')
    for name in ('robot.yaml', 'yam_bimanual.urdf'):
        shutil.copy(source / name, tmp_path)
    urdf = tmp_path / 'yam_bimanual.urdf'
    before, rest = urdf.read_text().split('<collision>', 1)
    shape = '<geometry><mesh filename="base.stl"/></geometry></collision>'
    urdf.write_text(f'{before}<collision>{shape}{rest.split("</collision>", 1)[1]}')
    robot = load_robot(tmp_path / 'robot.yaml')
    with pytest.raises(RobotError, match="'base.stl' is a mesh"):
        bodies_of(robot, response, still(robot, 0.0)[0])
