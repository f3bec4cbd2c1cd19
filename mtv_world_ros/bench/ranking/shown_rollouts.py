"""Rollouts of a ranking, the worst first, for the viewer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from mtv_world_ros.bench.ranking.both_worlds import FRAMES
from mtv_world_ros.bench.ranking.rollout_cards import (
    estimate_text,
    rollout_file,
    verdict,
    when_they_part,
    worst_first,
)
from mtv_world_ros.bench.ranking.rollout_jobs import Result
from mtv_world_ros.bench.ranking.run_jobs import read_results
from mtv_world_ros.data.stored_rollout import load_rollout
from mtv_world_ros.viewing.scored_rollout import ScoredRollout

#: says that a folder is a ranking's
FILE = 'ranking.json'


def scored_rollouts(folder: Path, count: int) -> Iterator[ScoredRollout]:
    """Yields the worst rollouts of a ranking whose frames were kept, up to `count`.

    Raises:
        ConfigError: the folder is no ranking's.
        EpisodeError: frames cannot be read.
    """
    chosen = [r for r in worst_first(read_results(folder)) if _path(folder, r).is_file()]
    yield from (_ranked(folder, result) for result in chosen[:count])


def last_rollouts(folder: Path, results: Sequence[Result], count: int) -> Iterator[ScoredRollout]:
    """Yields the last `count` of the results whose frames were kept, in their order.

    Raises:
        EpisodeError: frames cannot be read.
    """
    kept = [result for result in results if _path(folder, result).is_file()]
    yield from (_ranked(folder, result) for result in kept[-count:])


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
    words.append(
        (last, f'imagined {estimate_text(result.imagined)}: {"; ".join(result.imagined.reasons)}')
    )
    name = f'{result.policy}/{result.task}_{result.index}'
    return ScoredRollout(name=name, rollout=rollout, estimates=estimates, words=tuple(words))
