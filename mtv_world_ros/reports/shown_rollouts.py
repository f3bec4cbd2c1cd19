"""Rollouts of an evaluation for the viewer."""

from __future__ import annotations

from collections.abc import Iterator
from math import isfinite
from pathlib import Path

from mtv_world_ros.core.estimate_words import CANNOT_TELL
from mtv_world_ros.evaluation.results import EpisodeResult
from mtv_world_ros.reports.read_back import read_evaluations
from mtv_world_ros.viewing.scored_rollout import ScoredRollout, StoredRollout

#: name of the file that marks the folder of an evaluation
FILE = 'metrics.json'


def scored_rollouts(folder: Path, count: int) -> Iterator[ScoredRollout]:
    """Yield the rollouts of an evaluation's first `count` episodes whose frames were kept.

    Raises:
        ConfigError: the folder is no evaluation's.
        EpisodeError: frames cannot be read.
    """
    for evaluated in read_evaluations(folder):
        label = evaluated.label or folder.name
        for result in sorted(evaluated.results, key=lambda result: result.episode)[:count]:
            rollout = evaluated.rollout(result.episode)
            if rollout is not None:
                yield _evaluated(f'{label}/{result.episode}', rollout, result)


def _evaluated(name: str, rollout: StoredRollout, result: EpisodeResult) -> ScoredRollout:
    last, estimate = float(rollout.times[-1]), result.probability
    text = f'success {estimate:.2f}' if isfinite(estimate) else CANNOT_TELL
    return ScoredRollout(
        name=name,
        rollout=rollout,
        estimates={'imagined': ((last, estimate),)} if isfinite(estimate) else {},
        words=(
            (0.0, f'{result.task}: recorded {result.outcome}'),
            (last, f'{text}: {"; ".join(result.reasons)}'),
        ),
    )
