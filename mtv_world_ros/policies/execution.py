"""Which part of an answer is executed before the policy is asked again."""

from __future__ import annotations

import numpy as np

from mtv_world_ros.data_types import FloatArray, JointTrajectory
from mtv_world_ros.errors import ConfigError
from mtv_world_ros.geometry.resample import resample

#: points nearer to the end than this are the end [s]
_SAME_S = 1e-6


def first_part(
    trajectory: JointTrajectory, start_positions: FloatArray, seconds: float
) -> JointTrajectory:
    """Returns the trajectory up to a time, with a point at that time where it goes on after it.

    Args:
        trajectory: times count from the observation it answers; joints in any order.
        start_positions: (J,) positions at time 0, in the trajectory's joint order.
        seconds: where it is cut [s].

    Raises:
        ConfigError: the time is not positive.
    """
    if seconds <= 0:
        raise ConfigError(f'answers are executed for {seconds} s; it must be positive')
    if trajectory.times[-1] <= seconds + _SAME_S:
        return trajectory
    times, kept = trajectory.times, trajectory.times <= seconds + _SAME_S
    is_cut_between = not kept.any() or times[kept][-1] < seconds - _SAME_S
    if not is_cut_between:
        return _taken(trajectory, kept)
    end = resample(trajectory, start_positions, np.array([seconds]))
    velocities = trajectory.velocities
    if velocities is not None:
        last = [np.interp(seconds, times, column) for column in velocities.T]
        velocities = np.vstack([velocities[kept], last])
    return JointTrajectory(
        joint_names=trajectory.joint_names,
        times=np.append(times[kept], seconds),
        positions=np.vstack([trajectory.positions[kept], end]),
        velocities=velocities,
    )


def _taken(trajectory: JointTrajectory, kept: np.ndarray) -> JointTrajectory:
    velocities = trajectory.velocities
    return JointTrajectory(
        joint_names=trajectory.joint_names,
        times=trajectory.times[kept],
        positions=trajectory.positions[kept],
        velocities=None if velocities is None else velocities[kept],
    )
