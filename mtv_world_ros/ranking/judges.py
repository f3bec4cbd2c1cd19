"""Judges of rollouts and their scores: rates, agreement with the simulator, AUROC."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, nan
from typing import Any

import numpy as np
from scipy.special import expit, logit

from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.evaluation.metrics.policy_agreement import rate_agreement, rates
from mtv_world_ros.evaluation.metrics.statistics import (
    clustered_wilson,
    Interval,
    MIN_SCENES,
    t_quantile,
    UNKNOWN,
    wilson,
)
from mtv_world_ros.ranking.jobs import Result, StoredEstimate
from mtv_world_ros.simulation.faults.catalogue import FAULTS, parse_variant


@dataclass(frozen=True, slots=True, kw_only=True)
class Judge:
    """Estimator of the success of a rollout.

    Attributes:
        title: heading of its row in the table of what a picture is worth.
        column: head of its column in the optimism table; empty = it has none.
        episodes: words for the rollouts that it judges, in the ranking's own tables; empty = it is
            not there.
    """

    title: str
    column: str = ''
    episodes: str = ''


#: the judge that sees the commands and the first frame alone
RULE = 'no_picture'
#: judges by field of a result
JUDGES: Mapping[str, Judge] = {
    'foreseen': Judge(title='foreseen motions alone'),
    'pictures': Judge(title='pictures alone'),
    'imagined': Judge(title='both', column='imagination', episodes='imagined episodes'),
    RULE: Judge(title='no-picture rule', column='no pictures'),
    'seen': Judge(
        title='real frames',
        column="simulator's frames",
        episodes="the same estimator on the simulator's frames",
    ),
}
#: headings of judges in the optimism table; in `REPORTED`, in the ranking's own tables
COLUMNS = {key: judge.column for key, judge in JUDGES.items() if judge.column}
REPORTED = {key: judge.episodes for key, judge in JUDGES.items() if judge.episodes}
#: scores of a judge, in the order of the tables
MEASURES = {
    'pearson': 'r observed',
    'pearson_noise_free': 'r noise-free',
    'mmrv': 'MMRV observed',
    'mmrv_noise_free': 'MMRV noise-free',
    'auroc': 'AUROC',
    'false_success': 'false success',
    'abstention': 'no verdict',
    'contact_flips': 'flips, contact',
    'flips': 'flips, all',
    'over_rule': 'AUROC - rule',
}
Scene = tuple[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """A number, its 95 % interval and the number of cases behind it; NaN = not defined.

    Attributes:
        value: the number.
        interval: 95 % interval of the number.
        count: policies, rollouts, failures or flips, depending on the measure.
        hits: successes of a rate; of estimates, their sum.
        num_unknown: rollouts of a rate without an estimate.
    """

    value: float = nan
    interval: Interval = UNKNOWN
    count: int = 0
    hits: float = nan
    num_unknown: int = 0

    @classmethod
    def rate(cls, hits: float, count: int, num_unknown: int = 0) -> Score:
        """Return a rate with Wilson's interval, a wide one where hits are a sum of estimates."""
        return cls(
            value=hits / count if count else nan,
            interval=wilson(hits, count),
            count=count,
            hits=hits,
            num_unknown=num_unknown,
        )

    @classmethod
    def share(cls, results: Sequence[Result], is_hit: Callable[[Result], bool]) -> Score:
        """Return the share of hits among rollouts; rollouts of one scene are a cluster."""
        counts: dict[Scene, list[bool]] = {}
        for result in results:
            counts.setdefault((result.task, result.index), []).append(is_hit(result))
        hits = np.array([sum(found) for found in counts.values()], np.float64)
        trials = np.array([len(found) for found in counts.values()], np.float64)
        return cls(
            value=float(hits.sum() / trials.sum()) if len(results) else nan,
            interval=clustered_wilson(hits, trials),
            count=len(results),
        )

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {'value': self.value, 'interval': self.interval, 'count': self.count}

    def rate_json(self) -> dict[str, Any]:
        """Return plain values of a rate."""
        return {
            'rate': self.value,
            'interval': self.interval,
            'hits': self.hits,
            'judged': self.count,
            'unknown': self.num_unknown,
        }


def judged_by(result: Result, judge: str) -> StoredEstimate:
    """Return the verdict of a judge, a key of `JUDGES`."""
    return getattr(result, judge)


def has_verdict(result: Result, judge: str) -> bool:
    """Return whether a judge says success or failure."""
    return isfinite(judged_by(result, judge).success)


def kinds_of(result: Result) -> tuple[str, ...]:
    """Return the fault kinds of the policy."""
    return parse_variant(result.policy).kinds


def is_contact(result: Result) -> bool:
    """Return whether all faults of the policy are of contact: the arm's path does not tell."""
    return all(FAULTS[kind].contact for kind in kinds_of(result))


def true_rate(results: Sequence[Result]) -> Score:
    """Return how often rollouts succeed in the simulator."""
    return Score.share(results, lambda r: r.final)


def false_success(results: Sequence[Result], judge: str) -> Score:
    """Return the share of true failures with a verdict that a judge calls a success."""
    failed = [r for r in results if not r.final and has_verdict(r, judge)]
    return Score.share(failed, lambda r: judged_by(r, judge).success == 1)


def agreements(
    results: Sequence[Result], judge: str, policies: Sequence[str] = ()
) -> dict[str, Score]:
    """Return Pearson's r and MMRV of a judge's rates over policies: observed, and noise-free.

    Args:
        results: the rollouts of the policies; those without a verdict do not count.
        judge: key of `JUDGES`.
        policies: order of the policies; default: as they come.
    """
    true = outcomes(results, lambda r: float(r.final), policies)
    judged = outcomes(results, lambda r: judged_by(r, judge).probability, policies)
    count, found = int((np.isfinite(rates(judged)) & np.isfinite(rates(true))).sum()), {}
    for name, one in rate_agreement(judged, true).items():
        found[name] = Score(value=one.observed, count=count)
        found[f'{name}_noise_free'] = Score(
            value=one.noise_free, interval=one.interval, count=count
        )
    return found


