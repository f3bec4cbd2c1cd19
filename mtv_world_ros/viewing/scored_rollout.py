"""Rollouts of evaluations and rankings with their estimates, for the viewer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import BoolArray, ByteArray, FloatArray
from mtv_world_ros.core.entry_points import load, registered, ROLLOUTS
from mtv_world_ros.core.errors import ConfigError, EpisodeError
from mtv_world_ros.viewing.video import KINDS

MASKS = ('true_masks', 'masks')


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredRollout:
    """Predicted frames and recorded frames of the same times: V views, T frames, O objects.

    Attributes:
        views: names of the V views.
        objects: names of the O objects.
        fps: frames a second.
        stretches: (T,) int, number of the stretch that each frame belongs to; where it changes,
            the imagination started anew from a recorded frame.
        times: (T,) [s] since the episode's first frame.
        real: (V, T, H, W, 3) uint8 RGB recorded frames.
        trajectory: (V, T, H, W, 3) uint8 RGB trajectory video.
        imagined: (V, T, H, W, 3) uint8 RGB predicted frames.
        true_masks: (V, O, T, H, W) bool masks of the recorded frames.
        masks: (V, O, T, H, W) bool masks of the predicted frames.
        j: (V, O, T) J per frame, NaN = not scored.
    """

    views: tuple[str, ...]
    objects: tuple[str, ...]
    fps: float
    stretches: np.ndarray
    times: FloatArray
    real: ByteArray
    trajectory: ByteArray
    imagined: ByteArray
    true_masks: BoolArray
    masks: BoolArray
    j: FloatArray

    def __post_init__(self) -> None:
        num_views, num_objects, num_frames = len(self.views), len(self.objects), len(self.times)
        size = self.real.shape[2:4]
        wanted = {
            **dict.fromkeys(KINDS, (num_views, num_frames, *size, 3)),
            **dict.fromkeys(MASKS, (num_views, num_objects, num_frames, *size)),
            'j': (num_views, num_objects, num_frames),
            'stretches': (num_frames,),
        }
        for name, shape in wanted.items():
            found = getattr(self, name).shape
            if found != shape:
                raise EpisodeError(f'rollout: {name} has shape {found}, expected {shape}')


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoredRollout:
    """Rollout with its recording, scores and success estimates.

    Attributes:
        name: path of its entities.
        rollout: frames, masks, J.
        estimates: success estimates by who made them: times [s] and probabilities.
        words: time [s] and text.
    """

    name: str
    rollout: StoredRollout
    estimates: Mapping[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)
    words: tuple[tuple[float, str], ...] = ()


def is_scored(folder: Path) -> bool:
    """Return whether a folder holds rollouts that an installed package knows how to show."""
    return _reader(folder) is not None


def scored_rollouts(folder: Path, count: int) -> Iterator[ScoredRollout]:
    """Yield rollouts of an evaluation or a ranking, up to `count`; the ranking's worst first.

    Raises:
        ConfigError: the folder holds neither, or its reader cannot be imported.
        EpisodeError: frames cannot be read.
    """
    reader = _reader(folder)
    if reader is None:
        raise ConfigError(f"'{folder}' is neither an evaluation nor a ranking")
    yield from reader.scored_rollouts(folder, count)


def _reader(folder: Path) -> Any:
    """Return the registered module that reads such a folder; None = there is none."""
    if not folder.is_dir():
        return None
    # a ranking's folder is one first
    for _, entry in sorted(registered(ROLLOUTS).items(), reverse=True):
        module = load(entry)
        if (folder / module.FILE).is_file():
            return module
    return None
