"""Joint trajectories matched to the robot's joints and resampled to another clock."""

from __future__ import annotations

from collections import Counter

import numpy as np

from mtv_world_ros.core.bounded_input import check_limit, LimitError
from mtv_world_ros.core.data_types import BoolArray, FloatArray, JointTrajectory
from mtv_world_ros.core.errors import nearest, TrajectoryError
from mtv_world_ros.robot.model import RobotModel

#: points nearer to a time than this are at that time [s]
SAME_S = 1e-6
#: a first point this early stands for the start itself [s]
_NOW = 1e-9


def match_joints(
    trajectory: JointTrajectory, robot: RobotModel, current: FloatArray | None = None
) -> JointTrajectory:
    """Return the trajectory with the robot's joints in the robot's order; extra ones dropped.

    Args:
        trajectory: joints in any order.
        robot: the robot.
        current: (J,) positions that missing joints keep, if all that are named are the robot's
            (another name may be a misspelt one); None = missing joints are refused.

    Raises:
        TrajectoryError: joints named twice or missing, velocities that are not finite.
    """
    given = trajectory.joint_names
    _check_size(trajectory)
    if trajectory.velocities is not None and not np.isfinite(trajectory.velocities).all():
        point, joint = np.argwhere(~np.isfinite(trajectory.velocities))[0]
        raise TrajectoryError(
            f"the velocity of joint '{given[joint]}' is not finite at point {point}; give numbers "
            'or leave all velocities out'
        )
    doubled = sorted(name for name, count in Counter(given).items() if count > 1)
    if doubled:
        raise TrajectoryError(f'joints {doubled} are named more than once')
    missing = [name for name in robot.joint_names if name not in given]
    unknown = [name for name in given if name not in robot.joint_names]
    if missing and (current is None or unknown):
        hint = f'; it has no {unknown}{nearest(unknown[0], missing)}' if unknown else ''
        raise TrajectoryError(
            f"joints {missing} of robot '{robot.name}' are missing{hint}; the trajectory has "
            f'{list(given)}'
        )
    if given == robot.joint_names:
        return trajectory
    held, still = robot.lower if current is None else current, np.zeros(len(robot.joint_names))
    rates = trajectory.velocities
    return JointTrajectory(
        joint_names=robot.joint_names,
        times=trajectory.times,
        positions=_pick(trajectory.positions, given, robot, held),
        velocities=None if rates is None else _pick(rates, given, robot, still),
    )


def _check_size(trajectory: JointTrajectory) -> None:
    try:
        check_limit('joint_names', len(trajectory.joint_names), 'the trajectory')
        check_limit('trajectory_points', len(trajectory.times), 'the trajectory')
    except LimitError as error:
        raise TrajectoryError(str(error)) from error


def _pick(
    values: FloatArray, given: tuple[str, ...], robot: RobotModel, default: FloatArray
) -> FloatArray:
    """Return the columns (T, J) of the robot's joints; of those not given the default (J,)."""
    rows = np.tile(default, (len(values), 1))
    for column, name in enumerate(robot.joint_names):
        if name in given:
            rows[:, column] = values[:, given.index(name)]
    return rows


def resample(
    trajectory: JointTrajectory, start_positions: FloatArray, times: FloatArray
) -> FloatArray:
    """Return (N, J) positions at the wanted times.

    Cubic Hermite between points where velocities are given, else linear. Before the first point
    it starts from the start positions at time 0; after the last point it holds. A point at time
    0 or before counts instead of the start positions.

    Args:
        trajectory: joints in the order of `start_positions`.
        start_positions: (J,) positions at time 0.
        times: (N,) wanted times [s]; before 0 as at 0.
    """
    knots, values, slopes = trajectory.times, trajectory.positions, trajectory.velocities
    if knots[0] > _NOW:
        knots = np.concatenate([[0.0], knots])
        values = np.concatenate([start_positions[None], values])
        if slopes is not None:
            # the speed at the start is not known: the mean one up to the first point
            slopes = np.concatenate([(values[1:2] - values[:1]) / knots[1], slopes])
    if len(knots) == 1:
        return np.repeat(values, len(times), axis=0)
    wanted = np.clip(times, max(knots[0], 0.0), knots[-1])
    right = np.clip(np.searchsorted(knots, wanted, side='right'), 1, len(knots) - 1)
    left = right - 1
    width = (knots[right] - knots[left])[:, None]
    s = (wanted - knots[left])[:, None] / width
    if slopes is None:
        return (1 - s) * values[left] + s * values[right]
    return (
        (1 + 2 * s) * (1 - s) ** 2 * values[left]
        + s**2 * (3 - 2 * s) * values[right]
        + s * (1 - s) * ((1 - s) * slopes[left] - s * slopes[right]) * width
    )


def interpolated(
    wanted: FloatArray,
    times: FloatArray,
    rows: FloatArray,
    is_endless: BoolArray | None = None,
) -> FloatArray:
    """Return rows (T, J) of increasing times (T,) at wanted ones (N,); held before and after.

    Args:
        wanted: (N,) times of the result [s].
        times: (T,) times of the given values [s].
        rows: (T, J) positions [rad or m].
        is_endless: (J,) joints that turn without end. Drivers report these within a turn; between
            +pi and -pi the short way is taken, and the turn of the nearer row is kept.
    """
    found = np.stack([np.interp(wanted, times, column) for column in rows.T], axis=1)
    if is_endless is None or not is_endless.any():
        return found
    near = np.searchsorted((times[1:] + times[:-1]) / 2, wanted)
    for joint in np.flatnonzero(is_endless):
        turned = np.interp(wanted, times, np.unwrap(rows[:, joint]))
        away = turned - rows[near, joint]
        found[:, joint] = turned - 2 * np.pi * np.round(away / (2 * np.pi))
    return found


def cut_off(
    trajectory: JointTrajectory, start_positions: FloatArray, seconds: float
) -> JointTrajectory:
    """Return the points before a time, and one at that time; past its end it holds still.

    Args:
        trajectory: joints in the order of `start_positions`.
        start_positions: (J,) positions at time 0.
        seconds: time of the cut, from the trajectory's time 0 [s].
    """
    kept = trajectory.times < seconds - SAME_S
    end = resample(trajectory, start_positions, np.array([seconds]))
    velocities = trajectory.velocities
    if velocities is not None:
        columns = velocities.T
        last = [np.interp(seconds, trajectory.times, column, right=0.0) for column in columns]
        velocities = np.vstack([velocities[kept], last])
    return JointTrajectory(
        joint_names=trajectory.joint_names,
        times=np.append(trajectory.times[kept], seconds),
        positions=np.vstack([trajectory.positions[kept], end]),
        velocities=velocities,
    )


def nearest_rows(have: np.ndarray, want: np.ndarray) -> np.ndarray:
    """Return the index of the nearest of `have` (increasing) for each of `want`."""
    right = np.clip(np.searchsorted(have, want), 1, max(len(have) - 1, 1))
    right = np.minimum(right, len(have) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(want - have[left] <= have[right] - want, left, right)
