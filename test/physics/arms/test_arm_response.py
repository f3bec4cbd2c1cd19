"""How arms follow their commands, and how that is found in recordings."""

from __future__ import annotations

from dataclasses import replace
import json

import numpy as np
import pytest

from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.physics.arms.arm_response import ArmResponse, PERIOD_S
from mtv_world_ros.physics.arms.mechanics import RobotMechanics
from mtv_world_ros.physics.checkpoint_files import load_response
from mtv_world_ros.physics.fitting.response_fit import (
    fit_response,
    found_response,
    joint_recording,
    tool_errors,
    with_floor,
)
from mtv_world_ros.robot.file import load_robot

ROBOTS = ('yam_bimanual', 'franka')
DEMO = share_path('resource', 'demo_episode')


def robot_of(name: str):
    return load_robot(share_path('config', 'robots', name, 'robot.yaml'))


def response_of(robot, compliance: float) -> ArmResponse:
    each = np.ones(len(robot.joint_names))
    return ArmResponse(
        joint_names=robot.joint_names,
        compliance=compliance * each,
        armature=0.002 * each,
        damping=0.07 * each,
        lead=0.03 * each,
    )


def commands_of(robot, num: int = 400, seed: int = 0) -> np.ndarray:
    """(T, J) commands that turn about the middle of every joint's range, at a speed of its own."""
    rng = np.random.default_rng(seed)
    low, high = np.clip(robot.lower, -2, 2), np.clip(robot.upper, -2, 2)
    times = np.arange(num)[:, None] * PERIOD_S
    speeds = rng.uniform(1.0, 4.0, len(low))
    return (low + high) / 2 + 0.2 * (high - low) * (1 - np.cos(speeds * times))


@pytest.mark.parametrize('name', ROBOTS)
def test_the_fit_finds_the_numbers_that_moved_the_joints(name):
    """The first robot's description has inertias, the second's has none."""
    robot = robot_of(name)
    true = response_of(robot, 0.02)
    recordings = []
    for seed in range(4):
        commands = commands_of(robot, seed=seed)
        recordings.append((commands, true.follow(robot, commands)[0]))
    found = fit_response(robot, recordings)
    np.testing.assert_allclose(found.damping, true.damping, atol=0.01)
    np.testing.assert_allclose(found.lead, true.lead, atol=0.01)
    lag = np.median(tool_errors(robot, recordings))
    assert np.median(tool_errors(robot, recordings, found)) < 0.05 * lag


def test_joints_that_follow_at_once_are_found_to_do_so():
    robot = robot_of('yam_bimanual')
    commands = commands_of(robot)
    found = fit_response(robot, [(commands, commands)])
    assert np.abs(found.follow(robot, commands)[0] - commands).max() < 0.01


def test_heavy_arms_swing_and_others_respond_each_for_itself():
    robot = robot_of('yam_bimanual')
    still = np.repeat(commands_of(robot)[:1], 100, axis=0)
    step = still.copy()
    step[10:, 1] += 0.3
    heavy, _ = response_of(robot, 0.03).follow(robot, step)
    light, _ = response_of(robot, 0.0).follow(robot, step)
    others = [column for column in range(still.shape[1]) if column != 1]
    assert np.abs(light[:, others] - still[:, others]).max() < 1e-9
    assert np.abs(heavy[:, others] - still[:, others]).max() > 1e-3
    assert np.abs(heavy[12, 1] - still[0, 1]) < np.abs(light[12, 1] - still[0, 1])
    np.testing.assert_allclose(light[-1], step[-1], atol=1e-3)


def test_chunks_go_on_where_the_last_one_ended():
    robot = robot_of('yam_bimanual')
    response, commands = response_of(robot, 0.02), commands_of(robot)
    whole, _ = response.follow(robot, commands)
    first, state = response.follow(robot, commands[:101])
    second, _ = response.follow(robot, commands[100:], state=state)
    np.testing.assert_allclose(np.concatenate([first, second[1:]]), whole, atol=1e-12)


def dips(robot, floor: float, num: int = 200) -> np.ndarray:
    """(T, J) commands of the first arm to 5 cm below a height and up again, seen by a tip."""
    mechanics, rest = RobotMechanics(robot), commands_of(robot)[0]

    def lowered(height: float) -> np.ndarray:
        positions = rest.copy()
        for _ in range(50):
            points = mechanics.fingertips(positions)
            jacobians = mechanics.fingertip_jacobians(positions, points)
            tip = int(points[:2, 2].argmin())
            up = jacobians[tip, 2] * (np.arange(len(rest)) < 6)
            positions = positions + up * (height - points[tip, 2]) / (up @ up)
        return positions

    above, below = lowered(floor + 0.05), lowered(floor - 0.05)
    share = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(num) / (num - 1))[:, None]
    return above + share * (below - above)


