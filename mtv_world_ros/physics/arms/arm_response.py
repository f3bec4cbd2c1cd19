"""Response of arms to commands: lag, overshoot and limited bandwidth.

Each joint is driven towards its command like a mass on a damped spring, and feels the others
through the arm's inertia. Scaled by the spring's stiffness k (J,), with the mass matrix M (J, J)
and the bias forces b (J,) of the robot's description at positions q:

    (M q'' + b) / k + armature q'' = command + lead command' - q - damping q'

The numbers are found in recordings (`training/object_motion/response_fit.py`), so gains need not
be known; a robot described without inertias has M = 0, and its joints respond each for itself.
Fingertips stop at the table, which pushes back like a stiff spring with friction. Other contacts
are not part of this response.

Shape letters: T steps, J joints, P fingertips.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import TrajectoryError
from mtv_world_ros.physics.arms.mechanics import RobotMechanics
from mtv_world_ros.robot.model import RobotModel

#: between commands, after which the inertia is computed again [s]
PERIOD_S = 0.02
#: integration steps in it
_SUBSTEPS = 2
#: stiffness of the table under a fingertip [N/m]
TABLE_STIFFNESS_N_M = 5000.0
#: damping of the table under a fingertip [N s/m]
TABLE_DAMPING_N_S_M = 100.0
#: friction of the table under a fingertip
TABLE_FRICTION = 0.9
#: sliding speed below which that friction is viscous [m/s]
VISCOUS_SPEED_M_S = 0.02
#: height above the table from which a fingertip does not reach it within a period [m]
_NEAR_M = 0.03
#: joints that are faster have run away from their commands [rad/s or m/s]
_WILD = 500.0
#: of each joint
NUMBERS = ('compliance', 'armature', 'damping', 'lead')
_LARGEST = {'compliance': 10.0, 'armature': 1.0, 'damping': 1.0, 'lead': 1.0}
#: key of the table's height in a file
_FLOOR = 'floor'
#: largest height of a table that a file may state [m]
_HIGHEST_M = 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmState:
    """Positions, velocities and last commands of the joints; all (J,)."""

    positions: FloatArray
    velocities: FloatArray
    commands: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmResponse:
    """Second-order response of each joint to its commands; inertia couples the links.

    Attributes:
        joint_names: names of the robot's J joints.
        compliance: (J,) compliance of each drive, 1 / k [rad / N m].
        armature: (J,) armature of each drive over its stiffness [s^2].
        damping: (J,) damping of each drive over its stiffness [s].
        lead: (J,) time of the velocity feed-forward of each drive [s].
        floor: lowest height of fingertips, in the base frame [m]; None = not known. It stops
            joints with a compliance, which are those of a description with inertias.

    Raises:
        ValueError: a number is not finite, below 0, or larger than that of any arm.
    """

    joint_names: tuple[str, ...]
    compliance: FloatArray
    armature: FloatArray
    damping: FloatArray
    lead: FloatArray
    floor: float | None = None

    def __post_init__(self) -> None:
        for name in NUMBERS:
            values = getattr(self, name)
            if not ((values >= 0) & (values <= _LARGEST[name])).all():
                raise ValueError(
                    f'{name} is {values.tolist()}; give numbers from 0 to {_LARGEST[name]:g}'
                )
        if self.floor is not None and not abs(self.floor) <= _HIGHEST_M:
            raise ValueError(f'floor is {self.floor}; give a height within {_HIGHEST_M:g} m of 0')

    @classmethod
    def from_json(cls, values: Mapping[str, Any], joint_names: Sequence[str]) -> ArmResponse:
        """Return the response that `as_json` wrote, for a robot with these joints.

        Raises:
            KeyError: a joint or number is missing.
            TypeError, ValueError: a value is no number of an arm.
        """
        rows = {name: [float(values[joint][name]) for joint in joint_names] for name in NUMBERS}
        arrays = {name: np.array(row) for name, row in rows.items()}
        floor = values.get(_FLOOR)
        return cls(
            joint_names=tuple(joint_names), **arrays, floor=None if floor is None else float(floor)
        )

    def as_json(self) -> dict[str, Any]:
        """Return the parameters of each joint by name, and the floor, as plain values."""
        joints: dict[str, Any] = {
            joint: {name: float(getattr(self, name)[column]) for name in NUMBERS}
            for column, joint in enumerate(self.joint_names)
        }
        return joints | ({} if self.floor is None else {_FLOOR: self.floor})

    def follow(
        self,
        robot: RobotModel,
        commands: FloatArray,
        state: ArmState | None = None,
    ) -> tuple[FloatArray, ArmState]:
        """Return the positions (T, J) under commands (T, J), and the state after them.

        Args:
            robot: gives the inertia.
            commands: commands in its joint order, `PERIOD_S` apart; the first row is where `state`
                is, or where the joints rest.
            state: state at the first row.

        Raises:
            TrajectoryError: the arms do not get to the commands, but faster and faster.
        """
        now = state or ArmState(
            positions=commands[0], velocities=np.zeros(commands.shape[1]), commands=commands[0]
        )
        positions, velocities, last = now.positions, now.velocities, now.commands
        rows, h = [positions], PERIOD_S / _SUBSTEPS
        mechanics = RobotMechanics(robot)
        for command in commands[1:]:
            mass, bias = mechanics.inertia(positions, velocities)
            driven = self.compliance[:, None] * mass + np.diag(self.armature)
            system = driven + np.diag(h / 2 * self.damping + h * h / 4)
            drive = command + self.lead * (command - last) / PERIOD_S - self.compliance * bias
            free = np.linalg.inv(system)
            tips = self._tips_near(mechanics, positions)
            for _ in range(_SUBSTEPS):  # implicit midpoint
                force = drive - positions - (h / 2 + self.damping) * velocities
                solve, table = free, tips and tips.forces(positions, velocities, h)
                if table:  # scaled by the stiffness of the joints, as all of it
                    force = force + self.compliance * table[0]
                    solve = np.linalg.inv(system + self.compliance[:, None] * table[1])
                acceleration = solve @ force
                positions = positions + h * velocities + h * h / 2 * acceleration
                velocities = velocities + h * acceleration
            _check_speeds(robot, velocities, command)
            last = command
            rows.append(positions)
        then = ArmState(positions=positions, velocities=velocities, commands=last)
        return np.stack(rows), then

    def _tips_near(self, mechanics: RobotMechanics, positions: FloatArray) -> _Tips | None:
        if self.floor is None:
            return None
        points = mechanics.fingertips(positions)
        heights = points[:, 2] - self.floor
        near = heights < _NEAR_M
        if not near.any():
            return None
        jacobians = mechanics.fingertip_jacobians(positions, points)
        return _Tips(heights=heights[near], jacobians=jacobians[near], positions=positions)


def _check_speeds(robot: RobotModel, velocities: FloatArray, command: FloatArray) -> None:
    wild = ~(np.abs(velocities) < _WILD)
    if wild.any():
        joint = int(np.argmax(wild))
        raise TrajectoryError(
            f"the arms cannot follow the plan: joint '{robot.joint_names[joint]}' would move at "
            f'{velocities[joint]:.4g} to get to {command[joint]:.4g}, and no arm at {_WILD:g} '
            '(rad/s or m/s); plan slower motions'
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Tips:
    """Fingertips near the table.

    Attributes:
        heights: (P,) heights of the fingertips over the table [m].
        jacobians: (P, 3, J) derivatives of the fingertips' positions by the joints.
        positions: (J,) joint positions of both [rad or m].
    """

    heights: FloatArray
    jacobians: FloatArray
    positions: FloatArray

    def forces(
        self, positions: FloatArray, velocities: FloatArray, step_s: float
    ) -> tuple[FloatArray, FloatArray] | None:
        """Return what the table does to joints: (J,) now, and (J, J) of an acceleration then.

        None where nothing touches it.
        """
        up = self.jacobians[:, 2]
        depths = -(self.heights + up @ (positions - self.positions))
        sinks = -(up @ velocities)
        touching = depths + step_s * sinks > 0
        if not touching.any():
            return None
        up, depths, sinks = up[touching], depths[touching], sinks[touching]
        stiffness, damping = TABLE_STIFFNESS_N_M, TABLE_DAMPING_N_S_M
        push = np.maximum(stiffness * (depths + step_s / 2 * sinks) + damping * sinks, 0.0)
        forces = up.T @ push
        resists = (stiffness * step_s**2 / 4 + damping * step_s / 2) * up.T @ up
        for along, depth in zip(self.jacobians[touching, :2], depths, strict=True):
            slip = along @ velocities
            speed = max(float(np.hypot(*slip)), VISCOUS_SPEED_M_S)
            rubs = TABLE_FRICTION * stiffness * max(depth, 0.0) / speed
            forces = forces - rubs * along.T @ slip
            resists = resists + rubs * step_s / 2 * along.T @ along
        return forces, resists
