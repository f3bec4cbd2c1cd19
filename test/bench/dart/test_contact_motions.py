"""Objects as rigid bodies, under the bundled episode's commands and under others."""

from __future__ import annotations

from dataclasses import replace
import shutil

import numpy as np
import pytest

pytest.importorskip('dartpy', reason='dartpy is not installed (pip install .[dart])')

from mtv_world_ros.bench.dart import contact_motions
from mtv_world_ros.bench.dart.contact_motions import (
    check_robot,
    ContactMotions,
    course_of,
)
from mtv_world_ros.bench.dart.rigid_bodies import _FREE, RigidBodies
from mtv_world_ros.errors import RobotError
from mtv_world_ros.files import share_path
from mtv_world_ros.foresight.contact_settings import ContactSettings
from mtv_world_ros.geometry.robot.arm_solver import ArmSolver
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.geometry.robot.mechanics import RobotMechanics
from mtv_world_ros.geometry.solids import Solid
from mtv_world_ros.lab.training.object_motion.contact_fit import _Trial, read_contact

#: of commands between two rows that come back
ROWS = 5
SETTINGS = ContactSettings(
    finger_stiffness=190.0,
    finger_damping=7.0,
    finger_mass_kg=0.02,
    grip_friction=1.0,
    table_friction=0.5,
    density=300.0,
    tray_kg=0.4,
    num_motions=1,
)
#: of the engine [s]
STEP_S = contact_motions.STEP_S
#: out of the arms' reach
AWAY = Solid(centre=np.array([1.0, 1.0, 0.025]), size=np.full(3, 0.05), yaw=0.3)


@pytest.fixture(scope='module')
def recording(robot):
    read = read_contact(share_path('resource', 'demo_episode'), robot, ('low', 'high'))
    return _Trial.of(read, SETTINGS)


def motions_of(response, *solids: Solid | None, **changed) -> ContactMotions:
    settings = SETTINGS.model_copy(update=changed)
    return ContactMotions(settings=settings, response=response, solids=solids)


def still(robot, seconds: float) -> np.ndarray:
    joints = np.clip(np.zeros(len(robot.joint_names)), robot.lower, robot.upper)
    return np.repeat(joints[None], round(seconds / 0.02) + 1, axis=0)


def test_a_block_is_carried_to_where_the_recorded_one_was(robot, response, recording):
    motions = motions_of(response, *recording.solids)
    moved, _ = motions.advance(robot, recording.positions, ROWS)
    points, rotations = moved.points, moved.rotations
    assert points.shape == (1, len(recording.positions[::ROWS]), 2, 3)
    assert rotations.shape == (*points.shape, 3)
    way = points[0, -1] - points[0, 0]
    assert np.linalg.norm(way[0] - recording.ways[-1, 0]) < 0.025 < 0.1 < np.linalg.norm(way[0])
    assert np.linalg.norm(way[1]) < 0.01


def test_fingers_are_where_what_they_hold_stops_them(robot, response, recording):
    """Whatever they are commanded to."""
    motions = motions_of(response, *recording.solids)
    joints = motions.advance(robot, recording.positions, ROWS)[0].joints[0]
    widest = robot.gripper_openings(joints) - robot.gripper_openings(recording.positions[::ROWS])
    assert 0.3 < widest.max() < 0.8
    opened = robot.gripper_openings(joints)[:, -1]
    np.testing.assert_allclose(opened, 1, atol=0.02)


def test_a_gripper_that_stays_open_carries_nothing(robot, response, recording):
    opened = recording.positions.copy()
    for tool in robot.tools:
        opened[:, robot.joint_names.index(tool.gripper_joint)] = tool.gripper_open
    points = motions_of(response, *recording.solids).advance(robot, opened, ROWS)[0].points
    assert np.ptp(points[0, ..., 2], axis=0).max() < 0.005