def tips_of(robot, positions: np.ndarray) -> np.ndarray:
    mechanics = RobotMechanics(robot)
    return np.array([mechanics.fingertips(row) for row in positions])


@pytest.mark.parametrize('name', [*ROBOTS, 'a base link that moves'])
def test_fingertips_move_as_their_jacobians_say(name):
    robot = robot_of(name if name in ROBOTS else 'franka')
    if name not in ROBOTS:
        robot.base_link = 'panda_link2'
    positions = commands_of(robot)[100]
    mechanics = RobotMechanics(robot)
    points = mechanics.fingertips(positions)
    jacobians = mechanics.fingertip_jacobians(positions, points)
    assert points.shape == (2 * len(robot.tools), 3)
    tools = robot.tool_poses(positions[None])[:, 0, :3, 3]
    np.testing.assert_allclose(points.reshape(-1, 2, 3).mean(1), tools, atol=1e-9)
    grippers = [tool.gripper_joint for tool in robot.tools]
    arms = [j for j, joint in enumerate(robot.joint_names) if joint not in grippers]
    for joint in arms:
        step = 1e-6 * (np.arange(len(positions)) == joint)
        moved = (tips_of(robot, [positions + step])[0] - points) / 1e-6
        np.testing.assert_allclose(moved, jacobians[..., joint], atol=1e-4)


def test_fingertips_stop_at_the_table_and_nothing_else_changes():
    robot = robot_of('yam_bimanual')
    air = response_of(robot, 0.02)
    commands = dips(robot, 0.01)
    free, _ = air.follow(robot, commands)
    met, _ = replace(air, floor=0.01).follow(robot, commands)
    assert tips_of(robot, free)[..., 2].min() < -0.03
    assert tips_of(robot, met)[..., 2].min() > 0.006
    np.testing.assert_allclose(met[:40], free[:40], atol=1e-12)
    assert np.abs(tips_of(robot, met[-1:]) - tips_of(robot, free[-1:])).max() < 0.005
    deep, _ = replace(air, floor=-1.0).follow(robot, commands)
    np.testing.assert_allclose(deep, free, atol=1e-12)


def test_the_table_is_found_where_fingertips_were_to_sink_and_did_not():
    robot = robot_of('yam_bimanual')
    air = response_of(robot, 0.02)
    commands = dips(robot, 0.03, 1000)
    true = replace(air, floor=0.03)
    met, free = (one.follow(robot, commands)[0] for one in (true, air))
    found = with_floor(air, robot, [(commands, met)])
    assert found.floor == pytest.approx(0.03, abs=0.004)
    assert with_floor(air, robot, [(commands, free)]).floor is None


def test_recorded_arms_are_nearer_to_what_is_expected_than_to_their_commands():
    robot = robot_of('yam_bimanual')
    response, text = found_response([DEMO, DEMO], robot)
    assert response is not None and 'mm from where they are expected' in text
    recording = [joint_recording(DEMO, robot)]
    assert np.median(tool_errors(robot, recording, response)) < 0.5 * np.median(
        tool_errors(robot, recording)
    )


def test_without_recordings_arms_are_taken_to_follow_at_once(tmp_path):
    response, text = found_response([tmp_path], robot_of('yam_bimanual'))
    assert response is None and 'at once' in text and str(tmp_path) in text


def test_a_response_is_read_again_by_joint_and_refused_for_another_robot(tmp_path):
    robot = robot_of('yam_bimanual')
    assert load_response(tmp_path, robot) is None
    file = tmp_path / 'arm_response.json'
    values = dict(reversed(response_of(robot, 0.02).as_json().items()))
    assert 'floor' not in values
    values |= {'floor': 0.012}
    values['left_joint1']['lead'] = 0.5
    file.write_text(json.dumps(values))
    read = load_response(tmp_path, robot)
    assert read is not None and read.lead[robot.joint_names.index('left_joint1')] == 0.5
    assert read.floor == 0.012 and read.as_json()['floor'] == 0.012
    with pytest.raises(CheckpointError, match="which robot 'franka' has; run 'mtv-world fit c"):
        load_response(tmp_path, robot_of('franka'))
    for wrong in ('much', -1.0):
        values['left_joint1']['lead'] = wrong
        file.write_text(json.dumps(values))
        with pytest.raises(CheckpointError, match=r'arm_response\.json.* cannot be used'):
            load_response(tmp_path, robot)
