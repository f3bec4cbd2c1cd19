"""What grippers report while arms move says what their fingers hang on."""

from __future__ import annotations

import numpy as np
import pytest

from mtv_world_ros.lab.training.object_motion.contact_fit import first_settings
from mtv_world_ros.lab.training.object_motion.finger_fit import _swing, fit_fingers, FreeGrippers

TRUE = {'finger_stiffness': 80.0, 'finger_damping': 6.0, 'finger_mass_kg': 0.08}


def shaken(robot, seed: int) -> np.ndarray:
    """Commands (N, J) of arms that turn about, one gripper closes at the end."""
    rng = np.random.default_rng(seed)
    times = np.arange(100) * 0.02
    positions = np.repeat(np.clip(np.zeros(14), robot.lower, robot.upper)[None], 100, axis=0)
    for tool in robot.tools:
        for joint in (1, 2, 5):
            turn = 0.3 * np.sin(2 * np.pi * rng.uniform(0.8, 2.0) * times)
            positions[:, robot.joint_names.index(f'{tool.arm}_joint{joint}')] += turn
        positions[:, robot.joint_names.index(tool.gripper_joint)] = tool.gripper_open
    positions[80:, robot.joint_names.index(robot.tools[0].gripper_joint)] = 0.0
    return positions


def recorded(robot, response, positions, settings) -> FreeGrippers:
    """What grippers of these settings report."""
    where, _ = response.follow(robot, positions)
    grippers = FreeGrippers.of(robot, positions, where)
    if settings.fingers_swing:
        swing = _swing(grippers, robot, response, settings)
        numbers = np.array([[getattr(settings, name)] for name in TRUE])[..., None]
        off = swing_of(swing, numbers)
        grippers.recorded[:, gripper_columns(robot)] += off
    return grippers


def gripper_columns(robot) -> list[int]:
    return [robot.joint_names.index(tool.gripper_joint) for tool in robot.tools]


def swing_of(swing, numbers) -> np.ndarray:
    """(1 + T, G) how far grippers are off [m]."""
    start = np.zeros((2, 1, swing.ways.shape[1]))
    off, _ = swing.hung(*numbers).swings(swing.pulls, swing.ways, 0.002, start)
    return np.stack([(off[0, ::10, 2 * k] - off[0, ::10, 2 * k + 1]) / 2 for k in range(2)], 1)


def test_a_gripper_that_closes_is_left_out_from_there_on(robot, response):
    positions = shaken(robot, 0)
    grippers = FreeGrippers.of(robot, positions, positions)
    left, right = gripper_columns(robot)
    assert np.isfinite(grippers.recorded[:80, left]).all()
    assert np.isnan(grippers.recorded[80:, left]).all()
    assert np.isfinite(grippers.recorded[:, right]).all()
    others = np.delete(grippers.recorded, [left, right], axis=1)
    assert np.isnan(others).all()


def test_the_drives_of_fingers_are_found(robot, response):
    first = first_settings(robot, response)
    true = first.model_copy(update=TRUE | {'fingers_swing': True})
    grippers = [recorded(robot, response, shaken(robot, seed), true) for seed in range(4)]
    found = fit_fingers(grippers, robot, response, first)
    assert found.fingers_swing
    assert found.finger_stiffness == pytest.approx(80.0, rel=0.1)
    assert found.finger_damping == pytest.approx(6.0, rel=0.15)


def test_fingers_that_report_no_swing_do_not_swing(robot, response):
    first = first_settings(robot, response)
    grippers = [recorded(robot, response, shaken(robot, seed), first) for seed in range(2)]
    assert fit_fingers(grippers, robot, response, first) == first
    assert fit_fingers([], robot, response, first) == first
