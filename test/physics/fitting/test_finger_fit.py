"""What grippers report while arms move says what their fingers hang on."""

from __future__ import annotations

import numpy as np
import pytest

from mtv_world_ros.physics.arms.arms import Arms
from mtv_world_ros.physics.engine.contact_scene import CompiledScene
from mtv_world_ros.physics.engine.drive_inputs import CoursePlanner, SUBSTEPS
from mtv_world_ros.physics.fitting import contact_fit
from mtv_world_ros.physics.fitting.contact_fit import first_settings, fit_fingers, FreeGrippers

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


def recorded(arms, positions, settings) -> FreeGrippers:
    """What grippers of these settings report."""
    planner = CoursePlanner(CompiledScene.compiled(arms, ()), settings)
    course, _ = planner.plan(positions, planner.begin(positions[0]))
    where = arms.drives.joints(course.positions[::SUBSTEPS], len(arms.robot.joint_names))
    return FreeGrippers.of(arms.robot, positions, where)


def gripper_columns(robot) -> list[int]:
    return [robot.joint_names.index(tool.gripper_joint) for tool in robot.tools]


def test_a_gripper_that_closes_is_left_out_from_there_on(robot, response):
    positions = shaken(robot, 0)
    grippers = FreeGrippers.of(robot, positions, positions)
    left, right = gripper_columns(robot)
    assert np.isfinite(grippers.recorded[:80, left]).all()
    assert np.isnan(grippers.recorded[80:, left]).all()
    assert np.isfinite(grippers.recorded[:, right]).all()
    others = np.delete(grippers.recorded, [left, right], axis=1)
    assert np.isnan(others).all()


@pytest.mark.slow
def test_the_drives_of_fingers_are_found(robot, response, monkeypatch):
    fingers = contact_fit.FingerFitSettings(num_candidates=24)
    monkeypatch.setattr(contact_fit, '_FINGERS', fingers)
    arms = Arms(robot, response)
    first = first_settings(arms)
    true = first.model_copy(update=TRUE | {'fingers_swing': True})
    grippers = [recorded(arms, shaken(robot, seed), true) for seed in range(2)]
    found = fit_fingers(grippers, arms, first)
    assert found.fingers_swing
    assert found.finger_stiffness == pytest.approx(80.0, rel=0.25)


def test_fingers_that_report_no_swing_do_not_swing(robot, response, monkeypatch):
    fingers = contact_fit.FingerFitSettings(num_candidates=8)
    monkeypatch.setattr(contact_fit, '_FINGERS', fingers)
    arms = Arms(robot, response)
    first = first_settings(arms)
    grippers = [recorded(arms, shaken(robot, seed), first) for seed in range(2)]
    assert fit_fingers(grippers, arms, first) == first
    assert fit_fingers([], arms, first) == first
