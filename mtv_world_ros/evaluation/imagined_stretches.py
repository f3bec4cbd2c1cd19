"""Stretches of a recorded episode, imagined again from their first frame."""

from __future__ import annotations

from dataclasses import dataclass
from math import floor

import numpy as np

from mtv_world_ros.core.data_types import (
    ByteArray,
    FloatArray,
    JointTrajectory,
    SuccessEstimate,
    WorldModelSpec,
)
from mtv_world_ros.core.errors import ConfigError, EpisodeError
from mtv_world_ros.data.recording import frame_indices, Recording
from mtv_world_ros.data.recordings import commands_at, commands_until
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.prediction import Prediction
from mtv_world_ros.rollout.rollout import Rollout

#: observe: every chunk from the real frames until its start; imagine: chunks chained from the
#: episode's first frame
MODES = ('observe', 'imagine')


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """Part of a recorded episode that is compared with one rollout.

    Attributes:
        index: number of the stretch in the episode.
        start: recorded frame it starts from.
        frames: (V, 1 + T, H, W, 3) recorded frames on the model's clock, frame 0 the start.
        object_ids: (V, 1 + T, H, W) true masks as identities, None where not recorded.
        positions: (1 + T, J) measured at these frames [rad or m].
        points: (1 + T, O, 3) places of the recording's objects by two views [m], NaN until seen;
            None where the identities are the simulator's, or no place is known.
    """

    index: int
    start: int
    frames: ByteArray
    object_ids: ByteArray | None
    positions: FloatArray
    points: FloatArray | None = None

    @classmethod
    def of(cls, recording: Recording, index: int, rows: np.ndarray) -> Stretch:
        """Return the stretch of 1 + T recorded frames."""
        ids, poses = recording.object_ids, recording.object_poses
        return cls(
            index=index,
            start=int(rows[0]),
            frames=recording.frames[:, rows],
            object_ids=None if ids is None else ids[:, rows],
            positions=recording.positions[rows],
            points=poses[rows, :, :3, 3] if recording.masks_by and poses is not None else None,
        )

    @property
    def num_frames(self) -> int:
        """T, frames to predict."""
        return self.frames.shape[1] - 1


def check_mode(mode: str) -> None:
    """Raise ConfigError if it is none of `MODES`."""
    if mode not in MODES:
        raise ConfigError(f"mode is '{mode}'; it must be one of {', '.join(MODES)}")


def stretches(recording: Recording, spec: WorldModelSpec, mode: str) -> list[Stretch]:
    """Cut an episode into stretches; each is imagined as one rollout.

    In mode `observe` each stretch is a chunk; a last one shorter than half a chunk is left out
    unless it is the only one. In mode `imagine` the whole episode is one stretch.

    Raises:
        ConfigError: unknown mode.
        EpisodeError: the episode is shorter than a frame, or has gaps everywhere.
    """
    check_mode(mode)
    total = floor(float(recording.times[-1] - recording.times[0]) * spec.fps + 1e-3)
    length = spec.num_frames if mode == 'observe' else max(total, 1)
    found: list[Stretch] = []
    for first in range(0, max(total, 1), length):
        count = min(length, total - first)
        if count < 1 or (found and 2 * count < length):
            continue
        start = int(np.argmin(np.abs(recording.times - recording.times[0] - first / spec.fps)))
        cut = _cut(recording, start, count, spec, len(found))
        if cut is not None:
            found.append(cut)
    if not found:
        raise EpisodeError(
            f"'{recording.path}': its {len(recording.times)} frames hold no stretch without gaps "
            f'at {spec.fps:g} Hz'
        )
    return found


def _cut(
    recording: Recording, start: int, count: int, spec: WorldModelSpec, index: int
) -> Stretch | None:
    rows = frame_indices(recording, start, spec, count)
    return None if rows is None else Stretch.of(recording, index, rows)


def last_chunk(recording: Recording, stretch: Stretch, spec: WorldModelSpec) -> Stretch | None:
    """Return the last chunk of a stretch; None = the stretch is a single chunk."""
    rows = frame_indices(recording, stretch.start, spec, stretch.num_frames)
    if rows is None or stretch.num_frames <= spec.num_frames:
        return None
    return Stretch.of(recording, stretch.index, rows[-1 - spec.num_frames :])


def imagine_stretch(
    pipeline: Pipeline,
    recording: Recording,
    stretch: Stretch,
    *,
    actions: Recording,
    seed: int,
    num_inference_steps: int,
    num_seeds: int = 1,
) -> list[Prediction]:
    """Imagine a stretch from the recorded frames until its start; return its chunks.

    Args:
        pipeline: the world model and all around it.
        recording: the episode that the stretch was cut from.
        stretch: recorded frames to imagine.
        actions: episode whose commands are executed: the same, or another for a baseline.
        seed: seed of the noise.
        num_inference_steps: denoising steps a chunk; 0 = those the model is made for.
        num_seeds: rollouts whose mean the success estimate is.
    """
    trajectory = _commands(pipeline, actions, stretch)
    episode = _begin(pipeline, recording, stretch, seed, num_inference_steps, num_seeds)
    return list(episode.extend(trajectory))


def observe_stretch(pipeline: Pipeline, recording: Recording, stretch: Stretch) -> SuccessEstimate:
    """Return the estimate on recorded frames; it ends with the frames of the stretch."""
    episode = _begin(pipeline, recording, stretch)
    return episode.observe(stretch.frames[:, 1:], stretch.positions).success


def _commands(pipeline: Pipeline, actions: Recording, stretch: Stretch) -> JointTrajectory:
    start = min(stretch.start, len(actions.times) - 1)
    return commands_until(actions, start, stretch.num_frames / pipeline.spec.fps)


def _begin(
    pipeline: Pipeline,
    recording: Recording,
    stretch: Stretch,
    seed: int = 0,
    num_inference_steps: int = 0,
    num_seeds: int = 1,
) -> Rollout:
    """An episode that has seen all that was recorded before the stretch, as a node's has."""
    episode = pipeline.begin(
        recording.observation(0),
        RolloutOptions(
            instruction=recording.instruction,
            seed=seed,
            num_seeds=num_seeds,
            num_inference_steps=num_inference_steps,
        ),
    )
    if not stretch.start:
        return episode
    seconds = float(recording.times[stretch.start] - recording.times[0])
    rows = frame_indices(recording, 0, pipeline.spec, round(seconds * pipeline.spec.fps))
    if rows is not None:  # else there are gaps
        episode.observe(
            recording.frames[:, rows[1:]],
            recording.positions[rows],
            commands=commands_at(recording, rows),
        )
    return episode.branch(recording.observation(stretch.start))


def predicted_frames(chunks: list[Prediction]) -> ByteArray:
    """Return the (V, T, H, W, 3) frames of a rollout's chunks in a row."""
    return np.concatenate([chunk.video.frames for chunk in chunks], axis=1)
