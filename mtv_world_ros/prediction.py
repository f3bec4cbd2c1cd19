"""One imagined chunk and what was made on the way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import nan
import time
from types import MappingProxyType

from mtv_world_ros.data_types import (
    CameraModel,
    MultiViewVideo,
    ObjectMasks,
    Observation,
    Rollout,
    SuccessEstimate,
)
from mtv_world_ros.history import History
from mtv_world_ros.success.rollout_memory import RolloutMemory
from mtv_world_ros.success.trusted_horizon import HorizonCurve


class StageClock:
    """Time per stage of a chunk: `seconds` by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Ends a stage, which began where the one before it ended."""
        now = time.perf_counter()
        self.seconds[stage] = now - self._last
        self._last = now


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """One imagined chunk and what was made on the way.

    Attributes:
        rollout: the predicted frames; `video.times` [s] counts from the rollout's observation.
        trajectory_video: 1 + T control frames, frame 0 at the chunk's start.
        start_masks: object masks of the chunk's start frame (T = 1).
        masks: object masks of the predicted frames.
        success: the estimate at the end of this chunk.
        cameras: the V cameras at the model's size.
        stamp_ns: stamp of the rollout's observation [ns].
        chunk: index of this chunk in its rollout.
        num_chunks: chunks of the rollout.
        memory: what the estimate remembers of the rollout, for what is chained onto this chunk.
        end_history: what comes before `end_observation`, for chaining the next chunk onto it.
        horizon: how J falls with the horizon, where that was measured.
        segmenter: name of what found the masks.
        num_inference_steps: denoising steps.
        seconds: time spent by stage [s].
    """

    rollout: Rollout
    trajectory_video: MultiViewVideo
    start_masks: ObjectMasks
    masks: ObjectMasks
    success: SuccessEstimate
    cameras: tuple[CameraModel, ...]
    stamp_ns: int
    chunk: int
    num_chunks: int
    memory: RolloutMemory
    end_history: History
    horizon: HorizonCurve | None = None
    segmenter: str = ''
    num_inference_steps: int = 0
    seconds: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def imagined_seconds(self) -> float:
        """How far the last frame is from the last real one [s], over all that was chained."""
        times = self.trajectory_video.times
        return self.memory.num_frames * float(times[1] - times[0])

    def trusted_seconds(self, level: float) -> float:
        """Returns up to which time after the last real frame J is expected to be `level` [s].

        NaN = not measured for this checkpoint and segmenter.
        """
        if self.horizon is None or self.horizon.segmenter != self.segmenter:
            return nan
        return self.horizon.trusted_seconds(level)

    @property
    def end_observation(self) -> Observation:
        """The last predicted frame as an observation, for chaining the next chunk onto it."""
        video = self.rollout.video
        return Observation(
            cameras=self.cameras,
            frames=video.frames[:, -1],
            positions=self.rollout.positions[-1],
            stamp_ns=self.stamp_ns + round(float(video.times[-1]) * 1e9),
        )
