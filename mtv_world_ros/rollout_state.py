"""Where a rollout stands between two chunks, and the part of a trajectory that a chunk shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mtv_world_ros.data_types import (
    ByteArray,
    FloatArray,
    History,
    JointTrajectory,
    Observation,
    WorldModelSpec,
)
from mtv_world_ros.errors import ObservationError
from mtv_world_ros.geometry.camera import scaled
from mtv_world_ros.geometry.object_motion import FoundObjects
from mtv_world_ros.geometry.resample import resample
from mtv_world_ros.rendering.images import resize_frames
from mtv_world_ros.success.rollout_memory import RolloutMemory


@dataclass(frozen=True, slots=True, kw_only=True)
class RolloutState:
    """Where the rollout of one seed stands: what its next chunk goes on from.

    Attributes:
        observation: its last frame, at the model's size.
        history: the frames before that one.
        first: the episode's first real observation, at its own size.
        source: the last one, likewise.
        objects: where the named objects are; None before the first chunk after `source`.
        ahead: where they are foreseen to be after each further chunk of the trajectory.
        memory: what the estimate remembers; None before the first chunk.
        num_imagined: frames since the last real one.
    """

    observation: Observation
    history: History
    first: Observation
    source: Observation
    objects: FoundObjects | None = None
    ahead: tuple[FoundObjects, ...] = ()
    memory: RolloutMemory | None = None
    num_imagined: int = 0

    @classmethod
    def at(cls, observation: Observation, spec: WorldModelSpec) -> RolloutState:
        """Returns the state of an episode that begins at a real observation.

        Raises:
            ObservationError: the views are not the model's.
        """
        start = fit_observation(observation, spec)
        return cls(
            observation=start,
            history=History.begin(start.frames),
            first=observation,
            source=observation,
        )

    def after(
        self,
        frames: ByteArray,
        positions: FloatArray,
        stamp_ns: int,
        num_history: int,
        memory: RolloutMemory,
        objects: Sequence[FoundObjects] = (),
    ) -> RolloutState:
        """Returns the state at the last of the frames (V, T, H, W, 3).

        Args:
            frames: (V, T, H, W, 3) uint8 RGB after `observation`.
            positions: (J,) commanded at the last one [rad or m].
            stamp_ns: of the last one [ns].
            num_history: most frames to keep before it.
            memory: what the estimate remembers then.
            objects: where they are then, and after each further chunk of the trajectory.
        """
        start = self.observation
        return RolloutState(
            observation=replace(
                start, frames=frames[:, -1], positions=positions, stamp_ns=stamp_ns
            ),
            history=self.history.after(start.frames, frames, num_history),
            first=self.first,
            source=self.source,
            objects=objects[0] if objects else None,
            ahead=tuple(objects[1:]),
            memory=memory,
            num_imagined=self.num_imagined + frames.shape[1],
        )


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

    def fine_positions(self, step_s: float, each: int = 1) -> FloatArray:
        """Returns the joints of the whole chunk, `each` in a step; row 0 its start."""
        count = round((self.times[-1] - self.times[0]) / step_s) * each
        times = self.times[0] + step_s / each * np.arange(count + 1)
        return resample(self.trajectory, self.current, times)


def fit_observation(observation: Observation, spec: WorldModelSpec) -> Observation:
    """Returns the observation with frames and cameras at the model's size.

    Raises:
        ObservationError: the views are not the model's.
    """
    if observation.views != spec.views:
        raise ObservationError(
            f'the observation has views {list(observation.views)}, the model was trained on '
            f'{list(spec.views)} in this order'
        )
    if observation.frames.shape[1:3] == (spec.height, spec.width):
        return observation
    return replace(
        observation,
        cameras=tuple(scaled(c, spec.width, spec.height) for c in observation.cameras),
        frames=resize_frames(observation.frames, spec.width, spec.height),
    )
