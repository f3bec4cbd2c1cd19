"""A rollout in both worlds side by side, as files, and where commands, objects, verdicts part."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import nan
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import BoolArray, FloatArray, SuccessEstimate
from mtv_world_ros.core.images import resize_frames
from mtv_world_ros.ranking.jobs import COMMANDS_PART, OBJECTS_PART, WorldComparison
from mtv_world_ros.rollout.prediction import Prediction
from mtv_world_ros.rollout.rollout import ObservedChunk
from mtv_world_ros.simulation.simulated_world import SeenChunk
from mtv_world_ros.success.estimator import verdict
from mtv_world_ros.viewing.rollout_clips import make_clip
from mtv_world_ros.viewing.scored_rollout import StoredRollout
from mtv_world_ros.viewing.stored_rollout import rollout_bytes
from mtv_world_ros.vision.jaccard import jaccard

#: number of frames in a row with too small an overlap after which an object has parted
_FRAMES_APART = 3
#: visible fraction of an object's first mask, in both worlds, below which the object is hidden
_HIDDEN = 1 / 3
#: suffix of the video of both worlds
VIDEO = '.mp4'
#: suffix of the contact sheet of both worlds
SHEET = '.webp'
#: suffix of the file with the frames and masks of both worlds
FRAMES = '.rollout.npz'
#: maximum size of a video, for which its quality is lowered [bytes]
_VIDEO_BYTES = 150_000
#: grey level of frames after the end of a world
_BLANK = 225


@dataclass(frozen=True, slots=True, kw_only=True)
class BothWorlds:
    """Chunks of one rollout in the simulator and in imagination, from one first observation.

    Attributes:
        fps: frames a second of the model.
        real: the simulator's frames and joints, one chunk per answer of the policy.
        observed: masks and estimates on the real frames.
        imagined: the imagined chunks.
    """

    fps: float
    real: Sequence[SeenChunk]
    observed: Sequence[ObservedChunk]
    imagined: Sequence[Prediction]

    def course(self) -> WorldComparison:
        """Return how the rollout went."""
        commands = [chunk.commands for chunk in self.real]
        gaps = command_gaps(commands, [chunk.positions for chunk in self.imagined])
        overlaps = np.full((0, len(gaps)), nan)
        names: tuple[str, ...] = ()
        if self.observed and self.imagined:
            overlaps = object_overlaps(_masks(self.observed), _masks(self.imagined))
            names = self.imagined[0].masks.names
        times = (1 + np.arange(len(gaps))) / self.fps
        parted = first_apart(overlaps)
        frame, number = min(((t, o) for o, t in enumerate(parted) if t >= 0), default=(-1, -1))
        seen = _estimates(self.observed, self.fps)
        imagined = _estimates(self.imagined, self.fps)
        ends = sorted({*seen, *imagined})
        return WorldComparison(
            times=_rounded(times),
            command_gaps=_rounded(gaps),
            overlaps=_rounded(_least(overlaps, len(gaps))),
            ends=tuple(ends),
            seen=_rounded([_probability(seen, end) for end in ends]),
            imagined=_rounded([_probability(imagined, end) for end in ends]),
            commands_part_s=_first(gaps > COMMANDS_PART, times),
            objects_part_s=float(times[frame]) if frame >= 0 else nan,
            parted_object=names[number] if frame >= 0 else '',
            verdicts_part_s=next(
                (
                    end
                    for end in ends
                    if end in seen and end in imagined and verdicts_part(seen[end], imagined[end])
                ),
                nan,
            ),
        )

    def frames(self) -> StoredRollout | None:
        """Return both worlds frame by frame; grey where one has ended; None = one is empty."""
        if not (self.observed and self.imagined):
            return None
        first = self.imagined[0]
        height, width = first.video.frames.shape[2:4]
        real = np.concatenate([chunk.frames for chunk in self.real], axis=1)
        real = np.stack([resize_frames(view, width, height) for view in real])
        drawn = [
            chunk.trajectory_video.frames[:, 1 : 1 + chunk.video.frames.shape[1]]
            for chunk in self.imagined
        ]
        imagined = np.concatenate([chunk.video.frames for chunk in self.imagined], axis=1)
        num = max(real.shape[1], imagined.shape[1])
        true, found = _masks(self.observed), _masks(self.imagined)
        common = min(true.shape[2], found.shape[2])
        j = np.full((*true.shape[:2], num), nan)
        j[:, :, :common] = jaccard(found[:, :, :common], true[:, :, :common])
        return StoredRollout(
            views=first.video.views,
            objects=first.masks.names,
            fps=self.fps,
            stretches=np.zeros(num, int),
            times=(1 + np.arange(num)) / self.fps,
            real=_padded(real, num, 1, _BLANK),
            trajectory=_padded(np.concatenate(drawn, axis=1), num, 1, _BLANK),
            imagined=_padded(imagined, num, 1, _BLANK),
            true_masks=_padded(true, num, 2, False),
            masks=_padded(found, num, 2, False),
            j=j,
        )

    def files(self) -> dict[str, str]:
        """Return a rollout's video, contact sheet and frames in base64, by suffix."""
        rollout = self.frames()
        if rollout is None:
            return {}
        clip = make_clip(rollout, max_bytes=_VIDEO_BYTES)
        made = {VIDEO: clip.video, SHEET: clip.sheet, FRAMES: rollout_bytes(rollout)}
        return {suffix: base64.b64encode(data).decode() for suffix, data in made.items()}