def test_fingers_that_do_not_rub_lose_the_block(robot, response, recording):
    slippery = motions_of(response, *recording.solids, grip_friction=0.02)
    points = slippery.advance(robot, recording.positions, ROWS)[0].points
    assert np.linalg.norm(points[0, -1, 0] - points[0, 0, 0] - recording.ways[-1, 0]) > 0.05


def shaken(robot, seconds: float = 2.0) -> np.ndarray:
    """Commands (N, J) of arms that turn to and fro about their first joints, grippers open."""
    positions = still(robot, seconds)
    turn = 0.3 * np.sin(2 * np.pi * 1.5 * np.arange(len(positions)) * 0.02)
    for tool in robot.tools:
        positions[:, robot.joint_names.index(f'{tool.arm}_joint1')] += turn
        positions[:, robot.joint_names.index(tool.gripper_joint)] = tool.gripper_open
    return positions


def courses_of(robot, response, positions, **changed):
    motions = motions_of(response, **changed)
    arms = RigidBodies(robot, response, (), motions.settings, STEP_S, positions[0]).arms
    return arms, course_of(arms, response.follow(robot, positions)[0])[0]


def test_fingers_of_a_hand_that_gains_speed_stay_behind(robot, response):
    arms, course = courses_of(robot, response, shaken(robot), fingers_swing=True)
    off = (course.free - course.ways)[:, arms.fingers]
    assert 0.001 < np.abs(off).max() < 0.03
    # never outwards, where the stops are: left fingers open upwards, their mirrors downwards
    openness = off * np.sign(course.ways[0, arms.fingers])
    assert openness.max() < 1e-4
    others = np.delete(course.free - course.ways, arms.fingers, axis=1)
    assert (others == 0).all()


def test_fingers_that_are_geared_do_not_swing(robot, response):
    _, course = courses_of(robot, response, shaken(robot), fingers_swing=False)
    np.testing.assert_array_equal(course.free, course.ways)


@pytest.mark.parametrize('swing', [False, True])
def test_in_free_air_dynamics_go_as_the_course_says(robot, response, swing):
    """So that arms may pass by without them."""
    positions = shaken(robot)
    motions = motions_of(response, fingers_swing=swing)
    bodies = RigidBodies(robot, response, (), motions.settings, STEP_S, positions[0])
    course = course_of(bodies.arms, response.follow(robot, positions)[0])[0]
    bodies.arms.skeleton.setPositions(course.free[0])
    worst = 0.0
    for step in range(len(course.forces)):
        forces = course.forces[step], course.ways[step], course.velocities[step]
        bodies.step(bodies.arms.forces(*forces))
        off = np.abs(bodies.arms.skeleton.getPositions() - course.free[step + 1])
        worst = max(worst, off.max())
    assert worst < 0.005


def test_an_arm_feels_its_own_rotors_alone(robot, response, recording):
    """The engine has none; its bodies come near to what joints feel."""
    pose = recording.positions[0]
    arms = RigidBodies(robot, response, (), SETTINGS, STEP_S, pose).arms
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
        _, then = motions_of(response).advance(robot, positions, ROWS)
        arms = RigidBodies(robot, response, (), SETTINGS, STEP_S, rest).arms
        reached.append(np.abs(then.states[0].positions[-1] - arms.ways(positions[-1:])[0]).max())
    assert reached[0] > 0.05 > 0.01 > reached[1]


