"""Rigid bodies of DART as a world that is commanded period by period.

Shape letters: T periods, N steps of the engine, O solids, J joints, D degrees of
freedom, F fingers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from mtv_world_ros.bench.dart.rigid_bodies import Arms, RigidBodies
from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import SimulatorError
from mtv_world_ros.foresight.arm_response import ArmResponse, ArmState, PERIOD_S
from mtv_world_ros.foresight.contact_settings import ContactSettings
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.geometry.solids import Solid

#: steps of the engine in a period of commands
_SUBSTEPS = 5
STEP_S = PERIOD_S / _SUBSTEPS
#: periods for which everything is still before arms only pass by
_STILL_PERIODS = 5


class SteppedWorld:
    """A table, a robot and O solids; J joints.

    Args:
        robot: from a URDF with inertias.
        response: how its joints follow; all have a compliance.
        settings: of contact.
        solids: O, on the table.
        masses: (O,) [kg].
        home: (J,) where the joints rest at first [rad or m].

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
        self._swings: FloatArray | None = None
        self._still = 0

    @property
    def joints(self) -> FloatArray:
        """(J,) where the joints are [rad or m]."""
        return self._bodies.arms.joints

    @property
    def poses(self) -> FloatArray:
        """T_base_solid (O, 4, 4) [m]."""
        return self._bodies.poses()

    def advance(self, command: FloatArray) -> None:
        """Goes on by one period of commands, towards joints (J,).

        Raises:
            SimulatorError: the engine has lost something.
            TrajectoryError: the arms run away from the commands.
        """
        arms, before = self._bodies.arms, self._free
        rows = np.stack([before.commands, command])
        where, self._free = self._response.follow(self._robot, rows, before)
        # of the degrees of freedom, which offsets do not change
        speeds = arms.ways(np.stack([before.velocities, self._free.velocities]))
        speeds -= arms.ways(np.zeros((1, len(command))))
        course, _, self._swings = course_of(arms, where, speeds[0], self._swings, speeds[1])
        self._still = run_period(self._bodies, course, 0, self._still)
        if self._bodies.is_lost:
            raise SimulatorError('the engine dart has lost an object (--physics dart)')


@dataclass(frozen=True, slots=True)
class Course:
    """What arms are to do, at steps of the engine.

    Attributes:
        ways: (1 + N, D) of drives.
        velocities: (1 + N, D) likewise.
        forces: (N, D) that move them so.
        free: (1 + N, D) where all is if nothing is touched; fingers swing.
        fast: (1 + N, D) velocities there.
    """

    ways: FloatArray
    velocities: FloatArray
    forces: FloatArray
    free: FloatArray
    fast: FloatArray


def course_of(
    arms: Arms,
    where: FloatArray,
    speeds: FloatArray | None = None,
    swings: FloatArray | None = None,
    last: FloatArray | None = None,
) -> tuple[Course, FloatArray, FloatArray]:
    """Returns what arms are to do; speeds (D,) and swings (2, F) after it.

    Args:
        arms: any.
        where: (1 + T, J) their joints are, `PERIOD_S` apart [rad or m].
        speeds: (D,) at first; None = at rest.
        swings: (2, F) of the fingers at first: off their ways, and how fast; None = none.
        last: (D,) speeds at last; None = as the way there goes on.
    """
    fingers = arms.fingers
    ways, velocities, forces, pulls = _driven(arms, where, _SUBSTEPS, speeds, last)
    start = np.zeros((2, len(fingers))) if swings is None else swings
    off, then = arms.finger_drives.swings(pulls, ways[:, fingers], STEP_S, start)
    free, fast = ways.copy(), velocities.copy()
    free[:, fingers] += off
    fast[:, fingers] += np.concatenate([start[1:], np.diff(off, axis=0) / STEP_S])
    return Course(ways, velocities, forces, free, fast), velocities[-1], then


def _driven(
    arms: Arms,
    where: FloatArray,
    substeps: int,
    speeds: FloatArray | None = None,
    last: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Returns what moves arms in free air, at N = T * `substeps` steps of the engine.

    Args:
        arms: any.
        where: (1 + T, J) their joints are, `PERIOD_S` apart [rad or m].
        substeps: of a period.
        speeds: (D,) at first; None = at rest.
        last: (D,) likewise at last; None = as the way there goes on.

    Returns:
        Ways (1 + N, D) of drives, velocities (1 + N, D), forces (N, D), and those with which hands
        pull their fingers (N, F).
    """
    coarse, step_s = arms.ways(where), PERIOD_S / substeps
    times = np.arange(len(coarse)) * PERIOD_S
    first = np.zeros(coarse.shape[1]) if speeds is None else speeds
    end = 'not-a-knot' if last is None else (1, last)
    curve = CubicSpline(times, coarse, bc_type=((1, first), end))  # type: ignore[arg-type]
    ways = curve(np.arange((len(coarse) - 1) * substeps + 1) * step_s)
    velocities = np.concatenate([first[None], np.diff(ways, axis=0) / step_s])
    share = np.arange(substeps)[:, None] / substeps

    def between(rows: FloatArray) -> FloatArray:
        mixed = rows[:-1, None] * (1 - share) + rows[1:, None] * share
        return mixed.reshape(-1, rows.shape[1])

    forces, pulls = arms.carried(coarse, curve(times, 1), curve(times, 2))
    return ways, velocities, between(forces), between(pulls)


def run_period(bodies: RigidBodies, course: Course, first: int, still: int) -> int:
    """Goes on by one period of commands; returns for how many periods no solid has moved.

    Args:
        bodies: are moved.
        course: what arms do.
        first: step of the course at which the period begins.
        still: for how many periods no solid has moved before.
    """
    last = first + _SUBSTEPS
    still = still + 1 if bodies.is_at_rest else 0
    is_free = still > _STILL_PERIODS and bodies.arms.is_on(course.free[first], course.fast[first])
    if not (is_free and bodies.passes(course.free[last], course.fast[last])):
        before = bodies.state
        bodies.notice_touch()
        _step(bodies, course, first, last)
        if bodies.is_lost:  # cones are solved by an iteration, which may diverge
            bodies.state = before
            bodies.solve_friction(as_cone=False)
            _step(bodies, course, first, last)
    return still


def _step(bodies: RigidBodies, course: Course, first: int, last: int) -> None:
    """Goes on from one step of a course to another."""
    for step in range(first, last):
        forces = course.forces[step], course.ways[step], course.velocities[step]
        bodies.step(bodies.arms.forces(*forces))
