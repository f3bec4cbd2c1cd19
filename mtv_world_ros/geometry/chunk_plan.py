"""The part of a trajectory that one chunk of an imagined episode shows."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np

from mtv_world_ros.data_types import FloatArray, JointTrajectory
from mtv_world_ros.geometry.resample import resample


@dataclass(frozen=True, slots=True, kw_only=True)
class ChunkPlan:
    """The part of a trajectory that one chunk shows.

    Attributes:
        times: (1 + T,) of a whole chunk, from the stamp on [s]; row 0 its start.
        positions: (1 + T, J) then [rad or m].
        num_frames: frames to keep: the last chunk ends with the trajectory.
        stamp_ns: of the observation that the trajectory started from [ns].
        chunk: its index in the trajectory.
        num_chunks: of the trajectory.
        trajectory: the whole, in the robot's joint order.
        current: (J,) where the robot stood when it began.
    """

    times: FloatArray
    positions: FloatArray
    num_frames: int
    stamp_ns: int
    chunk: int
    num_chunks: int
    trajectory: JointTrajectory
    current: FloatArray

    @property
    def frame_s(self) -> float:
        """Time between two frames [s]."""
        return float(self.times[1] - self.times[0])

    @property
    def num_left(self) -> int:
        """Frames of a whole chunk that are not kept."""
        return len(self.times) - 1 - self.num_frames

    def fine_positions(self, step_s: float, each: int = 1) -> FloatArray:
        """Returns the joints of the whole chunk, `each` in a step; row 0 its start."""
        count = round((self.times[-1] - self.times[0]) / step_s) * each
        times = self.times[0] + step_s / each * np.arange(count + 1)
        return resample(self.trajectory, self.current, times)


def plan_chunks(
    trajectory: JointTrajectory, current: FloatArray, stamp_ns: int, *, num_frames: int, fps: float
) -> list[ChunkPlan]:
    """Returns a trajectory on a model's clock, cut into its chunks.

    Args:
        trajectory: in the robot's joint order.
        current: (J,) where the robot stands [rad or m].
        stamp_ns: of the observation that it starts from [ns].
        num_frames: of a whole chunk.
        fps: frames a second.
    """
    total = max(1, ceil(float(trajectory.times[-1]) * fps - 1e-6))
    num_chunks = ceil(total / num_frames)
    times = np.arange(num_chunks * num_frames + 1) / fps
    positions = resample(trajectory, current, times)
    return [
        ChunkPlan(
            times=times[first : first + num_frames + 1],
            positions=positions[first : first + num_frames + 1],
            num_frames=min(num_frames, total - first),
            stamp_ns=stamp_ns,
            chunk=chunk,
            num_chunks=num_chunks,
            trajectory=trajectory,
            current=current,
        )
        for chunk, first in enumerate(range(0, total, num_frames))
    ]