def test_both_shut_fingers_bear_on_what_they_press(robot, response, recording):
    """Where tips do not give way one bears it all, and slides away from the other."""
    lowest = robot.tool_poses(recording.positions)[..., 2, 3]
    arm, row = np.unravel_index(lowest.argmin(), lowest.shape)
    tool, joints = robot.tools[arm], recording.positions[row].copy()
    joints[robot.joint_names.index(tool.gripper_joint)] = tool.gripper_closed
    pose = robot.tool_poses(joints[None])[arm, 0]
    block = Solid(centre=np.array([*pose[:2, 3], 0.025]), size=np.full(3, 0.05))
    solver, ends = ArmSolver(robot, tool), []
    for height in (0.11, 0.03):  # 2 cm too deep, 1 cm beside the middle
        place = pose.copy()
        place[:3, 3] = pose[0, 3] + 0.01, pose[1, 3], height
        ends.append(joints.copy())
        ends[-1][solver.indices] = solver.solve(place, joints[solver.indices])
    share = np.clip(np.linspace(-0.5, 2, 50), 0, 1)[:, None]
    positions = ends[0] + share * (ends[1] - ends[0])
    motions = motions_of(
        response, block, fingers_swing=True, grip_friction=1.6, pad_stiffness=1e4, num_motions=2
    )
    moved, _ = motions.advance(robot, positions, ROWS)
    soft, hard = (robot.gripper_openings(joints)[arm].max() for joints in moved.joints)
    assert soft <= 0.01 and hard >= 0.03
    assert (np.linalg.norm(moved.points[:, -1] - moved.points[:, 0], axis=-1) < 0.005).all()


def test_what_is_pushed_off_its_middle_goes_along_with_the_fingers(robot, response, recording):
    """It rubs on them as much as what is held, and does not slide off to one side."""
    lowest = robot.tool_poses(recording.positions)[..., 2, 3]
    arm, row = np.unravel_index(lowest.argmin(), lowest.shape)
    tool, joints = robot.tools[arm], recording.positions[row].copy()
    joints[robot.joint_names.index(tool.gripper_joint)] = tool.gripper_closed
    pose = robot.tool_poses(joints[None])[arm, 0]
    solver, ends = ArmSolver(robot, tool), []
    for way in (np.zeros(2), np.array([0.02, 0.05])):
        place = pose.copy()
        place[:3, 3] = *(pose[:2, 3] + way), 0.03
        ends.append(joints.copy())
        ends[-1][solver.indices] = solver.solve(place, joints[solver.indices])
    share = np.clip(np.linspace(-0.5, 1.5, 100), 0, 1)[:, None]
    positions = ends[0] + share * (ends[1] - ends[0])
    middle = np.array([pose[0, 3] + 0.012, pose[1, 3] + 0.05, 0.025])
    block = Solid(centre=middle, size=np.full(3, 0.05))
    motions = motions_of(response, block, grip_friction=1.6, table_friction=0.8)
    moved, _ = motions.advance(robot, positions, ROWS)
    way = moved.points[0, -1, 0] - moved.points[0, 0, 0]
    # bounded by forces that do without friction, it would go half as far aside, and turn
    np.testing.assert_allclose(way[:2], [0.0126, 0.0336], atol=0.002)
    assert moved.rotations[0, -1, 0, 0, 0] > np.cos(np.radians(5))


def test_where_cones_diverge_a_pyramid_goes_on(robot, response, recording, monkeypatch):
    goes_on = RigidBodies.step

    def diverges(bodies, forces):
        goes_on(bodies, forces)
        if bodies._world.getConstraintSolver().getBoxedLcpSolver() is bodies._cone:
            lost.append(bodies)
            bodies._solids[0].setPositions(np.full(6, np.nan))

    lost = []
    monkeypatch.setattr(RigidBodies, 'step', diverges)
    motions = motions_of(response, *recording.solids)
    moved, _ = motions.advance(robot, recording.positions, ROWS)
    assert lost and np.isfinite(moved.points).all()
    way = np.linalg.norm(moved.points[0, -1] - moved.points[0, 0], axis=-1)
    assert way.max() > 0.05  # carried, as by cones


