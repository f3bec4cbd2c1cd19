"""What comes before a clip that is to start where the model's own rollout ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtv_world_ros.data.recording import Clip, cut_clip, frame_indices, Recording
from mtv_world_ros.data_types import WorldModelSpec
from mtv_world_ros.training.config import SelfRolloutConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Lead:
    """A clip of several chunks: those to imagine, and the last one, which is trained on.

    Attributes:
        clip: (num_chunks + 1) * T frames behind its first one.
        num_chunks: chunks to imagine.
        names: of the objects.
        colours: order of the colour channels that the clip is shown in.
    """

    clip: Clip
    num_chunks: int
    names: tuple[str, ...] = ()
    colours: tuple[int, ...] = (0, 1, 2)

    @property
    def num_frames(self) -> int:
        """T, frames a chunk."""
        return (len(self.clip.times) - 1) // (self.num_chunks + 1)


def lead_before(
    recording: Recording,
    start: int,
    spec: WorldModelSpec,
    config: SelfRolloutConfig,
    step: int,
    rng: np.random.Generator,
) -> Lead | None:
    """Returns what comes before the clip at recorded frame `start`, if it is to have a rollout.

    Where the episode is not long enough before it, the rollout is shorter; None where it has no
    room at all, and with the probability that the configuration says. The clip that is trained on
    then starts at the recorded frame next to `start`, on the rollout's clock.
    """
    # no draws while it is off, so that such runs keep their batches
    if step < config.start_step or config.share == 0 or rng.random() >= config.share:
        return None
    for num_chunks in range(int(rng.integers(config.max_chunks)) + 1, 0, -1):
        first = frame_before(recording, start, num_chunks * spec.chunk_seconds)
        num_frames = (num_chunks + 1) * spec.num_frames
        if first is None or frame_indices(recording, first, spec, num_frames) is None:
            continue
        clip = cut_clip(recording, first, spec, num_frames)
        return Lead(clip=clip, num_chunks=num_chunks)
    return None


def frame_before(recording: Recording, start: int, seconds: float) -> int | None:
    """Returns the recorded frame nearest to so long before another; None = before the first."""
    wanted = recording.times[start] - seconds
    if wanted < recording.times[0] - 1e-6:
        return None
    return int(np.argmin(np.abs(recording.times - wanted)))
