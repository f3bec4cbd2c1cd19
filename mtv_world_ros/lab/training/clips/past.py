"""Anchor and history frames of a training clip, drawn with the distribution of serving.

A clip is treated as if a rollout had begun some frames before it: that frame is the anchor, and
the frames since then, at most N, are the history. So the first chunk of a rollout (no history),
the chunks soon after it (few frames, the oldest repeated) and all later ones occur in training as
in serving, and every history length that is served was trained.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mtv_world_ros.data.recording import frame_indices, Recording
from mtv_world_ros.data_types import ByteArray, History, WorldModelSpec
from mtv_world_ros.lab.training.training_config import HistoryConfig


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


def draw_past(history: History, config: HistoryConfig, rng: np.random.Generator) -> Past:
    """Returns the history of a clip, with a noise level drawn for it."""
    known = history.frames.shape[1] > 0 and rng.random() >= config.dropout
    sigma = float(rng.uniform(0.0, config.max_noise)) if known else 1.0
    return Past(history.anchor, history.filled(config.num_frames), sigma)


def frame_before(recording: Recording, start: int, seconds: float) -> int | None:
    """Returns the recorded frame nearest to a time before another; None = before the first."""
    wanted = recording.times[start] - seconds
    if wanted < recording.times[0] - 1e-6:
        return None
    return int(np.argmin(np.abs(recording.times - wanted)))