def test_pads_give_way_on_objects_and_not_on_the_table(robot, response):
    rest = still(robot, 0.0)[0]
    for tool in robot.tools:
        rest[robot.joint_names.index(tool.gripper_joint)] = tool.gripper_closed
    tip = robot.tool_poses(rest[None])[0, 0, :3, 3]
    for table, given in ((tip[2] - 0.2, True), (tip[2], False)):
        settings = SETTINGS.model_copy(update={'pad_stiffness': 1e4, 'table_m': table})
        between = replace(AWAY, centre=tip)
        bodies = RigidBodies(robot, response, (between,), settings, STEP_S, rest)
        assert len(bodies.arms.pads) == 2 * len(robot.tools)
        bodies.notice_touch()
        kinds = {pad.getActuatorType() for pad in bodies.arms.pads}
        assert (_FREE in kinds) == given


@pytest.mark.parametrize(('is_open', 'height'), [(True, 0.02), (False, 0.07)])
def test_what_falls_into_a_cup_lies_on_its_floor(robot, response, is_open, height):
    cup = Solid(
        centre=np.array([0.0, 0.3, 0.03]),
        size=np.array([0.05, 0.05, 0.06]),
        is_round=True,
        is_open=is_open,
    )
    ball = Solid(centre=np.array([0.0, 0.3, 0.09]), size=np.full(3, 0.02))
    bodies = RigidBodies(robot, response, (cup, ball), SETTINGS, STEP_S)
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
    bodies = RigidBodies(robot, response, (AWAY, between), SETTINGS, STEP_S, rest)

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
    bodies = RigidBodies(robot, response, (replace(AWAY, yaw=0.0),), SETTINGS, STEP_S)
    bodies._world.getConstraintSolver().setBoxedLcpSolver(bodies._cone)
    turn, speed = np.radians(degrees), 0.6
    velocity = [0, 0, 0, speed * np.cos(turn), speed * np.sin(turn), 0]
    start = bodies.poses()[0, :2, 3]
    bodies._solids[0].setVelocities(velocity)
    for _ in range(round(0.5 / STEP_S)):
        bodies.step(np.zeros(bodies.arms.skeleton.getNumDofs()))
    way = np.linalg.norm(bodies.poses()[0, :2, 3] - start)
    assert way == pytest.approx(speed**2 / 2 / SETTINGS.table_friction / 9.81, rel=0.1)


def test_arms_that_pass_by_save_the_dynamics_and_nothing_else(
    robot, response, recording, monkeypatch
):
    steps = []
    step = RigidBodies.step
    monkeypatch.setattr(RigidBodies, 'step', lambda self, f: (steps.append(0), step(self, f)))
    motions = motions_of(response, *recording.solids)
    points = motions.advance(robot, recording.positions, ROWS)[0].points
    short = len(steps)
    monkeypatch.setattr(RigidBodies, 'passes', lambda *_: False)
    steps.clear()
    whole = motions.advance(robot, recording.positions, ROWS)[0].points
    assert short < 0.75 * len(steps)
    np.testing.assert_allclose(points[0, -1], whole[0, -1], atol=0.005)


def test_chunks_go_on_where_the_last_one_ended(robot, response, recording):
    motions, half = motions_of(response, *recording.solids), 34 * ROWS
    whole = motions.advance(robot, recording.positions, ROWS)[0].points
    first, then = motions.advance(robot, recording.positions[: half + 1], ROWS)
    second, _ = then.advance(robot, recording.positions[half:], ROWS)
    np.testing.assert_allclose(first.points[0], whole[0, :35], atol=1e-3)
    np.testing.assert_allclose(second.points[0, 0], first.points[0, -1], atol=1e-9)
    np.testing.assert_allclose(second.joints[0, 0], first.joints[0, -1], atol=1e-9)
    assert np.linalg.norm(second.points[0, -1] - whole[0, -1], axis=-1).max() < 0.02
    assert second.rotations.shape[:3] == second.points.shape[:3]


