"""Rigid bodies of DART as a world that is commanded period by period.

Shape letters: N steps of the engine in a period, O solids, J joints, D degrees of freedom,
F fingers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.physics.arms.arm_response import ArmResponse, ArmState, PERIOD_S
from mtv_world_ros.physics.contact_settings import ContactSettings
from mtv_world_ros.physics.solids import Solid
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.simulation.dart.rigid_bodies import DrivenArms, RigidBodies

#: steps of the engine in a period of commands, N
_SUBSTEPS = 5
STEP_S = PERIOD_S / _SUBSTEPS
#: periods for which everything is still before arms only pass by
_STILL_PERIODS = 5


class SteppedWorld:
    """A table, a robot and O solids; J joints.

    Args:
        robot: robot from a URDF with inertias.
        response: response of the joints; all have a compliance.
        settings: settings of contact.
        solids: the O solids on the table.
        masses: (O,) masses of the objects [kg].
        home: (J,) initial rest positions of the joints [rad or m].

    Raises:
        RobotError: the robot cannot be a tree of rigid bodies.
    """

    def __init__(
        self,
        robot: RobotModel,
        response: ArmResponse,
        settings: ContactSettings,
        solids: Sequence[Solid],
        masses: Sequence[float],
        home: FloatArray,
    ) -> None:
        self._robot, self._response = robot, response
        self._bodies = RigidBodies(robot, response, solids, settings, STEP_S, home, masses)
        self._free = ArmState(positions=home, velocities=np.zeros(len(home)), commands=home)
        self._swings = np.zeros((2, len(self._bodies.arms.fingers)))
        self._num_still = 0  # periods for which no solid has moved

    @property
    def joints(self) -> FloatArray:
        """(J,) where the joints are [rad or m]."""
        return self._bodies.arms.joints

    @property
    def poses(self) -> FloatArray:
        """T_base_solid (O, 4, 4) [m]."""
        return self._bodies.poses()

    def advance(self, command: FloatArray) -> None:
        """Advance the world by one period of commands, towards joints (J,) [rad or m].

        Raises:
            SimulatorError: a position of an object or of an arm is not finite.
            TrajectoryError: the arms run away from the commands.
        """
        arms, before = self._bodies.arms, self._free
        rows = np.stack([before.commands, command])
        where, self._free = self._response.follow(self._robot, rows, before)
        # of the degrees of freedom, which offsets do not change
        speeds = arms.ways(np.stack([before.velocities, self._free.velocities]))
        speeds -= arms.ways(np.zeros((1, len(command))))
        course, self._swings = course_of(arms, where, speeds, self._swings)
        self._run(course)
        if self._bodies.is_lost:
            raise SimulatorError(
                'the engine dart has lost an object or an arm; choose another --physics'
            )

    def _run(self, course: DriveTargets) -> None:
        """Step the engine over a period, or moves arms that only pass by."""
        bodies = self._bodies
        self._num_still = self._num_still + 1 if bodies.is_at_rest else 0
        is_free = self._num_still > _STILL_PERIODS and bodies.arms.is_on(
            course.free[0], course.fast[0]
        )
        if is_free and bodies.passes(course.free[-1], course.fast[-1]):
            return
        before = bodies.state
        bodies.notice_touch()
        _step(bodies, course)
        if bodies.is_lost:  # cones are solved by an iteration, which may diverge
            bodies.state = before
            bodies.solve_friction(as_cone=False)
            _step(bodies, course)


@dataclass(frozen=True, slots=True)
class DriveTargets:
    """Set points of the arms in a period of commands, at the steps of the engine.

    Attributes:
        ways: (1 + N, D) commanded positions of the drives [rad or m].
        velocities: (1 + N, D) commanded velocities of the drives [rad/s or m/s].
        forces: (N, D) efforts that follow the commands without contact [N m or N].
        free: (1 + N, D) positions without contact, with the fingers' oscillation [rad or m].
        fast: (1 + N, D) velocities without contact [rad/s or m/s].
    """

    ways: FloatArray
    velocities: FloatArray
    forces: FloatArray
    free: FloatArray
    fast: FloatArray


def course_of(
    arms: DrivenArms, where: FloatArray, speeds: FloatArray, swings: FloatArray
) -> tuple[DriveTargets, FloatArray]:
    """Return the targets of the arms in a period, and the swings (2, F) of the fingers after it.

    Args:
        arms: arms of a world.
        where: (2, J) joints at the begin and the end of the period [rad or m].
        speeds: (2, D) velocities of the degrees of freedom there.
        swings: (2, F) distance of the fingers from their ways at the begin, and its rate.
    """
    fingers, times, ends = arms.fingers, np.arange(2) * PERIOD_S, arms.ways(where)
    curve = CubicSpline(times, ends, bc_type=((1, speeds[0]), (1, speeds[1])))  # type: ignore[arg-type]
    ways = curve(np.arange(_SUBSTEPS + 1) * STEP_S)
    velocities = np.concatenate([speeds[:1], np.diff(ways, axis=0) / STEP_S])
    share = np.arange(_SUBSTEPS)[:, None] / _SUBSTEPS
    forces, pulls = (
        rows[0] * (1 - share) + rows[1] * share
        for rows in arms.carried(ends, curve(times, 1), curve(times, 2))
    )
    off, then = arms.finger_drives.swings(pulls, ways[:, fingers], STEP_S, swings)
    free, fast = ways.copy(), velocities.copy()
    free[:, fingers] += off
    fast[:, fingers] += np.concatenate([swings[1:], np.diff(off, axis=0) / STEP_S])
    return DriveTargets(ways, velocities, forces, free, fast), then


def _step(bodies: RigidBodies, course: DriveTargets) -> None:
    """Step the engine through a course."""
    for forces, way, velocity in zip(
        course.forces, course.ways[:-1], course.velocities[:-1], strict=True
    ):
        bodies.step(bodies.arms.forces(forces, way, velocity))
