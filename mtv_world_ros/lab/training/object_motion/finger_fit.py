"""Stiffness, damping and mass of what fingers hang on, from recordings of arms that move freely.

A hand that gains speed leaves its fingers behind. One that would swing outwards is held by its
stop, so a gripper that is open reports a little less while its hand gains speed, and how much that
is says what its fingers hang on. Fingers that are geared to one another do not.

Shape letters: T periods of commands, G grippers, F fingers, K candidates, J joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.foresight.arms import Arms
from mtv_world_ros.foresight.contact_settings import ContactSettings
from mtv_world_ros.foresight.course import CoursePlanner, SUBSTEPS
from mtv_world_ros.foresight.scene import Scene
from mtv_world_ros.geometry.robot.model import RobotModel

#: a gripper that is commanded to close by more than this share of its travel may touch something
_CLOSES = 0.02
#: errors of grippers above this share of their travel are as bad: they touch something
_MOST = 0.15
#: candidates of a round, and the factors within which they are drawn
_CANDIDATES, _FACTORS = 48, (10.0, 3.0, 1.5, 1.2)
#: episodes that are looked at, and shortest ones [periods]
_MOST_EPISODES, _SHORTEST = 12, 10
#: fingers swing if that explains at least this share of the errors
_EXPLAINS = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class FreeGrippers:
    """Grippers of an episode before they close.

    Attributes:
        positions: (1 + T, J) commanded, `PERIOD_S` apart [rad or m].
        recorded: (1 + T, J) recorded likewise; NaN = no gripper, or it may touch something.
    """

    positions: FloatArray
    recorded: FloatArray

    @classmethod
    def of(cls, robot: RobotModel, positions: FloatArray, recorded: FloatArray) -> FreeGrippers:
        """Returns those of commands and recorded positions (1 + T, J)."""
        known = np.full_like(recorded, np.nan)
        last = 1
        for tool in robot.tools:
            if tool.gripper_joint is None:
                continue
            column = robot.joint_names.index(tool.gripper_joint)
            travel = abs(tool.gripper_open - tool.gripper_closed)
            moved = np.abs(positions[:, column] - positions[0, column]) > _CLOSES * travel
            count = int(moved.argmax()) if moved.any() else len(moved)
            known[:count, column] = recorded[:count, column]
            last = max(last, count)
        return cls(positions=positions[:last], recorded=known[:last])


def fit_fingers(
    grippers: Sequence[FreeGrippers], arms: Arms, settings: ContactSettings
) -> ContactSettings:
    """Returns settings with the numbers of fingers that explain what grippers reported.

    Where swinging fingers explain little the settings are as they were, and fingers do not swing.

    Args:
        grippers: of some episodes.
        arms: of the robot, with how they follow.
        settings: start of the search.
    """
    known = [one for one in grippers if len(one.positions) >= _SHORTEST]
    known = [one for one in known if np.isfinite(one.recorded).any()]
    known = known[:: max(1, len(known) // _MOST_EPISODES)][:_MOST_EPISODES]
    if not known:
        return settings
    scene = Scene.compiled(arms, ())
    swinging = settings.model_copy(update={'fingers_swing': True})
    rng = np.random.default_rng(3)
    names = ('finger_stiffness', 'finger_damping', 'finger_mass_kg')
    best, least = swinging, np.inf
    for factor in _FACTORS:
        drawn = rng.uniform(-1, 1, size=(_CANDIDATES, 3))
        drawn[0] = 0.0
        middle = np.array([getattr(best, name) for name in names])
        for numbers in (middle * factor**drawn).tolist():
            tried = swinging.model_copy(update=dict(zip(names, numbers, strict=True)))
            loss = _loss(scene, tried, known)
            if loss < least:
                best, least = tried, loss
    geared = settings.model_copy(update={'fingers_swing': False})
    return best if least < (1 - _EXPLAINS) * _loss(scene, geared, known) else settings


def _loss(scene: Scene, settings: ContactSettings, grippers: Sequence[FreeGrippers]) -> float:
    """How far grippers report to be from where they are expected, in their travels."""
    planner, arms = CoursePlanner(scene, settings), scene.arms
    names, loss = arms.robot.joint_names, 0.0
    for one in grippers:
        course, _ = planner.plan(one.positions, planner.begin(one.positions[0]))
        expected = arms.drives.joints(course.positions[::SUBSTEPS], len(names))
        for tool in arms.robot.tools:
            if tool.gripper_joint is not None:
                column = names.index(tool.gripper_joint)
                travel = abs(tool.gripper_open - tool.gripper_closed)
                off = np.abs(expected[:, column] - one.recorded[:, column]) / travel
                loss += float(np.nansum(np.minimum(off, _MOST)))
    return loss
