"""Joint trajectories matched to the robot's joints and brought to another clock."""

from __future__ import annotations

import numpy as np

from mtv_world_ros.data_types import FloatArray, JointTrajectory
from mtv_world_ros.errors import nearest, TrajectoryError
from mtv_world_ros.geometry.robot import RobotModel


def match_joints(
    trajectory: JointTrajectory,
    robot: RobotModel,
    current: FloatArray | None = None,
    *,
    allow_missing: bool = False,
) -> JointTrajectory:
    """Returns the trajectory with the robot's joints in the robot's order; extra ones dropped.

    Args:
        trajectory: joints in any order.
        robot: the robot.
        current: (J,) positions that missing joints keep, with `allow_missing`.
        allow_missing: whether missing joints are filled instead of refused.

    Raises:
        TrajectoryError: joints named twice or missing.
    """
    given = trajectory.joint_names
    doubled = sorted({name for name in given if given.count(name) > 1})
    if doubled:
        raise TrajectoryError(f'joints {doubled} are named more than once')
    missing = [name for name in robot.joint_names if name not in given]
    if missing and (not allow_missing or current is None):
        raise TrajectoryError(
            f"joints {missing} of robot '{robot.name}' are missing; the trajectory has "
            f'{list(given)}{nearest(missing[0], given)}'
        )
    if given == robot.joint_names:
        return trajectory
    return JointTrajectory(
        joint_names=robot.joint_names,
        times=trajectory.times,
        positions=_pick(trajectory.positions, given, robot, current),
        velocities=None
        if trajectory.velocities is None
        else _pick(trajectory.velocities, given, robot, np.zeros(len(robot.joint_names))),
    )


def _pick(
    values: FloatArray, given: tuple[str, ...], robot: RobotModel, default: FloatArray | None
) -> FloatArray:
    out = np.empty((len(values), len(robot.joint_names)))
    for column, name in enumerate(robot.joint_names):
        if name in given:
            out[:, column] = values[:, given.index(name)]
        else:
            assert default is not None
            out[:, column] = default[column]
    return out


def resample(
    trajectory: JointTrajectory, start_positions: FloatArray, times: FloatArray
) -> FloatArray:
    """Returns (len(times), J) positions at the wanted times.

    Cubic Hermite between points where velocities are given, else linear. Before the first point
    it runs linearly from the start positions at time 0; after the last point it holds.

    Args:
        trajectory: joints in the order of `start_positions`.
        start_positions: (J,) positions at time 0.
        times: (N,) wanted times [s], from 0 on.
    """
    if trajectory.times[0] > 1e-9:
        knots = np.concatenate([[0.0], trajectory.times])
        values = np.concatenate([start_positions[None], trajectory.positions])
        slopes = trajectory.velocities
        if slopes is not None:
            lead = (values[1] - values[0]) / knots[1]
            slopes = np.concatenate([lead[None], slopes])
    else:
        knots, values, slopes = trajectory.times, trajectory.positions, trajectory.velocities
    wanted = np.clip(times, knots[0], knots[-1])
    if len(knots) == 1:
        return np.repeat(values, len(wanted), axis=0)
    right = np.clip(np.searchsorted(knots, wanted, side='right'), 1, len(knots) - 1)
    left = right - 1
    width = (knots[right] - knots[left])[:, None]
    s = (wanted - knots[left])[:, None] / width
    if slopes is None:
        return (1 - s) * values[left] + s * values[right]
    return (
        (2 * s**3 - 3 * s**2 + 1) * values[left]
        + (s**3 - 2 * s**2 + s) * width * slopes[left]
        + (-2 * s**3 + 3 * s**2) * values[right]
        + (s**3 - s**2) * width * slopes[right]
    )
