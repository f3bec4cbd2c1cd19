"""Rollouts of evaluations and rankings, with what was said of them, for the viewer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path

from mtv_world_ros.bench.ranking.both_worlds import FRAMES
from mtv_world_ros.bench.ranking.rollout_cards import (
    rollout_file,
    told,
    verdict,
    when_they_part,
    worst_first,
)
from mtv_world_ros.bench.ranking.rollout_jobs import Result
from mtv_world_ros.bench.ranking.run_jobs import read_results
from mtv_world_ros.lab.evaluation.report.read_back import read_evaluations
from mtv_world_ros.lab.evaluation.results import EpisodeResult, load_rollout, StoredRollout

#: of a ranking's and an evaluation's folder
RANKING, EVALUATION = 'ranking.json', 'metrics.json'


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
    """Returns whether a folder is that of an evaluation or a ranking."""
    return any((folder / name).is_file() for name in (RANKING, EVALUATION))


def scored_rollouts(folder: Path, count: int) -> Iterator[ScoredRollout]:
    """Yields the first rollouts of an evaluation, or the worst ones of a ranking, up to `count`.

    Raises:
        ConfigError: the folder holds neither.
        EpisodeError: frames cannot be read.
    """
    if (folder / RANKING).is_file():
        chosen = [r for r in worst_first(read_results(folder)) if _path(folder, r).is_file()]
        yield from (_ranked(folder, result) for result in chosen[:count])
        return
    for evaluated in read_evaluations(folder):
        label = evaluated.metrics.get('label') or folder.name
        for name in sorted(evaluated.results)[:count]:
            rollout = evaluated.rollout(name)
            if rollout is not None:
                yield _evaluated(f'{label}/{name}', rollout, evaluated.results[name])


def _path(folder: Path, result: Result) -> Path:
    return rollout_file(folder, result, FRAMES)


def _ranked(folder: Path, result: Result) -> ScoredRollout:
    course, estimates = result.course, {}
    words = [(0.0, f'{result.policy}: {verdict(result)}')]
    if course is not None:
        estimates = {
            'imagined': tuple(zip(course.ends, course.imagined, strict=True)),
            'simulator': tuple(zip(course.ends, course.seen, strict=True)),
        }
        words += [(time, f'{what} part') for time, what in when_they_part(course)]
    rollout = load_rollout(_path(folder, result))
    last = float(rollout.times[-1])
    words.append((last, f'imagined {told(result.imagined)}: {"; ".join(result.imagined.reasons)}'))
    name = f'{result.policy}/{result.task}_{result.index}'
    return ScoredRollout(name=name, rollout=rollout, estimates=estimates, words=tuple(words))


def _evaluated(name: str, rollout: StoredRollout, result: EpisodeResult) -> ScoredRollout:
    last, said = float(rollout.times[-1]), result.probability
    text = f'success {said:.2f}' if isfinite(said) else 'abstains'
    return ScoredRollout(
        name=name,
        rollout=rollout,
        estimates={'imagined': ((last, said),)} if isfinite(said) else {},
        words=(
            (0.0, f'{result.task}: recorded {result.outcome}'),
            (last, f'{text}: {"; ".join(result.reasons)}'),
        ),
    )
