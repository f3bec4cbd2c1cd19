"""Measured joint positions in the robot's order, at any time of the recording."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.data.episode import JointStates
from mtv_world_ros.data_types import FloatArray, JointTrajectory
from mtv_world_ros.geometry.resample import match_joints
from mtv_world_ros.geometry.robot import RobotModel


class JointTrack:
    """Joint states of a recording, interpolated.

    Args:
        states: as recorded.
        robot: whose joints are picked.

    Attributes:
        stamps_ns: (N,) int64, increasing.
        positions: (N, J) in the robot's order [rad or m].

    Raises:
        TrajectoryError: a joint of the robot is missing.
    """

    def __init__(self, states: JointStates, robot: RobotModel) -> None:
        self.stamps_ns = np.asarray(states.stamps_ns, np.int64)
        matched = match_joints(
            JointTrajectory(
                joint_names=states.joint_names,
                times=(self.stamps_ns - self.stamps_ns[0]) * 1e-9,
                positions=states.positions,
            ),
            robot,
        )
        self.positions = matched.positions

    def at(self, stamps_ns: NDArray[np.int64]) -> FloatArray:
        """(len(stamps_ns), J) positions; the first or last one beyond the ends."""
        wanted = np.asarray(stamps_ns - self.stamps_ns[0], float)
        have = np.asarray(self.stamps_ns - self.stamps_ns[0], float)
        return np.stack([np.interp(wanted, have, c) for c in self.positions.T], axis=1)

    def covers(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether the stamps lie within the recorded joint states."""
        return (stamps_ns >= self.stamps_ns[0]) & (stamps_ns <= self.stamps_ns[-1])
