"""How arms follow their commands: they lag, overshoot, and cut off what is too quick for them.

Each joint is driven towards its command like a mass on a damped spring, and feels the others
through the arm's inertia. Scaled by the spring's stiffness k (J,), with the mass matrix M (J, J)
and the bias forces b (J,) of the robot's description at positions q:

    (M q'' + b) / k + armature q'' = command + lead command' - q - damping q'

The numbers are found in recordings (`training/object_motion/response_fit.py`), so gains need not
be known; a robot described without inertias has M = 0, and its joints respond each for itself.
What arms do when they touch something nobody can say ahead.

Shape letters: T steps, J joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.geometry.robot import RobotModel

#: after which the inertia is computed again [s]
PERIOD_S = 0.02
#: integration steps in it
_SUBSTEPS = 2
#: of each joint
NUMBERS = ('compliance', 'armature', 'damping', 'lead')


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmState:
    """Where the joints are, how fast, and what was commanded; all (J,)."""

    positions: FloatArray
    velocities: FloatArray
    commands: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmResponse:
    """See the module.

    Attributes:
        joint_names: J, of the robot.
        compliance: (J,) 1 / k [rad / N m].
        armature: (J,) [s^2].
        damping: (J,) [s].
        lead: (J,) [s].

    Raises:
        ValueError: a number is not finite, or below 0.
    """

    joint_names: tuple[str, ...]
    compliance: FloatArray
    armature: FloatArray
    damping: FloatArray
    lead: FloatArray

    def __post_init__(self) -> None:
        for name in NUMBERS:
            values = getattr(self, name)
            if not (np.isfinite(values) & (values >= 0)).all():
                raise ValueError(f'{name} is {values.tolist()}; give finite numbers from 0 on')

    @classmethod
    def from_json(
        cls, values: Mapping[str, Mapping[str, float]], joint_names: Sequence[str]
    ) -> ArmResponse:
        """Returns what `as_json` gave, of a robot with these joints.

        Raises:
            KeyError: a joint or number is missing.
            TypeError, ValueError: a value is no finite number from 0 on.
        """
        rows = {name: [float(values[joint][name]) for joint in joint_names] for name in NUMBERS}
        arrays = {name: np.array(row) for name, row in rows.items()}
        return cls(joint_names=tuple(joint_names), **arrays)

    def as_json(self) -> dict[str, dict[str, float]]:
        """Returns the numbers by joint."""
        return {
            joint: {name: float(getattr(self, name)[column]) for name in NUMBERS}
            for column, joint in enumerate(self.joint_names)
        }

    def follow(
        self,
        robot: RobotModel,
        commands: FloatArray,
        step_s: float = PERIOD_S,
        state: ArmState | None = None,
    ) -> tuple[FloatArray, ArmState]:
        """Returns where the joints are (T, J) at commands (T, J), and then.

        Args:
            robot: gives the inertia.
            commands: in its joint order; the first row is where `state` is, or where the joints
                rest.
            step_s: between two rows, a multiple of `PERIOD_S`.
            state: at the first row.
        """
        now = state or ArmState(
            positions=commands[0], velocities=np.zeros(commands.shape[1]), commands=commands[0]
        )
        positions, velocities, last = now.positions, now.velocities, now.commands
        rows, every, h = [positions], round(step_s / PERIOD_S), PERIOD_S / _SUBSTEPS
        for number, command in enumerate(_between(commands, every)[1:], 1):
            mass, bias = robot.dynamics(positions, velocities)
            driven = self.compliance[:, None] * mass + np.diag(self.armature)
            solve = np.linalg.inv(driven + np.diag(h / 2 * self.damping + h * h / 4))
            drive = command + self.lead * (command - last) / PERIOD_S - self.compliance * bias
            for _ in range(_SUBSTEPS):  # implicit midpoint
                force = drive - positions - (h / 2 + self.damping) * velocities
                acceleration = solve @ force
                positions = positions + h * velocities + h * h / 2 * acceleration
                velocities = velocities + h * acceleration
            last = command
            if number % every == 0:
                rows.append(positions)
        then = ArmState(positions=positions, velocities=velocities, commands=last)
        return np.stack(rows), then


def _between(commands: FloatArray, every: int) -> FloatArray:
    """Cubics through the rows, with `every` times as many steps."""
    if every == 1 or len(commands) == 1:
        return commands
    rows = np.arange(len(commands), dtype=float)
    cubic = CubicHermiteSpline(rows, commands, np.gradient(commands, axis=0))
    return cubic(np.arange(every * (len(commands) - 1) + 1) / every)
