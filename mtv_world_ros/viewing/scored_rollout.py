"""Rollouts of evaluations and rankings, with what was said of them, for the viewer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mtv_world_ros.data.stored_rollout import StoredRollout
from mtv_world_ros.entry_points import load, registered, ROLLOUTS
from mtv_world_ros.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoredRollout:
    """A rollout beside what really happened.

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
    """Returns whether a folder holds rollouts that an installed package knows how to show."""
    return _reader(folder) is not None


def scored_rollouts(folder: Path, count: int) -> Iterator[ScoredRollout]:
    """Yields rollouts of an evaluation or a ranking, up to `count`; the ranking's worst first.

    Raises:
        ConfigError: the folder holds neither, or its reader cannot be imported.
        EpisodeError: frames cannot be read.
    """
    reader = _reader(folder)
    if reader is None:
        raise ConfigError(f"'{folder}' is neither an evaluation nor a ranking")
    yield from reader.scored_rollouts(folder, count)


def _reader(folder: Path) -> Any:
    """The registered module that reads such a folder; None = there is none."""
    if not folder.is_dir():
        return None
    # a ranking's folder is one first
    for _, entry in sorted(registered(ROLLOUTS).items(), reverse=True):
        module = load(entry)
        if (folder / module.FILE).is_file():
            return module
    return None
