"""Actions as numbers: tool poses, percentiles, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from mtv_world_ros.errors import CheckpointError, ConfigError
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.model.actions import (
    ActionEncoding,
    check_control,
    collate,
    roll_pitch_yaw,
    STATISTICS,
    TOKENIZER,
    tool_features,
)


@pytest.fixture(scope='module')
def chunks(robot: RobotModel) -> list[np.ndarray]:
    """40 motions (9, J) between joint positions anywhere in the limits."""
    rng = np.random.default_rng(0)
    ends = rng.uniform(robot.lower, robot.upper, (40, 2, len(robot.joint_names)))
    return [np.linspace(a, b, 9) for a, b in ends]


def test_angles_are_those_of_pinocchio() -> None:
    rng = np.random.default_rng(0)
    rotations = np.stack(
        [pin.Quaternion(rng.normal(size=4)).normalized().matrix() for _ in range(50)]
    )
    expected = [pin.rpy.matrixToRpy(rotation) for rotation in rotations]
    np.testing.assert_allclose(roll_pitch_yaw(rotations), expected, atol=1e-9)


def test_tool_features_are_position_angles_and_opening_arm_by_arm(robot: RobotModel) -> None:
    positions = np.stack([robot.lower, (robot.lower + robot.upper) / 2])
    features = tool_features(robot, positions)
    assert features.shape == (2, 14)
    poses, openings = robot.tool_poses(positions), robot.gripper_openings(positions)
    for arm in (0, 1):
        rows = features[:, 7 * arm : 7 * arm + 7]
        np.testing.assert_allclose(rows[:, :3], poses[arm, :, :3, 3])
        rotations = [pin.rpy.rpyToMatrix(*row) for row in rows[:, 3:6]]
        np.testing.assert_allclose(rotations, poses[arm, :, :3, :3], atol=1e-9)
        np.testing.assert_allclose(rows[:, 6], openings[arm])


def test_the_1st_and_99th_percentile_become_minus_one_and_one(robot: RobotModel, chunks) -> None:
    encoding = ActionEncoding.fit('ee_mlp', robot, chunks)
    rows = np.concatenate([tool_features(robot, chunk[1:]) for chunk in chunks])
    expected = np.empty_like(rows)
    for column, values in enumerate(rows.T):
        # NumPy's default: linear between the two nearest of the sorted values
        ordered = np.sort(values)
        low, high = (
            np.interp(share * (len(values) - 1), np.arange(len(values)), ordered)
            for share in (0.01, 0.99)
        )
        expected[:, column] = np.clip(2 * (values - low) / (high - low) - 1, -1, 1)
    found = np.concatenate([encoding.encode(robot, chunk)[1:] for chunk in chunks])
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert found.min() == -1 and found.max() == 1


def test_a_joint_that_never_moves_is_zero(robot: RobotModel, chunks) -> None:
    still = [np.concatenate([chunk[:, :-1], np.full((9, 1), 0.02)], axis=1) for chunk in chunks]
    encoding = ActionEncoding.fit('policy2vec', robot, still)
    assert not encoding.encode(robot, still[0])[:, -1].any()


def test_the_start_is_no_token(robot: RobotModel, chunks) -> None:
    encoding = ActionEncoding.fit('fast_tokens', robot, chunks)
    other = chunks[0].copy()
    other[0] += 0.01
    tokens = encoding.encode(robot, chunks[0])
    assert tokens.dtype == np.int64 and tokens.ndim == 1
    np.testing.assert_array_equal(encoding.encode(robot, other), tokens)


@pytest.mark.parametrize('control', ['policy2vec', 'ee_mlp', 'fast_tokens'])
def test_saved_and_read_back_it_gives_the_same(
    robot: RobotModel, chunks, control: str, tmp_path: Path
) -> None:
    encoding = ActionEncoding.fit(control, robot, chunks)
    encoding.save(tmp_path)
    again = ActionEncoding.load(tmp_path, control)
    for chunk in chunks:
        np.testing.assert_array_equal(again.encode(robot, chunk), encoding.encode(robot, chunk))
    assert (tmp_path / TOKENIZER).is_file() == (control == 'fast_tokens')


def test_statistics_of_another_control_or_broken_ones_are_refused(
    robot: RobotModel, chunks, tmp_path: Path
) -> None:
    ActionEncoding.fit('policy2vec', robot, chunks).save(tmp_path)
    with pytest.raises(
        CheckpointError, match="is of control 'policy2vec', the model's is 'ee_mlp'"
    ):
        ActionEncoding.load(tmp_path, 'ee_mlp')
    (tmp_path / STATISTICS).write_text(json.dumps({'control': 'ee_mlp'}))
    with pytest.raises(CheckpointError, match='lacks the action statistics'):
        ActionEncoding.load(tmp_path, 'ee_mlp')
    with pytest.raises(CheckpointError, match='lacks the action statistics'):
        ActionEncoding.load(tmp_path / 'nothing', 'ee_mlp')


def test_actions_of_another_robot_are_refused(robot: RobotModel, chunks, tmp_path: Path) -> None:
    encoding = ActionEncoding.fit('policy2vec', robot, chunks)
    encoding.save(tmp_path)
    file = tmp_path / STATISTICS
    file.write_text(file.read_text().replace(robot.joint_names[0], 'shoulder'))
    with pytest.raises(CheckpointError, match="'shoulder'.*robot_file"):
        ActionEncoding.load(tmp_path, 'policy2vec').encode(robot, chunks[0])


def test_token_rows_are_filled_up() -> None:
    rows = collate([np.array([3, 1]), np.array([5, 6, 7])])
    np.testing.assert_array_equal(rows, [[3, 1, -1], [5, 6, 7]])


def test_an_unknown_control_names_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"'fast_token'.*did you mean 'fast_tokens'"):
        check_control('fast_token')
