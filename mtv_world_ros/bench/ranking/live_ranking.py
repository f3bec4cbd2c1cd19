"""A ranking while it runs: rates so far and the last rollouts in the viewer."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from mtv_world_ros.bench.ranking.rollout_jobs import Result
from mtv_world_ros.bench.ranking.shown_rollouts import last_rollouts
from mtv_world_ros.viewing import rerun_log
from mtv_world_ros.viewing.scored_rollout import ScoredRollout

#: path of the table, and the name of its tab
TABLE = '/rates so far'
#: rollouts that have a tab; earlier ones stay in the viewer's list
_MAX_TABS = 8


class LiveRanking:
    """Shows results as they come.

    Args:
        stream: recording of the viewer, which is served or saved already.
        folder: of the ranking.
        file: that is written; None = a page for browsers.
    """

    def __init__(self, stream: Any, folder: Path, file: Path | None = None) -> None:
        self._stream, self._folder, self._file = stream, folder, file
        self._results: list[Result] = []
        self._tabs: dict[str, ScoredRollout] = {}

    def add(self, results: Sequence[Result]) -> None:
        """Shows rollouts that have ended; of many the last ones and the rates of all."""
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
    """Returns Markdown: a row a policy, how often it succeeds in the simulator and imagined."""
    lines = ['| policy | rollouts | simulator | imagined | no estimate |', '|---|---|---|---|---|']
    for policy in dict.fromkeys(result.policy for result in results):
        own = [result for result in results if result.policy == policy]
        said = [r.imagined.probability for r in own if isfinite(r.imagined.probability)]
        imagined = f'{sum(said) / len(said):.2f}' if said else '–'
        true = f'{sum(result.final for result in own) / len(own):.2f}'
        lines.append(f'| {policy} | {len(own)} | {true} | {imagined} | {len(own) - len(said)} |')
    return '\n'.join(lines)
