"""Controls that encode a plan as numbers: tool poses, percentiles, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.control.control import Control, ControlOptions, ControlScene
from mtv_world_ros.control.ee_mlp import EndEffectorMlp, tool_features
from mtv_world_ros.control.registry import CONTROL_FILE, create_control, load_control, save_control
from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.robot.model import RobotModel

ACTION_CONTROLS = ['policy2vec', 'ee_mlp', 'fast_tokens']
FRAMES = 8


@pytest.fixture(scope='module')
def motions(robot: RobotModel) -> list[Motion]:
    """40 motions of 1 + 8 states between joint positions anywhere in the limits."""
    rng = np.random.default_rng(0)
    ends = rng.uniform(robot.lower, robot.upper, (40, 2, len(robot.joint_names)))
    return [Motion.of(robot, (), np.linspace(a, b, 1 + FRAMES)) for a, b in ends]


@pytest.fixture(scope='module')
def options(robot: RobotModel) -> ControlOptions:
    return ControlOptions(robot=robot, rendering={}, object_mask=True, num_frames=FRAMES)


def scene(motion: Motion) -> ControlScene:
    return ControlScene(
        motion=motion,
        times=np.arange(len(motion.positions)) / 5,
        start_frames=np.zeros((0, 4, 4, 3), np.uint8),
    )


def made(control: Control, motion: Motion) -> np.ndarray:
    inputs = control.make(scene(motion))
    control.layout.check(inputs, 'test')
    assert inputs.num_frames == len(motion.positions) - 1
    array = inputs.frame if inputs.context is None else inputs.context
    assert array is not None
    return array


def fitted(name: str, options: ControlOptions, motions: list[Motion]) -> Control:
    return create_control(name, options).fitted(motions)


def test_tool_features_are_position_rotation_and_opening_arm_by_arm(robot):
    positions = np.stack([robot.lower, (robot.lower + robot.upper) / 2])
    features = tool_features(Motion.of(robot, (), positions))
    assert features.shape == (2, 20)
    poses, openings = robot.tool_poses(positions), robot.gripper_openings(positions)
    for arm in (0, 1):
        rows = features[:, 10 * arm : 10 * arm + 10]
        np.testing.assert_allclose(rows[:, :3], poses[arm, :, :3, 3])
        np.testing.assert_allclose(rows[:, 3:6], poses[arm, :, :3, 0])
        np.testing.assert_allclose(rows[:, 6:9], poses[arm, :, :3, 1])
        np.testing.assert_allclose(rows[:, 9], openings[arm])


def test_tool_features_do_not_jump_where_a_tool_turns_through_straight_down():
    turns = np.linspace(-0.05, 0.05, 101)
    tools = np.stack([pin.rpy.rpyToMatrix(np.pi + turn, turn, 0.3) for turn in turns])
    poses = np.tile(np.eye(4), (1, len(turns), 1, 1))
    poses[0, :, :3, :3] = tools
    motion = SimpleNamespace(
        tools=poses,
        tool_points=poses[..., :3, 3],
        openings=np.ones((1, len(turns))),
        positions=np.zeros((len(turns), 1)),
    )
    assert np.abs(np.diff(tool_features(motion), axis=0)).max() < 0.005


def test_a_checkpoint_with_euler_angles_is_refused_by_name(options, motions):
    control = fitted('ee_mlp', options, motions)
    state = {**control.state(), 'names': ['left roll', 'left pitch']}
    with pytest.raises(CheckpointError, match='Euler angles.*Train it again'):
        control.restored(state)


def test_the_1st_and_99th_percentile_become_minus_one_and_one(options, motions):
    control = fitted('ee_mlp', options, motions)
    rows = np.concatenate([tool_features(motion)[1:] for motion in motions])
    expected = np.empty_like(rows)
    for column, values in enumerate(rows.T):
        # NumPy's default: linear between the two nearest of the sorted values
        ordered = np.sort(values)
        low, high = (
            np.interp(share * (len(values) - 1), np.arange(len(values)), ordered)
            for share in (0.01, 0.99)
        )
        expected[:, column] = np.clip(2 * (values - low) / (high - low) - 1, -1, 1)
    found = np.concatenate([made(control, motion)[1:] for motion in motions])
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert found.min() == -1 and found.max() == 1


def test_policy2vec_is_the_mean_of_the_scaled_commands(options, motions):
    control = fitted('policy2vec', options, motions)
    found = made(control, motions[0])
    commands = np.asarray(motions[0].positions)[1:]
    low, high = np.percentile(
        np.concatenate([motion.positions[1:] for motion in motions]), (1, 99), axis=0
    )
    scaled = np.clip(2 * (commands - low) / (high - low) - 1, -1.5, 1.5)
    np.testing.assert_allclose(found, scaled.mean(0)[None], atol=1e-5)


def test_a_joint_that_never_moves_is_zero(robot, options, motions):
    still = []
    for motion in motions:
        positions = np.array(motion.positions)
        positions[:, -1] = 0.02
        still.append(Motion.of(robot, (), positions))
    assert not made(fitted('policy2vec', options, still), still[0])[:, -1].any()


def test_the_start_is_no_token(robot, options, motions):
    control = fitted('fast_tokens', options, motions)
    positions = np.array(motions[0].positions)
    positions[0] += 0.01
    tokens = made(control, motions[0])
    assert tokens.dtype == np.int64 and tokens.ndim == 1
    np.testing.assert_array_equal(made(control, Motion.of(robot, (), positions)), tokens)


@pytest.mark.parametrize('name', ACTION_CONTROLS)
def test_saved_and_read_back_it_gives_the_same(options, motions, name, tmp_path: Path):
    control = fitted(name, options, motions)
    save_control(control, name, tmp_path)
    again = load_control(name, options, tmp_path)
    assert again.cache_key() == control.cache_key()
    for motion in motions:
        np.testing.assert_array_equal(made(again, motion), made(control, motion))


def test_the_papers_control_has_nothing_to_save(options, tmp_path):
    save_control(create_control('trajectory_video', options), 'trajectory_video', tmp_path)
    assert not list(tmp_path.iterdir())
    assert load_control('trajectory_video', options, tmp_path).layout.names == ('video',)


def test_a_file_of_another_control_or_a_broken_or_missing_one_is_refused(
    options, motions, tmp_path
):
    save_control(fitted('policy2vec', options, motions), 'policy2vec', tmp_path)
    with pytest.raises(
        CheckpointError, match="is of control 'policy2vec', the model's is 'ee_mlp'"
    ):
        load_control('ee_mlp', options, tmp_path)
    (tmp_path / CONTROL_FILE).write_text(json.dumps({'control': 'ee_mlp', 'state': {}}))
    with pytest.raises(CheckpointError, match='cannot be used'):
        load_control('ee_mlp', options, tmp_path)
    with pytest.raises(CheckpointError, match=r'no control.json.*0\.1\.0'):
        load_control('ee_mlp', options, tmp_path / 'nothing')


@pytest.mark.parametrize('value', ['NaN', '[1, 2]'])
def test_limits_that_are_no_numbers_of_the_robot_are_refused(options, motions, value, tmp_path):
    control = fitted('policy2vec', options, motions)
    save_control(control, 'policy2vec', tmp_path)
    file = tmp_path / CONTROL_FILE
    state = json.loads(file.read_text())
    state['state']['low'][0] = json.loads(value)
    file.write_text(json.dumps(state))
    with pytest.raises(CheckpointError):
        load_control('policy2vec', options, tmp_path)


def test_plans_of_another_robot_are_refused(options, motions, tmp_path):
    control = fitted('policy2vec', options, motions)
    save_control(control, 'policy2vec', tmp_path)
    file = tmp_path / CONTROL_FILE
    name = motions[0].robot.joint_names[0]
    file.write_text(file.read_text().replace(f'"{name}"', '"shoulder"'))
    wrong_way_round_would_fail = "trained on the numbers.*'shoulder'.*the robot has.*robot_file"
    with pytest.raises(CheckpointError, match=wrong_way_round_would_fail):
        load_control('policy2vec', options, tmp_path)


def test_one_action_in_twenty_is_dropped_with_ee_mlp_alone(options):
    found = {name: create_control(name, options).dropout for name in ACTION_CONTROLS}
    assert found == {'policy2vec': 0.0, 'ee_mlp': 0.05, 'fast_tokens': 0.0}
    assert EndEffectorMlp.dropout == 0.05
