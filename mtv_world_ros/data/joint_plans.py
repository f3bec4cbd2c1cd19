"""Plans of joints: one reader of JointTrajectory messages for recordings and the live node."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import groupby, pairwise
from typing import Any

import numpy as np

from mtv_world_ros.core.bounded_input import check_limit, LimitError
from mtv_world_ros.core.data_types import FloatArray, JointTrajectory
from mtv_world_ros.core.errors import PlanError, PlanFault, TrajectoryError
from mtv_world_ros.data.episode import JointStates
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.resample import interpolated, resample, SAME_S

Plan = tuple[int, JointTrajectory]

NANO = 1_000_000_000
#: one-point plans that follow one another within this time are a stream of commands [s]
_STREAM_GAP_S = 0.5
_LEAST_STREAM = 3
#: measured positions are taken this often at most [s]
_PERIOD_S = 0.02
#: joints that no plan names have moved between two plans from this on [rad or m]
_MOVED = 1e-3


def read_plan(message: Any) -> JointTrajectory:
    """Return the trajectory of a message, of rclpy's or rosbags' class.

    Times count from the message's stamp. Velocities are kept where every point has them. Limits
    are not checked, as recorded commands are facts; before a plan is imagined they are
    (`Plan.of`).

    Raises:
        PlanError: empty, names repeated, points of the wrong length, NaN, times not increasing.
    """
    names, points = list(message.joint_names), message.points
    if not names or not len(points):
        raise PlanError(
            PlanFault.EMPTY,
            f'the trajectory has {len(names)} joint names and {len(points)} points; it needs at '
            'least one of each',
        )
    try:
        check_limit('joint_names', len(names), 'the trajectory')
        check_limit('trajectory_points', len(points), 'the trajectory')
    except LimitError as error:
        raise PlanError(PlanFault.MALFORMED, str(error)) from error
    repeated = sorted(name for name, count in Counter(names).items() if count > 1)
    if repeated:
        raise PlanError(PlanFault.NAMES, f'joint names {repeated} occur more than once')
    positions = _rows(names, points, 'positions')
    has_speeds = all(len(point.velocities) for point in points)
    velocities = _rows(names, points, 'velocities') if has_speeds else None
    after = [point.time_from_start for point in points]
    try:
        return JointTrajectory(
            joint_names=tuple(names),
            times=np.array([(one.sec * NANO + one.nanosec) / NANO for one in after]),
            positions=positions,
            velocities=velocities,
        )
    except TrajectoryError as error:
        raise PlanError(PlanFault.TIMES, str(error)) from error


def _rows(names: Sequence[str], points: Iterable[Any], field: str) -> FloatArray:
    """Return one field of all points, (T, J), checked."""
    rows = [getattr(point, field) for point in points]
    for index, row in enumerate(rows):
        if len(row) != len(names):
            raise PlanError(
                PlanFault.MALFORMED,
                f'point {index} has {len(row)} {field} for {len(names)} joints'
                if len(row)
                else f'point {index} has no {field}; velocities alone are not integrated',
            )
    values = np.array(rows, np.float64)
    if not np.isfinite(values).all():
        point, joint = np.argwhere(~np.isfinite(values))[0]
        raise PlanError(
            PlanFault.NOT_FINITE,
            f"joint '{names[joint]}' has {field} {values[point, joint]} at point {point}; every "
            'value must be finite',
        )
    return values


def trajectories_to(states: JointStates, chunk_s: float, start_ns: int) -> list[Plan]:
    """Return trajectories that reach measured positions at the stamps of their measurement.

    Args:
        states: positions over time.
        chunk_s: length of a trajectory [s].
        start_ns: start of the first trajectory, which cannot be played before there are images.

    Returns:
        (start stamp [ns], trajectory); each trajectory ends where the next one starts.
    """
    stamps = states.stamps_ns
    seconds = (stamps - stamps[0]) * 1e-9
    chunks: list[Plan] = []
    first = int(np.searchsorted(stamps, start_ns))
    while first < len(stamps) - 1:
        last = int(np.searchsorted(seconds, seconds[first] + chunk_s))
        last = min(max(last, first + 1), len(stamps) - 1)
        part = slice(first + 1, last + 1)
        trajectory = JointTrajectory(
            joint_names=states.joint_names,
            times=np.asarray(seconds[part] - seconds[first], np.float64),
            positions=states.positions[part],
        )
        chunks.append((int(stamps[first]), trajectory))
        first = last
    return chunks


def hold_at_stops(
    plans: Sequence[tuple[int, JointTrajectory | tuple[str, ...]]], states: JointStates
) -> tuple[list[Plan], int]:
    """Put plans that hold still in place of empty trajectories, as controllers take these.

    A trajectory without points makes a controller give up the plan before it and hold the
    position; drivers and teleoperation stop with it.

    Args:
        plans: (start stamp [ns], trajectory, or the joint names of an empty one), by stamp.
        states: measured joint positions.

    Returns:
        Plans by stamp, and how many were empty. An empty one of other joints is left out.
    """
    found: list[Plan] = []
    count = 0
    for index, (stamp_ns, plan) in enumerate(plans):
        if isinstance(plan, JointTrajectory):
            found.append((stamp_ns, plan))
            continue
        names = [name for name in plan or states.joint_names if name in states.joint_names]
        if not names:
            continue
        count += 1
        later = plans[index + 1][0] if index + 1 < len(plans) else int(states.stamps_ns[-1])
        at = np.array([(stamp_ns - states.stamps_ns[0]) / NANO])
        known = np.asarray((states.stamps_ns - states.stamps_ns[0]) / NANO, np.float64)
        columns = [states.joint_names.index(name) for name in names]
        held = interpolated(at, known, states.positions[:, columns])
        still = JointTrajectory(
            joint_names=tuple(names),
            times=np.array([0.0, max((later - stamp_ns) / NANO - SAME_S, _PERIOD_S)]),
            positions=np.repeat(held, 2, axis=0),
        )
        found.append((stamp_ns, still))
    return found, count


def join_streams(plans: Sequence[Plan], chunk_s: float) -> tuple[list[Plan], int]:
    """Join streams of plans with a single point, as MoveIt Servo sends them, into longer plans.

    Args:
        plans: (start stamp [ns], trajectory), by stamp.
        chunk_s: length of the joined plans [s].

    Returns:
        Plans by stamp, and the number of plans with a single point that were joined.
    """
    joined: list[Plan] = []
    count = 0
    for run in _runs(plans):
        if len(run) < _LEAST_STREAM:
            joined += run
            continue
        count += len(run)
        start_ns = run[0][0]
        at = np.array([s + round(float(p.times[0]) * NANO) for s, p in run], np.int64)
        rows = np.concatenate([p.positions for _, p in run])
        is_new = np.diff(at, prepend=start_ns) > 0
        is_new &= at == np.maximum.accumulate(at)
        states = JointStates(
            stamps_ns=np.concatenate([[start_ns], at[is_new]]),
            joint_names=run[0][1].joint_names,
            positions=np.concatenate([rows[:1], rows[is_new]]),
        )
        joined += trajectories_to(states, chunk_s, start_ns)
    return joined, count


def _runs(plans: Sequence[Plan]) -> list[list[Plan]]:
    """Group consecutive plans with one point of the same joints; other plans stay alone."""
    numbers = [0]
    for (before_ns, before), (now_ns, now) in pairwise(plans):
        goes_on = (
            len(before.times) == len(now.times) == 1
            and before.joint_names == now.joint_names
            and (now_ns - before_ns) / NANO <= _STREAM_GAP_S
        )
        numbers.append(numbers[-1] + (not goes_on))
    grouped = groupby(zip(numbers, plans, strict=False), key=lambda item: item[0])
    return [[plan for _, plan in group] for _, group in grouped]


def complete_plans(
    plans: Sequence[Plan], states: JointStates | None, robot: RobotModel, chunk_s: float
) -> tuple[list[Plan], tuple[str, ...]]:
    """Complete plans of some of the joints with the positions measured meanwhile.

    An example is a gripper that an action drives. Motions of such joints between two plans become
    plans of their own. Plans that name unknown joints are not changed.

    Args:
        plans: (start stamp [ns], trajectory), by stamp.
        states: measured positions; None = nothing is completed.
        robot: robot whose joints every plan gets.
        chunk_s: length of plans between plans [s].

    Returns:
        Plans of all joints by stamp, and the joints that some plan does not name.
    """
    if states is None or not set(robot.joint_names) <= set(states.joint_names):
        return list(plans), ()
    measured = _Measured(states, robot)
    done: list[Plan] = []
    taken: dict[str, None] = {}
    for index, (stamp_ns, plan) in enumerate(plans):
        missing = [name for name in robot.joint_names if name not in plan.joint_names]
        if not missing or not set(plan.joint_names) <= set(robot.joint_names):
            done.append((stamp_ns, plan))
            continue
        taken.update(dict.fromkeys(missing))
        next_ns = plans[index + 1][0] if index + 1 < len(plans) else int(states.stamps_ns[-1])
        done += measured.completed(stamp_ns, plan, missing, next_ns, chunk_s)
    return done, tuple(taken)


class _Measured:
    """Measured positions between stamps.

    Args:
        states: measured positions of at least the robot's joints.
        robot: robot whose order of joints is taken.
    """

    def __init__(self, states: JointStates, robot: RobotModel) -> None:
        columns = [states.joint_names.index(name) for name in robot.joint_names]
        self._stamps, self._rows = states.stamps_ns, states.positions[:, columns]
        self._robot = robot

    def at(self, stamp_ns: int, seconds: FloatArray) -> FloatArray:
        """Return the positions (N, J) at times after a stamp [s]."""
        known = np.asarray((self._stamps - stamp_ns) * 1e-9, np.float64)
        return interpolated(seconds, known, self._rows, self._robot.is_endless)

    def times(self, stamp_ns: int, begin_s: float, end_s: float) -> FloatArray:
        """Return the times of samples after a stamp [s], no denser than needed."""
        if end_s <= begin_s:
            return np.zeros(0)
        known = (self._stamps - stamp_ns) * 1e-9
        inside = known[(known > begin_s + SAME_S) & (known <= end_s + SAME_S)]
        slots = np.floor((inside - begin_s) / _PERIOD_S)
        return np.asarray(inside[np.unique(slots, return_index=True)[1]], np.float64)

    def completed(
        self,
        stamp_ns: int,
        plan: JointTrajectory,
        missing: Sequence[str],
        next_ns: int,
        chunk_s: float,
    ) -> list[Plan]:
        """The plan with all joints, and plans of what the missing ones do until the next one."""
        robot = self._robot
        own = [robot.joint_names.index(name) for name in plan.joint_names]
        others = [robot.joint_names.index(name) for name in missing]
        end_s, next_s = float(plan.times[-1]), (next_ns - stamp_ns) / NANO
        grid = _union(plan.times, self.times(stamp_ns, 0.0, min(end_s, next_s)))
        start = self.at(stamp_ns, np.zeros(1))[0, own]

        def rows(times: FloatArray) -> FloatArray:
            table = self.at(stamp_ns, times)
            table[:, own] = resample(plan, start, times)
            return table

        names = robot.joint_names
        whole = JointTrajectory(joint_names=names, times=grid, positions=rows(grid))
        rest = np.concatenate([[end_s], self.times(stamp_ns, end_s, next_s)])
        held = rows(rest)
        if len(rest) < 2 or np.ptp(held[:, others], axis=0).max() < _MOVED:
            return [(stamp_ns, whole)]
        stamps = stamp_ns + np.round(rest * NANO).astype(np.int64)
        between = JointStates(stamps_ns=stamps, joint_names=names, positions=held)
        return [(stamp_ns, whole), *trajectories_to(between, chunk_s, int(stamps[0]))]


def _union(times: FloatArray, more: FloatArray) -> FloatArray:
    """Return the sorted union of two arrays of times; equal times count once."""
    apart = np.abs(more[:, None] - times[None]).min(axis=1, initial=np.inf) > SAME_S
    return np.sort(np.concatenate([times, more[apart]]))