def test_arms_that_touch_nothing_go_as_they_are_expected_to(robot, response, recording):
    """Nor does the table stop them in these one and a half seconds."""
    commands = recording.positions[:76]
    moved, then = motions_of(response, AWAY).advance(robot, commands, ROWS)
    assert np.abs(moved.points[0] - AWAY.centre).max() < 0.001
    expected = replace(response, floor=None).follow(robot, commands)[0]
    np.testing.assert_allclose(moved.joints[0], expected[::ROWS], atol=0.002)
    assert len(then.states[0].positions[-1]) == len(expected[0]) + 2  # fingers count each


def test_motions_differ_within_the_errors_of_masks(robot, response):
    motions = motions_of(response, AWAY, num_motions=4)
    points = motions.advance(robot, still(robot, 0.2), ROWS)[0].points
    starts = points[:, 0, 0]
    np.testing.assert_allclose(starts[0], AWAY.centre, atol=1e-9)
    assert 0 < np.abs(starts[1:, :2] - AWAY.centre[:2]).max() < 0.006
    assert len({size.tobytes() for size in motions.sizes[:, 0]}) == 4
    again = motions.advance(robot, still(robot, 0.2), ROWS)[0].points
    np.testing.assert_array_equal(again, points)


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
    points = motions_of(response, dish, block).advance(robot, still(robot, 1.0), ROWS)[0].points
    assert points[0, -1, 1, 2] == pytest.approx(0.006 + 0.015, abs=0.003)
    assert np.linalg.norm(points[0, -1, 1, :2] - AWAY.centre[:2]) < 0.01


def test_an_object_that_was_not_seen_is_not_known(robot, response):
    motions = motions_of(response, None, AWAY)
    moved, _ = motions.advance(robot, still(robot, 0.2), ROWS)
    points, rotations = moved.points, moved.rotations
    assert np.isnan(points[:, :, 0]).all() and np.isfinite(points[:, :, 1]).all()
    assert np.isfinite(rotations).all()
    assert np.isnan(motions.sizes[:, 0]).all() and np.isnan(motions.centres[0]).all()
    motions = motions_of(response, None)
    points = motions.advance(robot, still(robot, 0.2), ROWS)[0].points
    assert points.shape == (1, 3, 1, 3) and motions.sizes.shape == (1, 1, 3)
    nothing = motions_of(response)
    points = nothing.advance(robot, still(robot, 0.2), ROWS)[0].points
    assert points.shape == (1, 3, 0, 3) and nothing.centres.shape == (0, 3)


def test_robots_of_which_contact_cannot_be_computed_are_named(robot, response):
    light = replace(response, compliance=np.zeros_like(response.compliance))
    with pytest.raises(RobotError, match="robot 'yam_bimanual' were found without inertias"):
        check_robot(SETTINGS, robot, light)
    bare = load_robot(share_path('config', 'robots', 'yam_bimanual.yaml'))
    bare.file = None
    with pytest.raises(RobotError, match='has no URDF'):
        check_robot(SETTINGS, bare, response)


def test_meshes_are_found_or_named(response, tmp_path):
    source = share_path('config', 'robots')
    for name in ('yam_bimanual.yaml', 'yam_bimanual.urdf'):
        shutil.copy(source / name, tmp_path)
    urdf = tmp_path / 'yam_bimanual.urdf'
    before, rest = urdf.read_text().split('<collision>', 1)
    shape = '<geometry><mesh filename="base.stl"/></geometry></collision>'
    urdf.write_text(f'{before}<collision>{shape}{rest.split("</collision>", 1)[1]}')
    robot = load_robot(tmp_path / 'yam_bimanual.yaml')
    with pytest.raises(RobotError, match="mesh 'base.stl' is missing"):
        check_robot(SETTINGS, robot, response)
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], np.float32)
    faces = [
        corners[list(face)].tobytes() for face in ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
    ]
    stl = bytes(80) + np.uint32(4).tobytes()
    stl += b''.join(bytes(12) + face + bytes(2) for face in faces)
    (tmp_path / 'base.stl').write_bytes(stl)
    check_robot(SETTINGS, robot, response)