def outcomes(
    results: Sequence[Result], outcome: Callable[[Result], float], policies: Sequence[str] = ()
) -> FloatArray:
    """Return (P, K, E) outcomes by policy, task and episode; NaN where there is none."""
    names = list(policies or dict.fromkeys(r.policy for r in results))
    tasks = list(dict.fromkeys(r.task for r in results))
    num_episodes = 1 + max((r.index for r in results), default=-1)
    table = np.full((len(names), len(tasks), num_episodes), nan)
    for r in results:
        table[names.index(r.policy), tasks.index(r.task), r.index] = outcome(r)
    return table


def scores(
    results: Sequence[Result],
    compared: Sequence[Result],
    judge: str,
    flips: Mapping[str, bool] | None = None,
) -> dict[str, Score]:
    """Return the `MEASURES` of a judge, and how many of the verdicts are right.

    Args:
        results: rollouts that shares are of.
        compared: rollouts that r, MMRV and AUROC are over.
        judge: key of `JUDGES`.
        flips: see `Optimism.flips`; only those of `imagined` are known.
    """
    given = flips if flips is not None and judge == 'imagined' else {}
    flipped = [r for r in results if r.name in given]
    of_contact = [r for r in flipped if is_contact(r)]
    said = {call: [r for r in results if judged_by(r, judge).success == call] for call in (0, 1)}
    return {
        **agreements(compared, judge),
        'auroc': _area(compared, judge),
        'auroc_all': _area_of_all(compared, judge),
        'right_success': Score.share(said[1], lambda r: r.final),
        'right_failure': Score.share(said[0], lambda r: not r.final),
        'false_success': false_success(results, judge),
        'abstention': Score.share(results, lambda r: not has_verdict(r, judge)),
        'contact_flips': Score.share(of_contact, lambda r: given[r.name]),
        'flips': Score.share(flipped, lambda r: given[r.name]),
        'over_rule': Score() if judge == RULE else _area(compared, judge, RULE),
    }


def _area(results: Sequence[Result], *judges: str) -> Score:
    """Area under the ROC of the first judge, less the second one's, where all give an estimate."""
    known = [r for r in results if all(isfinite(judged_by(r, j).probability) for j in judges)]
    real = np.array([r.final for r in known], np.bool_)
    if real.all() or not real.any():
        return Score(count=len(known))
    said = [np.array([judged_by(r, j).probability for r in known], np.float64) for j in judges]
    value, interval = area_interval(said, real, [(r.task, r.index) for r in known])
    return Score(value=value, interval=interval, count=len(known))


def _area_of_all(results: Sequence[Result], judge: str) -> Score:
    """Area under the ROC of all rollouts, with an estimate of .5 where there is no verdict."""
    real = np.array([r.final for r in results], np.bool_)
    if real.all() or not real.any():
        return Score(count=len(results))
    judged = [judged_by(r, judge) for r in results]
    said = np.array([one.probability if isfinite(one.success) else 0.5 for one in judged])
    value, interval = area_interval([said], real, [(r.task, r.index) for r in results])
    return Score(value=value, interval=interval, count=len(results))


def area_interval(
    said: Sequence[FloatArray], real: BoolArray, scenes: Sequence[Scene]
) -> tuple[float, Interval]:
    """Return the area under the ROC and its 95 % t interval, from a jackknife over scenes.

    Args:
        said: (N,) estimates; of two, the first area less the second one is taken.
        real: (N,) true outcomes.
        scenes: scene of each of the N rollouts; all of a scene are left out together.

    Returns:
        The area, its interval on the logit scale (of a difference: as it is); NaN for fewer than
        `MIN_SCENES` scenes, or where no scene makes a difference.
    """
    names = list(dict.fromkeys(scenes))
    number = np.array([names.index(scene) for scene in scenes])
    weights = np.concatenate([np.ones((1, len(scenes))), np.arange(len(names))[:, None] != number])
    areas = [areas_under_roc(one, real, weights.astype(np.float64)) for one in said]
    found = areas[0] if len(areas) == 1 else areas[0] - areas[1]
    value, rest = float(found[0]), found[1:][np.isfinite(found[1:])]
    num = len(rest)
    error = np.sqrt((num - 1) / max(num, 1) * ((rest - rest.mean()) ** 2).sum()) if num else 0.0
    if num < MIN_SCENES or error < 1e-9:
        return value, UNKNOWN
    half = float(t_quantile(num - 1)) * error
    if len(areas) > 1:
        return value, (max(value - half, -1.0), min(value + half, 1.0))
    inner = np.clip(value, 0.5 / len(real), 1 - 0.5 / len(real))
    half /= inner * (1 - inner)
    low, high = expit(logit(inner) + np.array([-half, half]))
    return value, (min(float(low), value), max(float(high), value))


def areas_under_roc(said: FloatArray, real: BoolArray, weights: FloatArray) -> FloatArray:
    """Return (R,) areas under the ROC of (N,) estimates for weights (R, N), ties half."""
    gained, lost = said[real][:, None], said[~real][None]
    above = (gained > lost) + 0.5 * (gained == lost)
    up, down = weights[:, real], weights[:, ~real]
    with np.errstate(invalid='ignore', divide='ignore'):
        return ((up @ above) * down).sum(1) / (up.sum(1) * down.sum(1))