def command_gaps(real: Sequence[FloatArray], imagined: Sequence[FloatArray]) -> FloatArray:
    """Return (T,) largest differences between commands, chunks of (T', J); NaN where one ends."""
    num = max(sum(map(len, real)), sum(map(len, imagined)))
    gaps = np.full(num, nan)
    if real and imagined:
        a, b = np.concatenate(real), np.concatenate(imagined)
        common = min(len(a), len(b))
        gaps[:common] = np.abs(a[:common] - b[:common]).max(axis=1)
    return gaps


def object_overlaps(true: BoolArray, found: BoolArray) -> FloatArray:
    """Return (O, T) J of masks (V, O, T', H, W) of two worlds, in the view of the largest J.

    NaN where no view shows the object in either world: little of it is seen in both, as where it
    lies below another one, and J of what is left says nothing.
    """
    common = min(true.shape[2], found.shape[2])
    true, found = true[:, :, :common], found[:, :, :common]
    scores = jaccard(found, true)
    seen = np.maximum(true.sum(axis=(-2, -1)), found.sum(axis=(-2, -1)))
    shown = seen > _HIDDEN * seen[:, :, :1]
    best = np.where(shown, scores, -1.0).max(axis=0)
    return np.where(shown.any(axis=0), best, nan)


def first_apart(overlaps: FloatArray) -> list[int]:
    """Return the frame from which each object of (O, T) overlaps has parted; -1 = never.

    It has where J stays below `OBJECTS_PART` for some frames, or from there to the end.
    """
    found = []
    for row in overlaps < OBJECTS_PART:
        starts = [t for t in range(len(row)) if row[t] and row[t : t + _FRAMES_APART].all()]
        found.append(starts[0] if starts else -1)
    return found


def _masks(chunks: Sequence[ObservedChunk] | Sequence[Prediction]) -> BoolArray:
    return np.concatenate([chunk.masks.masks for chunk in chunks], axis=2)


def verdicts_part(one: SuccessEstimate, other: SuccessEstimate) -> bool:
    """Return True if one verdict is a success, the other a failure, and intervals do not overlap.

    False if either estimate is open or abstains.
    """
    calls = {verdict(estimate.probability, estimate.interval) for estimate in (one, other)}
    low = max(one.interval[0], other.interval[0])
    high = min(one.interval[1], other.interval[1])
    return calls == {0.0, 1.0} and not low <= high


def _estimates(
    chunks: Sequence[ObservedChunk] | Sequence[Prediction], fps: float
) -> dict[float, SuccessEstimate]:
    """Return the estimates by the time at which their chunk ends [s]."""
    ends = np.cumsum([chunk.masks.masks.shape[2] for chunk in chunks]) / fps
    return {round(float(end), 3): chunk.success for end, chunk in zip(ends, chunks, strict=True)}


def _probability(estimates: Mapping[float, SuccessEstimate], end: float) -> float:
    return estimates[end].probability if end in estimates else nan


def _least(overlaps: FloatArray, num: int) -> FloatArray:
    """Return (T,) least overlap over the objects, NaN where none is known."""
    least = np.where(np.isfinite(overlaps), overlaps, np.inf).min(axis=0, initial=np.inf)
    return _padded(np.where(np.isfinite(least), least, nan), num, 0, nan)


def _first(holds: BoolArray, times: FloatArray) -> float:
    return float(times[holds.argmax()]) if holds.any() else nan


def _padded(values: Any, num: int, axis: int, blank: float) -> Any:
    """Pad an axis of an array to a length."""
    missing = [(0, num - values.shape[axis] if k == axis else 0) for k in range(values.ndim)]
    return np.pad(values, missing, constant_values=blank)


def _rounded(values: Sequence[float] | FloatArray) -> tuple[float, ...]:
    return tuple(round(float(value), 4) for value in values)
