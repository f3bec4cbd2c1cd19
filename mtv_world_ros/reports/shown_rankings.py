"""A ranking in the viewer: its rollouts, the worst first, or those that end while it runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from mtv_world_ros.ranking.both_worlds import FRAMES
from mtv_world_ros.ranking.jobs import Result
from mtv_world_ros.ranking.run_jobs import read_results
from mtv_world_ros.reports.result_cards import (
    estimate_text,
    result_file,
    verdict,
    when_they_part,
    worst_first,
)
from mtv_world_ros.viewing import rerun_log
from mtv_world_ros.viewing.scored_rollout import ScoredRollout
from mtv_world_ros.viewing.stored_rollout import load_rollout

#: name of the file that marks the folder of a ranking
FILE = 'ranking.json'
#: path of the table, and the name of its tab
TABLE = '/rates so far'
#: maximum number of rollouts with a tab; earlier ones stay in the viewer's list
_MAX_TABS = 8


def scored_rollouts(folder: Path, count: int) -> Iterator[ScoredRollout]:
    """Yield the worst rollouts of a ranking whose frames were kept, up to `count`.

    Raises:
        ConfigError: the folder is no ranking's.
        EpisodeError: frames cannot be read.
    """
    chosen = [r for r in worst_first(read_results(folder)) if _path(folder, r).is_file()]
    yield from (_ranked(folder, result) for result in chosen[:count])


def last_rollouts(folder: Path, results: Sequence[Result], count: int) -> Iterator[ScoredRollout]:
    """Yield the last `count` of the results whose frames were kept, in their order.

    Raises:
        EpisodeError: frames cannot be read.
    """
    kept = [result for result in results if _path(folder, result).is_file()]
    yield from (_ranked(folder, result) for result in kept[-count:])


def _path(folder: Path, result: Result) -> Path:
    return result_file(folder, result, FRAMES)


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


class LiveRanking:
    """Shows results as they come.

    Args:
        stream: recording of the viewer, which is served or saved already.
        folder: folder of the ranking.
        file: path of the file that is written; None = a page for browsers.
    """

    def __init__(self, stream: Any, folder: Path, file: Path | None = None) -> None:
        self._stream, self._folder, self._file = stream, folder, file
        self._results: list[Result] = []
        self._tabs: dict[str, ScoredRollout] = {}

    def add(self, results: Sequence[Result]) -> None:
        """Show rollouts that have ended; of many the last ones and the rates of all."""
        import rerun

        self._results += results
        table = rerun.TextDocument(rates_table(self._results), media_type='text/markdown')
        self._stream.log(rerun_log.escaped(TABLE), table, static=True)
        for shown in last_rollouts(self._folder, results, _MAX_TABS):
            rerun_log.log_any(self._stream, shown, f'/{shown.name}')
            self._tabs[f'/{shown.name}'] = shown
        self._tabs = dict(list(self._tabs.items())[-_MAX_TABS:])
        self._stream.send_blueprint(
            rerun_log.layout(self._tabs, table=TABLE, active=len(self._tabs))
        )
        rerun_log.flush(self._stream, self._file)


def rates_table(results: Sequence[Result]) -> str:
    """Return Markdown: a row a policy, how often it succeeds in the simulator and imagined."""
    lines = ['| policy | rollouts | simulator | imagined | no estimate |', '|---|---|---|---|---|']
    for policy in dict.fromkeys(result.policy for result in results):
        own = [result for result in results if result.policy == policy]
        said = [r.imagined.probability for r in own if isfinite(r.imagined.probability)]
        imagined = f'{sum(said) / len(said):.2f}' if said else '–'
        true = f'{sum(result.final for result in own) / len(own):.2f}'
        lines.append(f'| {policy} | {len(own)} | {true} | {imagined} | {len(own) - len(said)} |')
    return '\n'.join(lines)
