"""Stiffness, damping and mass of what fingers hang on, from recordings of arms that move freely.

A hand that gains speed leaves its fingers behind. One that would swing outwards is held by its
stop, so a gripper that is open reports a little less while its hand gains speed, and how much that
is says what its fingers hang on. Fingers that are geared to one another do not.

Shape letters: T periods of commands, G grippers, F fingers, K candidates, J joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.model.object_motion.arm_response import ArmResponse, PERIOD_S
from mtv_world_ros.model.object_motion.contact_motions import driven
from mtv_world_ros.model.object_motion.contact_settings import ContactSettings
from mtv_world_ros.model.object_motion.finger_swing import FingerDrives
from mtv_world_ros.model.object_motion.rigid_bodies import RigidBodies

#: steps in a period
_SUBSTEPS = 10
#: a gripper that is commanded to close by more than this share of its travel may touch something
_CLOSES = 0.02
#: errors of grippers above this share of their travel are as bad: they touch something
_MOST = 0.15
#: candidates of a round, and the factors within which they are drawn
_CANDIDATES, _FACTORS = 64, (10.0, 3.0, 1.5, 1.2)
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
    grippers: Sequence[FreeGrippers],
    robot: RobotModel,
    response: ArmResponse,
    settings: ContactSettings,
) -> ContactSettings:
    """Returns settings with the numbers of fingers that explain what grippers reported.

    Where swinging fingers explain little the settings are as they were, and fingers do not swing.

    Args:
        grippers: of some episodes.
        robot: from a URDF.
        response: how its arms follow.
        settings: where the search begins.
    """
    swinging = settings.model_copy(update={'fingers_swing': True})
    swings = [found for one in grippers if (found := _swing(one, robot, response, swinging))]
    if not swings:
        return settings
    rng = np.random.default_rng(3)
    names = ('finger_stiffness', 'finger_damping', 'finger_mass_kg')
    best = np.array([getattr(settings, name) for name in names])
    for factor in _FACTORS:
        drawn = rng.uniform(-1, 1, size=(_CANDIDATES, 3))
        drawn[0] = 0.0
        candidates = best * factor**drawn
        losses = np.sum([one.losses(*candidates.T[..., None]) for one in swings], axis=0)
        best = candidates[losses.argmin()]
    if losses.min() > (1 - _EXPLAINS) * sum(one.unexplained for one in swings):
        return settings
    return swinging.model_copy(update=dict(zip(names, best.tolist(), strict=True)))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Swing:
    """What hands do to fingers in an episode.

    Attributes:
        drives: of a stiffness, damping and drive of 1 each, whose mass is that of the fingers.
        pulls: (T * n, F) of the hands.
        ways: (1 + T * n, F) of fingers that do not swing.
        means: (F, G) from fingers to grippers, as shares of their travel.
        dips: (1 + T, G) recorded, less what is expected, as shares; NaN = not known.
    """

    drives: FingerDrives
    pulls: FloatArray
    ways: FloatArray
    means: FloatArray
    dips: FloatArray

    @property
    def unexplained(self) -> float:
        """The loss of fingers that do not swing."""
        return self._loss(np.zeros_like(self.dips))

    def hung(self, stiffness: FloatArray, damping: FloatArray, mass: FloatArray) -> FingerDrives:
        """Returns the drives (K, F) of candidates (K, 1) [N/m, N s/m, kg], of a finger's metre."""
        unit = self.drives
        return replace(
            unit,
            stiffness=unit.stiffness * stiffness,
            damping=unit.damping * damping,
            mass=unit.mass + unit.stiffness * mass,
        )

    def losses(self, stiffness: FloatArray, damping: FloatArray, mass: FloatArray) -> FloatArray:
        """Returns (K,) losses of candidates, see `hung`."""
        drives = self.hung(stiffness, damping, mass)
        start = np.zeros((2, len(stiffness), self.ways.shape[1]))
        swings, _ = drives.swings(self.pulls, self.ways, PERIOD_S / _SUBSTEPS, start)
        return np.array([self._loss(one[::_SUBSTEPS] @ self.means) for one in swings])

    def _loss(self, dips: FloatArray) -> float:
        return float(np.nansum(np.minimum(np.abs(dips - self.dips), _MOST)))


def _swing(
    grippers: FreeGrippers, robot: RobotModel, response: ArmResponse, settings: ContactSettings
) -> _Swing | None:
    """None: nothing is known of any gripper for long enough."""
    if len(grippers.positions) < _SUBSTEPS or not np.isfinite(grippers.recorded).any():
        return None
    unit = settings.model_copy(update={'finger_stiffness': 1.0, 'finger_damping': 1.0})
    arms = RigidBodies(robot, response, (), unit, PERIOD_S, grippers.positions[0]).arms
    where, _ = replace(response, floor=None).follow(robot, grippers.positions)
    ways, _, _, pulls = driven(arms, where, _SUBSTEPS)
    drives = arms.finger_drives
    travels = {
        robot.joint_names.index(tool.gripper_joint): abs(tool.gripper_open - tool.gripper_closed)
        for tool in robot.tools
        if tool.gripper_joint is not None
    }
    columns = list(travels)
    scale = np.array(list(travels.values()))
    return _Swing(
        drives=replace(drives, mass=drives.mass - drives.stiffness * settings.finger_mass_kg),
        pulls=pulls,
        ways=ways[:, arms.fingers],
        means=arms.shares(columns) / scale,
        dips=(grippers.recorded - where)[:, columns] / scale,
    )
