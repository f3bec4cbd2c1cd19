"""Many futures of a scene, computed side by side on all cores.

Shape letters: K futures, T rows, O solids, D degrees of freedom of the arms, J joints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
import logging
import time
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import RolloutPreempted
from mtv_world_ros.physics.arms.arm_response import PERIOD_S
from mtv_world_ros.physics.arms.arms import Arms, SOLIDS
from mtv_world_ros.physics.engine.contact_scene import CompiledScene, kind_of, STEP_S
from mtv_world_ros.physics.engine.drive_inputs import (
    ArmsState,
    CoursePlanner,
    FreeMotion,
    FULL,
    SUBSTEPS,
)
from mtv_world_ros.physics.engine.futures import Future
from mtv_world_ros.physics.grips import FingerState, Grip, GripCourse
from mtv_world_ros.physics.mujoco_import import mujoco, Rollout


@dataclass(frozen=True, slots=True)
class SleepSettings:
    """Thresholds below which solids and arms are put to sleep.

    Attributes:
        max_angular_speed_rad_s: a slower solid is at rest.
        max_linear_speed_m_s: a slower solid is at rest.
        tracking_tolerance: largest distance of a joint from its free motion [rad or m].
        tracking_speed_tolerance: largest difference of its speed [rad/s or m/s].
        num_still_rows: rows without motion before arms only pass by.
    """

    max_angular_speed_rad_s: float = 0.02
    max_linear_speed_m_s: float = 0.002
    tracking_tolerance: float = 1e-3
    tracking_speed_tolerance: float = 0.02
    num_still_rows: int = 1


@dataclass(frozen=True, slots=True)
class DivergenceLimits:
    """Values beyond which the simulation of a future is treated as diverged.

    Attributes:
        max_distance_m: distance of an object from the origin.
        max_linear_speed_m_s: speed of an object.
        max_angular_speed_rad_s: angular speed of an object.
        overlapping_constraints: constraints of objects that cannot all be where they were found.
        max_mean_constraints: mean number of constraints of a future over a plan.
    """

    max_distance_m: float = 3.0
    max_linear_speed_m_s: float = 20.0
    max_angular_speed_rad_s: float = 1000.0
    overlapping_constraints: int = 1500
    max_mean_constraints: int = 400


_SLEEP = SleepSettings()
_LIMITS = DivergenceLimits()
#: distance at which contact between an arm and a solid is simulated [m]
CONTACT_RANGE_M = 0.015
#: distance at which contact between a finger and the table is simulated [m]
TABLE_CONTACT_RANGE_M = 0.002
#: depth to which contact lets an arm reach into a solid; a start at which it is deeper in
#: contradicts itself, as fingers gave way or cameras are off [m]
MAX_CONTACT_DEPTH_M = 0.005
#: wall-clock limit of one plan: SLOWDOWN_LIMIT times its duration plus EXTRA_S; a safeguard only,
#: because wall time depends on the load of the machine
SLOWDOWN_LIMIT = 20.0
EXTRA_S = 60.0
#: constraints (three a contact) from which a step is slow, so that it is computed in pieces whose
#: work is counted
CROWDED_CONSTRAINTS = 300

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchState:
    """State of K futures, between two parts of a plan.

    Attributes:
        physics: (K, N) MuJoCo's full physics states.
        arms: state of the arms in free space, as if they had touched nothing.
        last: motion before this part of the plan; None = the arms were at rest.
        still: (K,) number of rows in which all solids have been at rest.
        lost: reasons why futures were dropped, by number of the future.
        grips: grip of each solid that measured fingers hold (`ContactSettings.grips_hold`), by
            number of the solid, for each future.
        fingers: measured motion of the fingers until now; None = not known.
        stops: stops of the measured fingers until now; None = none were looked for.
        passed: solids that arms pass through in each future, until they are apart: what measured
            fingers hold or held, and what they reached into at the start while they held
            something; empty = none are looked for.
    """

    physics: FloatArray
    arms: ArmsState
    still: np.ndarray
    last: FreeMotion | None = None
    lost: dict[int, str] = field(default_factory=dict)
    grips: tuple[dict[int, Grip], ...] = ()
    fingers: FingerState | None = None
    stops: StopState | None = None
    passed: tuple[frozenset[int], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class StopState:
    """Stops of measured fingers in K futures until now.

    Attributes:
        is_stopped: (A,) whether something stops the fingers now.
        count: (A,) number of stops until now.
        holds: (K, A) whether the fingers hold what is between them, in the last stop.
        weights: (K,) likelihood of the stops where the solids of a future are.
    """

    is_stopped: np.ndarray
    count: np.ndarray
    holds: np.ndarray
    weights: FloatArray

    @classmethod
    def begin(cls, num_futures: int, num_arms: int) -> StopState:
        """Return the state before the first stop."""
        return cls(
            is_stopped=np.zeros(num_arms, np.bool_),
            count=np.zeros(num_arms, np.int64),
            holds=np.ones((num_futures, num_arms), np.bool_),
            weights=np.ones(num_futures),
        )

    def copy(self) -> StopState:
        """Return a state that can be changed."""
        return StopState(
            is_stopped=self.is_stopped.copy(),
            count=self.count.copy(),
            holds=self.holds.copy(),
            weights=self.weights.copy(),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchMotion:
    """Motion of K futures; row 0 is their start.

    Attributes:
        points: (K, T + 1, O, 3) centres of the solids [m].
        rotations: (K, T + 1, O, 3, 3) rotation matrices of the solids.
        joints: (K, T + 1, J) joints of the robot, which contact may stop [rad or m].
        steps: steps of the engine that were computed, of all futures together.
    """

    points: FloatArray
    rotations: FloatArray
    joints: FloatArray
    steps: int


def _log_once(message: str) -> None:
    """Log each warning of the engine once; by default they fill a file and the terminal."""
    kind = message.split(' Time =')[0]
    if kind not in _told:
        _told.add(kind)
        logger.warning('MuJoCo, of a foreseen future: %s', kind)


#: warnings that were logged
_told: set[str] = set()


class Engine:
    """Computes futures of a robot and solids; holds compiled scenes and threads.

    Args:
        arms: arms of the robot.
        threads: number of computing threads.
    """

    def __init__(self, arms: Arms, threads: int = 1) -> None:
        self.arms, self.threads = arms, max(threads, 1)
        self._scenes: dict[tuple[str, ...], tuple[CompiledScene, list[Any]]] = {}
        mujoco.set_mju_user_warning(_log_once)
        self._rollout = Rollout(nthread=0 if threads < 2 else threads)

    def scene_of(self, kinds: Sequence[str]) -> tuple[CompiledScene, list[Any]]:
        """Return the compiled scene for solids of these kinds, and MuJoCo data for each thread."""
        key = tuple(kinds)
        if key not in self._scenes:
            if len(self._scenes) >= 8:
                self._scenes.pop(next(iter(self._scenes)))
            scene = CompiledScene.compiled(self.arms, kinds)
            self._scenes[key] = scene, [mujoco.MjData(scene.model) for _ in range(self.threads)]
        return self._scenes[key]

    def begin(self, futures: Sequence[Future]) -> Batch:
        """Return the batch that simulates these futures; their solids are of the same kinds."""
        return Batch(self, futures)

    def run(
        self,
        models: list[Any],
        data: list[Any],
        states: FloatArray,
        controls: FloatArray,
        found: FloatArray,
    ) -> None:
        """Simulate K models for S steps from states (K, N).

        Args:
            models: K models of one scene.
            data: MuJoCo data for each thread.
            states: (K, N) full physics states.
            controls: (K, S, D) set points of the drives [rad or m].
            found: (K, S, N) contiguous, takes the states after each step.
        """
        states = np.ascontiguousarray(states)
        controls = np.ascontiguousarray(controls)
        # the checks of shapes take longer than a few steps of the engine
        self._rollout.rollout(
            models,
            data,
            states,
            controls,
            skip_checks=True,
            nstep=controls.shape[1],
            state=found,
            chunk_size=1 if self.threads > 1 else None,
        )


class Batch:
    """K futures of the same robot and kinds of solids.

    Args:
        engine: engine that computes them.
        futures: K.

    Attributes:
        futures: K.
    """

    def __init__(self, engine: Engine, futures: Sequence[Future]) -> None:
        self._engine, self.futures = engine, tuple(futures)
        first = futures[0]
        kinds = tuple(map(kind_of, first.solids))
        self._scene, self._data = engine.scene_of(kinds)
        self._models = [
            self._scene.model_of(future.settings, future.solids, self._data[0])
            for future in futures
        ]
        free, _ = engine.scene_of(())
        self._planner = CoursePlanner(free, first.settings)
        #: solids that arms pass through in the model of each future
        self._lets_pass = [frozenset[int]() for _ in futures]
        self._nearby = _Nearby(self._scene, self._models[0])
        self._constraint_bound = _ConstraintBound(self._models[0])
        self._delays = [round(future.delay_s / STEP_S) for future in futures]
        self._gains = np.stack([model.actuator_gainprm[:, 0] for model in self._models])

    @property
    def model(self) -> Any:
        """MuJoCo's model of the first future."""
        return self._models[0]

    def touches_arms(self, positions: FloatArray) -> bool:
        """Return True if arms at joint positions (J,) are near a solid, or hold one."""
        at = self._scene.arms.drives.spread(positions)
        return not self._nearby.is_clear(
            self._scene.positions(at, self.futures[0].solids), at[None]
        )

    def start(self, positions: FloatArray, fingers: FingerState | None = None) -> BatchState:
        """Return the start of the futures, with the robot at rest at joints (J,).

        Args:
            positions: joint positions [rad or m].
            fingers: measured motion of the fingers before; None = not known.
        """
        scene, model = self._scene, self._models[0]
        at = scene.arms.drives.spread(positions)
        physics = np.zeros((len(self.futures), mujoco.mj_stateSize(model, FULL)))
        for row, future in zip(physics, self.futures, strict=True):
            row[1 : 1 + model.nq] = scene.positions(at + future.zeros, future.solids)
        return BatchState(
            physics=physics,
            arms=self._planner.begin(positions),
            still=np.full(len(physics), _SLEEP.num_still_rows),
            fingers=fingers,
        )

    def advance(
        self,
        commands: FloatArray,
        every: int,
        state: BatchState | None = None,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> tuple[BatchMotion, BatchState]:
        """Return the motion at each `every`-th of commands, and the state after them.

        Args:
            commands: (1 + T * every, J), `PERIOD_S` apart [rad or m].
            every: periods between two rows.
            state: present states of the futures; None = their start.
            should_stop: asked after every row, and within one that takes long.

        Raises:
            RolloutPreempted: `should_stop` said so.
        """
        state = state or self.start(commands[0])
        course, arms = self._planner.plan(commands, state.arms)
        courses = [course.late(delay, state.last) for delay in self._delays]
        rows = (len(commands) - 1) // every
        run = _Run(self._scene, self.futures, courses, every * SUBSTEPS, state, self._gains)
        fingers = state.fingers
        if self.futures[0].settings.grips_hold:
            grips = GripCourse.of(
                self._scene.arms.robot,
                commands[: 1 + rows * every : every],
                every * PERIOD_S,
                fingers,
            )
            fingers = grips.fingers
            run.grip(grips)
            if not state.passed:
                run.passed = [self._reached_into(run, k) for k in range(len(self.futures))]
        cap_s = time.monotonic() + SLOWDOWN_LIMIT * rows * every * PERIOD_S + EXTRA_S

        def check() -> None:
            if should_stop():
                raise RolloutPreempted('stopped while objects were foreseen')
            if time.monotonic() > cap_s:
                run.lose_all('took too long')

        for row in range(rows):
            check()
            self._advance_row(run, row, check)
        return run.motion(), replace(
            state,
            physics=run.physics,
            arms=arms,
            last=course,
            still=run.still,
            lost=run.lost,
            grips=tuple(run.grips),
            fingers=fingers,
            stops=run.stops,
            passed=tuple(run.passed),
        )

    def _advance_row(self, run: _Run, row: int, check: Callable[[], None]) -> None:
        may_pass = run.may_pass(row)
        passing = [
            number in run.lost or (may_pass[number] and self._is_clear(run, number, row))
            for number in range(len(self.futures))
        ]
        moving = np.flatnonzero(~np.array(passing))
        for number in map(int, moving):
            self._let_pass(number, run.passed[number])
        if len(moving):
            self._compute_row(run, row, moving, check)
        run.finish_row(row, moving)
        for number, passed in enumerate(run.passed):
            held = frozenset(run.grips[number])
            left = passed - held
            if left and number not in run.lost:
                left &= self._depths(run, number).keys()
            run.passed[number] = held | left

    def _let_pass(self, number: int, solids: frozenset[int]) -> None:
        """Let arms pass through these solids in a future; all others are touched."""
        if self._lets_pass[number] != solids:
            self._scene.let_pass(self._models[number], solids)
            self._lets_pass[number] = solids

    def _reached_into(self, run: _Run, number: int) -> frozenset[int]:
        """Return the solids that arms hold, or reach into while they hold something.

        Free fingers that reach into a solid are about to grip it.
        """
        held = frozenset(run.grips[number])
        if not held:
            return held
        depths = self._depths(run, number)
        return held | {item for item, depth_m in depths.items() if depth_m > MAX_CONTACT_DEPTH_M}

    def _depths(self, run: _Run, number: int) -> dict[int, float]:
        """Return how far arms reach into the solids of a future [m], by number of the solid."""
        model, data = self._models[number], self._data[0]
        self._let_pass(number, frozenset())
        data.qpos[:] = run.qpos(number)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        depths: dict[int, float] = {}
        for geoms, distance in zip(data.contact.geom, data.contact.dist, strict=True):
            for solid, other in (geoms, geoms[::-1]):
                item = self._scene.solid_of(int(solid))
                if item is not None and model.geom_contype[other] > SOLIDS and distance < 0:
                    depths[item] = max(depths.get(item, 0.0), -float(distance))
        return depths

    def _compute_row(
        self, run: _Run, row: int, moving: np.ndarray, check: Callable[[], None]
    ) -> None:
        """Compute a row of some futures; those that are crowded in pieces, few at a time."""
        controls = run.controls[moving, run.steps_of(row)]
        crowded = np.zeros(len(moving), np.bool_)
        for place, number in enumerate(moving):
            check()  # of many futures of many parts the counting takes long itself
            crowded[place] = self._is_crowded(run, int(number))
        self._compute(run, moving[~crowded], controls[~crowded])
        few = self._engine.threads
        slow, goals = moving[crowded], controls[crowded]
        for first in range(0, len(slow), few):
            self._compute_crowded(
                run, slow[first : first + few], goals[first : first + few], check
            )

    def _compute_crowded(
        self, run: _Run, moving: np.ndarray, controls: FloatArray, check: Callable[[], None]
    ) -> None:
        """Compute a row in pieces of the same length on every machine, which the result shows.

        What counts as too much is a number of constraints, not a time: so the same is lost
        whatever else a machine does.
        """
        for first in range(0, controls.shape[1], SUBSTEPS):
            check()
            for number in moving:
                if number not in run.lost:
                    run.charge(int(number), self._constraints(run, number), SUBSTEPS)
            kept = np.array([number not in run.lost for number in moving])
            self._compute(run, moving[kept], controls[kept, first : first + SUBSTEPS])

    def _compute(self, run: _Run, moving: np.ndarray, controls: FloatArray) -> None:
        if not len(moving):
            return
        models = [self._models[number] for number in moving]
        found = run.found_states(len(moving), controls.shape[1])
        self._engine.run(models, self._data, run.physics[moving], controls, found)
        run.take(moving, found)

    def _constraints(self, run: _Run, number: int) -> int:
        """Return the number of constraints, of contacts most, where a future is.

        They make steps slow.
        """
        model, data = self._models[number], self._data[0]
        mujoco.mj_setState(model, data, run.physics[number], FULL)
        mujoco.mj_fwdPosition(model, data)
        return data.nefc

    def _is_crowded(self, run: _Run, number: int) -> bool:
        """Return True if there are more constraints than `CROWDED_CONSTRAINTS`."""
        bound = self._constraint_bound.of(self._models[number], self._data[0], run.qpos(number))
        return bound > CROWDED_CONSTRAINTS and self._constraints(run, number) > CROWDED_CONSTRAINTS

    def _is_clear(self, run: _Run, number: int, row: int) -> bool:
        """Return True if the arms pass by all solids in a row."""
        last = run.first_step(row + 1)
        steps = [*range(run.first_step(row), last, 2 * SUBSTEPS), last]
        where = run.courses[number].positions[steps] + run.zeros[number]
        return self._nearby.is_clear(run.qpos(number), where)


class _Run:
    """Futures while they advance by some rows."""

    def __init__(
        self,
        scene: CompiledScene,
        futures: Sequence[Future],
        courses: Sequence[FreeMotion],
        steps: int,
        state: BatchState,
        gains: FloatArray,
    ) -> None:
        self._scene, self._futures, self.courses, self._steps = scene, futures, courses, steps
        #: (K, D) offsets of the joint encoders [rad or m]
        self.zeros = np.stack([future.zeros for future in futures])
        #: (K, S, D) set points of the drives [rad or m]
        self.controls = np.stack(
            [
                course.controls + course.pushes / gain + zeros
                for course, gain, zeros in zip(courses, gains, self.zeros, strict=True)
            ]
        )
        #: (K, T + 1, D) free motion of the arms at each row
        self._planned = np.stack([course.positions[::steps] for course in courses])
        self._planned_speeds = np.stack([course.velocities[::steps] for course in courses])
        self.physics, self.still = state.physics.copy(), state.still.copy()
        self.lost, self.computed = dict(state.lost), 0
        self._spent = np.zeros(len(futures), np.int64)
        self.grips = list(state.grips) or [{} for _ in futures]
        self.passed = list(state.passed) or [frozenset[int]() for _ in futures]
        self._grip_course: GripCourse | None = None
        self.stops = None if state.stops is None else state.stops.copy()
        self._was_stopped = np.zeros(0, np.bool_)
        #: columns of a state: places, speeds and turn speeds of the solids
        at, dofs = 1 + scene.solid_qpos[:, None], 1 + scene.model.nq + scene.solid_dofs[:, None]
        self._places = (at + np.arange(3)).ravel()
        self._ways, self._turns = ((dofs + k + np.arange(3)).ravel() for k in (0, 3))
        self._arms = 1 + scene.arm_qpos
        self._arm_speeds = 1 + scene.model.nq + scene.arm_dofs
        #: states (K, N) at each row
        self._rows = [self.physics.copy()]
        self._found = np.empty(self.physics.size * steps)

    def grip(self, course: GripCourse) -> None:
        """Hold the solids that the measured fingers of a course hold from its first row on."""
        self._grip_course = course
        if self.stops is None:
            self.stops = StopState.begin(len(self._futures), len(course.openings))
        self._was_stopped = self.stops.is_stopped.copy()
        self._hold(0)
        self._rows = [self.physics.copy()]

    def _hold(self, row: int) -> None:
        """Move the solids that are held at a row with their grippers."""
        scene, course = self._scene, self._grip_course
        if course is None:
            return
        nq = scene.model.nq
        at = scene.solid_qpos[:, None] + np.arange(7)
        assert self.stops is not None
        begun = [
            arm
            for arm in range(len(course.openings))
            if course.begins(arm, row, self._was_stopped)
        ]
        self.stops.count[begun] += 1
        self.stops.is_stopped[:] = course.stopped[:, row]
        for number, future in enumerate(self._futures):
            if number in self.lost or not len(scene.solid_qpos):
                continue
            qpos, poses = self.qpos(number), np.tile(np.eye(4), (len(scene.solid_qpos), 1, 1))
            poses[:, :3, 3] = qpos[at[:, :3]]
            poses[:, :3, :3] = _matrices(qpos[at[:, 3:]])
            self._begin_stops(begun, number, row, poses)
            held, poses = course.after(
                row, self.grips[number], poses, future.solids, self._holds(number)
            )
            self.grips[number] = held
            for item in held:
                qpos[at[item]] = [*poses[item, :3, 3], *_quaternion(poses[item, :3, :3])]
                speeds = self.physics[number, 1 + nq :]
                speeds[scene.solid_dofs[item] + np.arange(6)] = 0.0

    def _begin_stops(self, arms: Sequence[int], number: int, row: int, poses: FloatArray) -> None:
        """Say whether stops that begin hold something, and how likely they are in a future."""
        course, stops, future = self._grip_course, self.stops, self._futures[number]
        assert course is not None and stops is not None
        for arm in arms:
            drawn = np.random.default_rng((5, number, arm, int(stops.count[arm]))).random()
            share = future.settings.stop_holds
            is_seen = row == 0 and any(solid.is_held for solid in future.solids)
            # in the first future all is as it is most likely
            stops.holds[number, arm] = is_seen or (drawn < share if number else share >= 0.5)
            if course.is_beside(arm, row, poses, future.solids):
                stops.weights[number] *= course.settings.contradiction

    def _holds(self, number: int) -> Callable[[int], bool]:
        assert self.stops is not None
        of_arms = self.stops.holds[number]
        return lambda arm: bool(of_arms[arm])

    def first_step(self, row: int) -> int:
        return row * self._steps

    def steps_of(self, row: int) -> slice:
        return slice(self.first_step(row), self.first_step(row + 1))

    def qpos(self, number: int) -> FloatArray:
        return self.physics[number, 1 : 1 + self._scene.model.nq]

    def may_pass(self, row: int) -> BoolArray:
        """Return (K,) True where all solids are at rest and the arms move as in free air."""
        off = self.physics[:, self._arms] - self.zeros - self._planned[:, row]
        speeds = self.physics[:, self._arm_speeds] - self._planned_speeds[:, row]
        return (
            (self.still >= _SLEEP.num_still_rows)
            & np.array([not held for held in self.grips])
            & (np.abs(off) < _SLEEP.tracking_tolerance).all(-1)
            & (np.abs(speeds) < _SLEEP.tracking_speed_tolerance).all(-1)
        )

    def found_states(self, count: int, steps: int) -> FloatArray:
        """Return an array (count, steps, N) for computed states, which the next call reuses."""
        size = count * steps * self.physics.shape[1]
        return self._found[:size].reshape(count, steps, -1)

    def take(self, moving: np.ndarray, states: FloatArray) -> None:
        """Take what was computed; futures that no object can have are lost."""
        self.computed += states.shape[0] * states.shape[1]
        last = states[:, -1]
        implausible = self._implausible(last)
        if implausible:
            self.lost |= {int(moving[place]): why for place, why in implausible.items()}
            kept = np.array([place not in implausible for place in range(len(moving))])
            moving, last = moving[kept], last[kept]
        self.physics[moving] = last

    def charge(self, number: int, constraints: int, steps: int) -> None:
        """Count what steps of a crowded future cost; it is lost where that is too much."""
        self._spent[number] += constraints * steps
        if constraints > _LIMITS.overlapping_constraints:
            self.lost[number] = 'objects overlap: more touches than things on a table can have'
        elif self._spent[number] > _LIMITS.max_mean_constraints * len(self.courses[0].controls):
            self.lost[number] = 'more touches, for longer, than can be foreseen in time'

    def lose_all(self, why: str) -> None:
        """Give up the futures that still count."""
        self.lost = dict.fromkeys(range(len(self.physics)), why) | self.lost

    def finish_row(self, row: int, moving: np.ndarray) -> None:
        """Move the arms of futures that were not computed, and keep where all is."""
        counts = np.array([number not in self.lost for number in range(len(self.physics))])
        moved = np.zeros(len(counts), np.bool_)
        moved[moving] = True
        passed = np.flatnonzero(counts & ~moved)
        at = self._planned[passed, row + 1] + self.zeros[passed]
        self.physics[passed[:, None], self._arms] = at
        self.physics[passed[:, None], self._arm_speeds] = self._planned_speeds[passed, row + 1]
        then = np.where(self._at_rest(self.physics), self.still + 1, 0)
        self.still = np.where(counts & moved, then, self.still)
        self._hold(row + 1)
        self._rows.append(self.physics.copy())

    def motion(self) -> BatchMotion:
        """Return the motion of all computed rows."""
        scene, drives = self._scene, self._scene.arms.drives
        qpos = np.stack(self._rows, 1)[..., 1 : 1 + scene.model.nq]
        at = scene.solid_qpos[:, None]
        driven = qpos[..., scene.arm_qpos] - self.zeros[:, None]
        return BatchMotion(
            points=qpos[..., at + np.arange(3)],
            rotations=_matrices(qpos[..., at + np.arange(3, 7)]),
            joints=drives.joints(driven, len(scene.arms.robot.joint_names)),
            steps=self.computed,
        )

    def _at_rest(self, physics: FloatArray) -> BoolArray:
        """Return (K,) True where all solids of states (K, N) are at rest."""
        return np.asarray(
            (np.abs(physics[:, self._ways]) < _SLEEP.max_linear_speed_m_s).all(-1)
            & (np.abs(physics[:, self._turns]) < _SLEEP.max_angular_speed_rad_s).all(-1)
        )

    def _implausible(self, physics: FloatArray) -> dict[int, str]:
        """Return the reason why each simulation diverged, by the row of states (K, N)."""
        left = (np.abs(physics[:, self._places]) > _LIMITS.max_distance_m).any(-1)
        fast = (np.abs(physics[:, self._ways]) > _LIMITS.max_linear_speed_m_s).any(-1)
        fast |= (np.abs(physics[:, self._turns]) > _LIMITS.max_angular_speed_rad_s).any(-1)
        checks = (
            (~np.isfinite(physics).all(-1), 'the engine diverged'),
            (left, 'an object left the table for good'),
            (fast, 'an object became faster than anything on a table'),
        )
        reasons: dict[int, str] = {}
        for is_bad, why in checks:
            for place in map(int, np.flatnonzero(is_bad)):
                reasons.setdefault(place, why)
        return reasons


class _ConstraintBound:
    """Upper bound of the number of constraints, from contacts alone.

    The constraints themselves are not computed, which would take three times as long.

    Args:
        model: model of a scene; those of its futures have the same numbers of parts.
    """

    def __init__(self, model: Any) -> None:
        self._each = int(model.geom_condim.max())
        # limits of joints at both ends, welds, dry friction
        self._fixed = 2 * model.njnt + 6 * model.neq + model.nv

    def of(self, model: Any, data: Any, qpos: FloatArray) -> int:
        """Return the bound for a future.

        Args:
            model: model of the future.
            data: MuJoCo data, which is written to.
            qpos: positions of the joints and the solids.
        """
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        return self._fixed + self._each * data.ncon


class _Nearby:
    """Test for contact range between arms and solids, and between fingers and the table."""

    def __init__(self, scene: CompiledScene, model: Any) -> None:
        self._scene, self._model = scene, model.__copy__()
        of_arms = self._model.geom_contype > SOLIDS
        of_solids = self._model.geom_contype == SOLIDS
        fingers = of_arms & (self._model.geom_priority > 0)
        self._model.geom_contype[:] = np.where(of_arms, 2, 0) + np.where(fingers, 4, 0)
        self._model.geom_conaffinity[:] = np.where(of_solids, 2, 0)
        # the table, where arms touch it
        self._model.geom_conaffinity[0] = 4 if model.geom_conaffinity[0] < 0 else 0
        self._model.geom_margin[of_solids], self._model.geom_margin[0] = (
            CONTACT_RANGE_M,
            TABLE_CONTACT_RANGE_M,
        )
        self._data = mujoco.MjData(self._model)

    def is_clear(self, qpos: FloatArray, arms: FloatArray) -> bool:
        """Return whether arms at (T, D) are clear of the solids at `qpos`."""
        model, data = self._model, self._data
        data.qpos[:] = qpos
        for positions in arms:
            data.qpos[self._scene.arm_qpos] = positions
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            if data.ncon:
                return False
        return True


def _quaternion(rotation: FloatArray) -> FloatArray:
    """Return the quaternion (4,), w first, of a rotation (3, 3)."""
    found = np.zeros(4)
    mujoco.mju_mat2Quat(found, np.ascontiguousarray(rotation).ravel())
    return found


def _matrices(quaternions: FloatArray) -> FloatArray:
    """Return (..., 3, 3) of quaternions (..., 4), w first."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))
