"""Motions of objects as rigid bodies: what a robot's commands do to the solids that masks show.

No network is trained here: shapes are those of the masks, arms follow as `ArmResponse` found, and
friction, weight and the grip of fingers are numbers that were found in recordings and that a
checkpoint states (`contact.json`). So a kind of mistake that no training had is no stranger than
another. Several motions begin with places, sizes, friction, weight and grip within the error of
these.

Shape letters: K motions, T steps, O objects, J joints, D degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from mtv_world_ros.bench.dart.rigid_bodies import Arms, BodyState, RigidBodies
from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import RobotError
from mtv_world_ros.foresight.arm_response import ArmResponse, ArmState, PERIOD_S
from mtv_world_ros.foresight.contact_settings import ContactSettings
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.geometry.solids import Solid

#: steps of the engine in a period of commands
_SUBSTEPS = 5
STEP_S = PERIOD_S / _SUBSTEPS
#: periods for which everything is still before arms only pass by
_STILL_PERIODS = 5
#: standard deviations: of places [m], turns [rad]; relative: sizes, friction, weight, stiffness
_PLACE_M, _TURN_RAD = 0.001, 0.02
_SIZE, _FRICTION, _WEIGHT, _STIFFNESS = 0.015, 0.2, 0.3, 0.2
#: what is found as near to the table stands on it [m]
_STANDS_M = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyMotions:
    """Where everything is; row 0 is now.

    Attributes:
        points: (K, T + 1, O, 3) centres [m], NaN = not seen by two views.
        rotations: (K, T + 1, O, 3, 3) since they were found.
        joints: (K, T + 1, J) of the robot, which what it touches may stop [rad or m].
    """

    points: FloatArray
    rotations: FloatArray
    joints: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactMotions:
    """Solids on their way; what one chunk hands to the next.

    Attributes:
        settings: of contact.
        response: how the arms follow; what its floor stops, the table stops here.
        solids: O, as found; None = not seen by two views.
        states: K, of all bodies; empty = nothing has moved yet.
        arms: where the arms would be by now if nothing were touched.
        speeds: K of (D,), of these arms, in the engine's order.
        swings: (2, K, F) how far fingers swing off their ways then, and how fast; see
            `FingerDrives`.
        pose: (J,) near which the arms work, that of the first command.
    """

    settings: ContactSettings
    response: ArmResponse
    solids: tuple[Solid | None, ...]
    states: tuple[BodyState, ...] = ()
    arms: ArmState | None = None
    speeds: tuple[FloatArray, ...] = ()
    swings: FloatArray | None = None
    pose: FloatArray | None = None

    def advance(
        self, robot: RobotModel, positions: FloatArray, rows: int
    ) -> tuple[BodyMotions, ContactMotions]:
        """Returns where everything is at each of 1 + T rows, and then.

        Args:
            robot: whose joints are commanded.
            positions: (1 + N, J) commands, `PERIOD_S` apart [rad or m].
            rows: periods between two of the rows that are returned.

        Raises:
            RobotError: see `check_robot`.
        """
        free = replace(self.response, floor=None)
        where, arms = free.follow(robot, positions, self.arms)
        begun = self if self.pose is not None else replace(self, pose=positions[0])
        moved = [begun._moved(robot, where, rows, k) for k in range(self.settings.num_motions)]
        then = replace(
            begun,
            states=tuple(one.state for one in moved),
            arms=arms,
            speeds=tuple(one.speeds for one in moved),
            swings=np.stack([one.swings for one in moved], axis=1),
        )
        motions = BodyMotions(
            points=self._of_all(np.stack([one.points for one in moved]), np.nan),
            rotations=self._of_all(np.stack([one.rotations for one in moved]), np.eye(3)),
            joints=np.stack([one.joints for one in moved]),
        )
        return motions, then

    @property
    def centres(self) -> FloatArray:
        """(O, 3) where the solids were found [m], NaN = not seen by two views."""
        unknown = np.full(3, np.nan)
        centres = [unknown if one is None else one.centre for one in self.solids]
        return np.array(centres).reshape(-1, 3)

    @property
    def sizes(self) -> FloatArray:
        """(K, O, 3) extents of the solids [m]."""
        found = [self._disturbed(number)[1] for number in range(self.settings.num_motions)]
        sizes = np.array([[solid.size for solid in solids] for solids in found])
        return self._of_all(sizes.reshape(len(found), 1, -1, 3), np.nan)[:, 0]

    def _of_all(self, found: FloatArray, unknown: FloatArray | float) -> FloatArray:
        """Gives what was found of solids (K, T, S, ...) to all objects (K, T, O, ...)."""
        known = [number for number, solid in enumerate(self.solids) if solid is not None]
        shape = (*found.shape[:2], len(self.solids), *found.shape[3:])
        filled = np.broadcast_to(unknown, shape).copy()
        filled[:, :, known] = found
        return filled

    def _moved(self, robot: RobotModel, where: FloatArray, rows: int, number: int) -> _Moved:
        """One of the K motions, of arms whose joints are at (1 + N, J)."""
        settings, solids = self._disturbed(number)
        bodies = RigidBodies(robot, self.response, solids, settings, STEP_S, self.pose)
        begin = None if self.swings is None else self.swings[:, number]
        first = self.speeds[number] if self.speeds else None
        course, speeds, swings = course_of(bodies.arms, where, first, begin)
        found = bodies.poses()[:, :3, :3]
        if self.states:
            bodies.state = self.states[number]
        else:
            bodies.arms.skeleton.setPositions(course.free[0])
        poses, joints = _run(bodies, course, rows)
        return _Moved(
            points=poses[..., :3, 3],
            rotations=poses[..., :3, :3] @ np.swapaxes(found, -1, -2),
            joints=joints,
            state=bodies.state,
            speeds=speeds,
            swings=swings,
        )

    def _disturbed(self, number: int) -> tuple[ContactSettings, list[Solid]]:
        """Settings and solids of a motion; those of the first are as they are.

        Finger tips are hard in every other one: neither hard nor soft ones are right alone.
        """
        rng, share = np.random.default_rng((2, number)), float(number > 0)
        settings = self.settings

        def scaled(deviation: float) -> float:
            return float(np.exp(share * deviation * rng.normal()))

        changed = settings.model_copy(
            update={
                'grip_friction': settings.grip_friction * scaled(_FRICTION),
                'table_friction': settings.table_friction * scaled(_FRICTION),
                'finger_stiffness': settings.finger_stiffness * scaled(_STIFFNESS),
                'density': settings.density * scaled(_WEIGHT),
                'tray_kg': settings.tray_kg * scaled(_WEIGHT),
                'pad_stiffness': settings.pad_stiffness if number % 2 == 0 else None,
            }
        )
        return changed, [
            _disturbed(solid, settings.table_m, share, rng)
            for solid in self.solids
            if solid is not None
        ]


def check_robot(settings: ContactSettings, robot: RobotModel, response: ArmResponse) -> None:
    """Checks that contact of a robot can be computed.

    Raises:
        RobotError: joints have no compliance, or see `RigidBodies`.
    """
    if not (response.compliance > 0).all():
        raise RobotError(
            f"the joints of robot '{robot.name}' were found without inertias of its URDF; "
            'contact cannot be computed'
        )
    RigidBodies(robot, response, (), settings, STEP_S)


def _disturbed(solid: Solid, table: float, share: float, rng: np.random.Generator) -> Solid:
    """A solid a little elsewhere, of a little other size; what stands on the table still does."""
    noise = share * rng.normal(size=5)
    wide, long, high = solid.size * np.exp(_SIZE * noise[[0, 0, 1]])
    x, y = solid.centre[:2] + _PLACE_M * noise[2:4]
    bottom = solid.centre[2] - solid.size[2] / 2
    if abs(bottom - table) < _STANDS_M:
        bottom = table
    return replace(
        solid,
        centre=np.array([x, y, bottom + high / 2]),
        size=np.array([wide, wide if solid.is_round else long, high]),
        yaw=solid.yaw + _TURN_RAD * float(noise[4]),
    )


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


@dataclass(frozen=True, slots=True)
class _Moved:
    """One motion of S solids, and what the next chunk goes on from.

    Attributes:
        points: (T + 1, S, 3) [m].
        rotations: (T + 1, S, 3, 3) since they were found.
        joints: (T + 1, J) [rad or m].
        state: of all bodies.
        speeds: (D,) of the arms if nothing were touched.
        swings: (2, F), see `ContactMotions`.
    """

    points: FloatArray
    rotations: FloatArray
    joints: FloatArray
    state: BodyState
    speeds: FloatArray
    swings: FloatArray


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
        swings: (2, F) of the fingers at first, see `ContactMotions`; None = none.
        last: (D,) speeds at last; None = as the way there goes on.
    """
    fingers = arms.fingers
    ways, velocities, forces, pulls = driven(arms, where, _SUBSTEPS, speeds, last)
    start = np.zeros((2, len(fingers))) if swings is None else swings
    off, then = arms.finger_drives.swings(pulls, ways[:, fingers], STEP_S, start)
    free, fast = ways.copy(), velocities.copy()
    free[:, fingers] += off
    fast[:, fingers] += np.concatenate([start[1:], np.diff(off, axis=0) / STEP_S])
    return Course(ways, velocities, forces, free, fast), velocities[-1], then


def driven(
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


def _run(bodies: RigidBodies, course: Course, every: int) -> tuple[FloatArray, FloatArray]:
    """Poses (T + 1, S, 4, 4) of the solids and joints (T + 1, J), as the arms are driven.

    Where nothing is touched and nothing moves, the arms pass by without any dynamics: in free air
    they are on their way by definition.
    """
    poses, joints = [bodies.poses()], [bodies.arms.joints]
    state, still = bodies.state, 0
    for period, first in enumerate(range(0, len(course.forces), _SUBSTEPS), 1):
        still = run_period(bodies, course, first, still)
        if period % every == 0:
            poses.append(bodies.poses())
            if np.isfinite(poses[-1]).all():
                state = bodies.state
            else:  # the engine has lost them: they go on from where they were last
                bodies.state, poses[-1] = state, poses[-2]
            joints.append(bodies.arms.joints)
    return np.stack(poses), np.stack(joints)


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
