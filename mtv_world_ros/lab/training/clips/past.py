"""Anchor and history frames of a training clip, drawn with the distribution of serving.

A clip is treated as if a rollout had begun some frames before it: that frame is the anchor, and
the frames since then, at most N, are the history. So the first chunk of a rollout (no history),
the chunks soon after it (few frames, the oldest repeated) and all later ones occur in training as
in serving, and every history length that is served was trained.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mtv_world_ros.data.recording import Clip, cut_clip, frame_indices, Recording
from mtv_world_ros.data_types import ByteArray, History, WorldModelSpec
from mtv_world_ros.lab.training.training_config import HistoryConfig, SelfRolloutConfig


class Past(NamedTuple):
    """Anchor and history of a clip.

    Attributes:
        anchor: (V, H, W, 3) uint8 RGB first frame of the rollout.
        frames: (V, N, H, W, 3) uint8 RGB.
        sigma: noise level of the frames; 1 = there are none.
    """

    anchor: ByteArray
    frames: ByteArray
    sigma: float


def history_before(
    recording: Recording,
    start: int,
    spec: WorldModelSpec,
    config: HistoryConfig,
    rng: np.random.Generator,
) -> History:
    """Returns the past of a rollout that began some frames before recorded frame `start`."""
    begins = rng.random() < config.first_share
    longest = int((recording.times[start] - recording.times[0]) * spec.fps + 1e-3)
    if begins or not longest:
        return History.begin(recording.frames[:, start])
    age = int(rng.integers(1, longest + 1))
    first = frame_before(recording, start, age / spec.fps)
    shown = None if first is None else frame_indices(recording, first, spec, age)
    if shown is None:  # a gap: no rollout can cross it
        return History.begin(recording.frames[:, start])
    kept = shown[max(age - config.num_frames, 0) : age]
    return History(anchor=recording.frames[:, shown[0]], frames=recording.frames[:, kept])


def history_of_lead(lead: Lead, config: HistoryConfig) -> History:
    """Returns the past of a rollout that begins with the lead; its frames are recorded ones."""
    shown = lead.clip.frames[:, : lead.num_chunks * lead.num_frames]
    kept = max(shown.shape[1] - config.num_frames, 0)
    return History(anchor=shown[:, 0], frames=shown[:, kept:])


def draw_past(history: History, config: HistoryConfig, rng: np.random.Generator) -> Past:
    """Returns the history of a clip, with a noise level drawn for it."""
    known = history.frames.shape[1] > 0 and rng.random() >= config.dropout
    sigma = float(rng.uniform(0.0, config.max_noise)) if known else 1.0
    return Past(history.anchor, history.filled(config.num_frames), sigma)


@dataclass(frozen=True, slots=True, kw_only=True)
class Lead:
    """A clip of several chunks: those to imagine, and the last one, which is trained on.

    Attributes:
        clip: (num_chunks + 1) * T frames behind its first one.
        num_chunks: chunks to imagine.
        names: of the objects.
        colours: order of the colour channels of the clip.
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
    """Returns the lead of the clip at recorded frame `start`, if it is to start from a rollout.

    If the episode is too short before it, the rollout is shorter; None if there is no room at
    all, and with the configured probability. The clip that is trained on
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
    """Returns the recorded frame nearest to a time before another; None = before the first."""
    wanted = recording.times[start] - seconds
    if wanted < recording.times[0] - 1e-6:
        return None
    return int(np.argmin(np.abs(recording.times - wanted)))
