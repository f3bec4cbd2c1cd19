"""Who judges rollouts, and how well a judge's rates of policies agree with the simulator's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import nan
from typing import Any

import numpy as np

from mtv_world_ros.bench.ranking.rollout_jobs import Judged, Result
from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.lab.evaluation.metrics.policy_agreement import rate_agreement, rates
from mtv_world_ros.lab.evaluation.metrics.statistics import Interval


@dataclass(frozen=True, slots=True, kw_only=True)
class Judge:
    """One who says how likely a rollout succeeded.

    Attributes:
        title: in the table of what a picture is worth.
        column: head of its column in the optimism table; empty = it has none.
        episodes: what it judges, in the ranking's own tables; empty = it is not there.
    """

    title: str
    column: str = ''
    episodes: str = ''


#: the judge that sees the commands and the first frame alone
RULE = 'no_picture'
#: by field of a result
JUDGES: Mapping[str, Judge] = {
    'foreseen': Judge(title='foreseen motions alone'),
    'pictures': Judge(title='pictures alone (paper)'),
    'imagined': Judge(title='both', column='imagination', episodes='imagined episodes'),
    RULE: Judge(title='no-picture rule', column='no pictures'),
    'seen': Judge(
        title='real frames',
        column="simulator's frames",
        episodes="the same estimator on the simulator's frames",
    ),
}
#: words of those in the optimism table, and of those in the ranking's own tables
COLUMNS = {key: judge.column for key, judge in JUDGES.items() if judge.column}
REPORTED = {key: judge.episodes for key, judge in JUDGES.items() if judge.episodes}


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """How well one judge's success rates of policies agree with the simulator's.

    Attributes:
        value: score of the observed rates; NaN where it is not defined, e.g. all rates alike.
        noise_free: estimate of the score without the noise of few scenes; NaN where there is no
            interval.
        interval: 95 % interval of `noise_free`; NaN for too few scenes or policies.
        num_policies: with a rate in both.
    """

    value: float
    noise_free: float
    interval: Interval
    num_policies: int

    def as_json(self) -> dict[str, Any]:
        """Returns plain values."""
        return {
            'value': self.value,
            'noise_free': self.noise_free,
            'interval': self.interval,
            'num_policies': self.num_policies,
        }


def judged_by(result: Result, judge: str) -> Judged:
    """Returns the verdict of a judge, a key of `JUDGES`."""
    return getattr(result, judge)


def probabilities(results: Sequence[Result], judge: str) -> FloatArray:
    """Returns the (N,) estimates of a judge; NaN = it abstains."""
    return np.array([judged_by(r, judge).probability for r in results], dtype=np.float64)


def agreements(
    results: Sequence[Result], judge: str, policies: Sequence[str] = ()
) -> dict[str, Agreement]:
    """Returns Pearson's r and MMRV of a judge's rates over policies, by measure.

    Args:
        results: of the policies; those without a verdict do not count.
        judge: key of `JUDGES`.
        policies: in which order; default: as they come.
    """
    true = outcomes(results, lambda r: float(r.final), policies)
    judged = outcomes(results, lambda r: judged_by(r, judge).probability, policies)
    count = int((np.isfinite(rates(judged)) & np.isfinite(rates(true))).sum())
    return {
        name: Agreement(
            value=found.observed,
            noise_free=found.noise_free,
            interval=found.interval,
            num_policies=count,
        )
        for name, found in rate_agreement(judged, true).items()
    }


def outcomes(
    results: Sequence[Result], outcome: Callable[[Result], float], policies: Sequence[str] = ()
) -> FloatArray:
    """Returns (P, K, E) outcomes by policy, task and episode; NaN where there is none."""
    names = list(policies or dict.fromkeys(r.policy for r in results))
    tasks = list(dict.fromkeys(r.task for r in results))
    num_episodes = 1 + max((r.index for r in results), default=-1)
    table = np.full((len(names), len(tasks), num_episodes), nan)
    for r in results:
        table[names.index(r.policy), tasks.index(r.task), r.index] = outcome(r)
    return table
