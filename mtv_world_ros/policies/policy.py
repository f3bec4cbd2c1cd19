"""What a policy is (observation and instruction in, trajectory out), and how much is executed."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from mtv_world_ros.data_types import FloatArray, JointTrajectory, Observation
from mtv_world_ros.errors import ConfigError
from mtv_world_ros.geometry.resample import resample


class Policy(Protocol):
    """Decides what the robot does next; the same object runs in imagination and elsewhere."""

    @property
    def name(self) -> str:
        """Under which its results are listed."""
        ...

    def reset(self, *, seed: int) -> None:
        """Begins an episode; the next observation is its first.

        Args:
            seed: of the policy's own randomness.
        """
        ...

    def act(self, observation: Observation, instruction: str) -> JointTrajectory | None:
        """Returns the commands that follow the observation, or None where the episode is over.

        Times count from the observation's stamp. Whoever runs the policy may execute the first
        part of them alone and ask again.

        Raises:
            PolicyError: it cannot answer, e.g. its server is gone.
        """
        ...


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
