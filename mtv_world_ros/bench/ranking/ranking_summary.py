"""What a ranking found: rates per policy and task, agreement, powered estimates, speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import isfinite, nan
from typing import Any

import numpy as np

from mtv_world_ros.bench.ranking.judges import (
    Agreement,
    agreements,
    judged_by,
    JUDGES,
    REPORTED,
    RULE,
)
from mtv_world_ros.bench.ranking.optimism import Optimism, Score
from mtv_world_ros.bench.ranking.rollout_jobs import Job, Result
from mtv_world_ros.lab.evaluation.metrics.policy_agreement import (
    powered_mean,
    PoweredMean,
)
from mtv_world_ros.lab.evaluation.metrics.statistics import (
    clustered_wilson,
    Interval,
    mean_interval,
    wilson,
)

#: label of all tasks together
ALL_TASKS = 'all tasks'


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """How often a policy succeeded.

    Attributes:
        hits: successes; as estimates expect them, their sum.
        count: rollouts with an outcome or estimate.
        num_unknown: without.
    """

    hits: float
    count: int
    num_unknown: int = 0

    @property
    def value(self) -> float:
        """Share of successes among the judged ones; NaN where there is none."""
        return self.hits / self.count if self.count else nan

    @property
    def interval(self) -> Interval:
        """95 % Wilson interval; of estimates, which scatter less than outcomes, a wide one."""
        return wilson(self.hits, self.count)

    def as_json(self) -> dict[str, Any]:
        """Returns plain values."""
        return {
            'rate': self.value,
            'interval': self.interval,
            'hits': self.hits,
            'judged': self.count,
            'unknown': self.num_unknown,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Gain:
    """How often imagination and the no-picture rule are right; an abstention is half right.

    Attributes:
        imagined: share of the rollouts.
        rule: share of the same rollouts.
        difference: of the two.
        interval: 95 % t interval of the difference over scenes; NaN where these are too few.
    """

    imagined: float
    rule: float
    difference: float
    interval: Interval


@dataclass(frozen=True)
class Summary:
    """A ranking's results as numbers.

    Attributes:
        results: one a rollout.
        failed: rollouts without a result, and why.
        num_true: episodes of each task whose true outcomes the powered estimates may use.
        provenance: what it was made with, by heading.
        optimism: the benchmark's numbers by checkpoint; empty = not asked for.
    """

    results: Sequence[Result]
    failed: Mapping[Job, str]
    num_true: int
    provenance: Mapping[str, str]
    optimism: Mapping[str, Optimism] = field(default_factory=dict)

    @cached_property
    def policies(self) -> tuple[str, ...]:
        """The best in the simulator first."""
        names = dict.fromkeys(result.policy for result in self.results)
        return tuple(sorted(names, key=lambda name: -self.true_rate(name, None).value))

    @cached_property
    def tasks(self) -> tuple[str, ...]:
        """In the order of the jobs."""
        return tuple(dict.fromkeys(result.task for result in self.results))

    def chosen(self, policy: str, task: str | None) -> list[Result]:
        """Returns a policy's results on a task; None = all."""
        return [r for r in self.results if r.policy == policy and task in (None, r.task)]

    def true_rate(self, policy: str, task: str | None) -> Rate:
        """Returns how often it really succeeded: the task was done at the end."""
        found = self.chosen(policy, task)
        return Rate(hits=sum(result.final for result in found), count=len(found))

    def judged_rate(self, policy: str, task: str | None, judge: str) -> Rate:
        """Returns how often it succeeds by the estimates, their mean; NaN is counted apart."""
        found = [judged_by(result, judge).probability for result in self.chosen(policy, task)]
        known = [value for value in found if isfinite(value)]
        return Rate(hits=sum(known), count=len(known), num_unknown=len(found) - len(known))

    def agreement(self, judge: str, task: str | None) -> dict[str, Agreement]:
        """Returns r and MMRV of a judge's rates with the simulator's, over the policies."""
        return self._agreements[judge, task]

    @cached_property
    def worth(self) -> dict[str, dict[str, Score]]:
        """What each judge's word is worth, by measure: foreseen motions, pictures, both, ..."""
        found = Optimism(results=self.results, flips={})
        return {judge: found.scores(judge) for judge in JUDGES}

    @cached_property
    def rule_agreement(self) -> dict[str, Agreement]:
        """Agreement of the no-picture rule's rates, all tasks."""
        return self._agreement(RULE, None)

    @cached_property
    def gain_over_rule(self) -> Gain:
        """How much more often imagination is right than the no-picture rule, by scene."""
        scenes: dict[tuple[str, int], list[tuple[float, float]]] = {}
        for result in self.results:
            pair = _rightness(result, 'imagined'), _rightness(result, RULE)
            scenes.setdefault((result.task, result.index), []).append(pair)
        sums = np.array([np.sum(np.subtract.reduce(np.array(s), axis=1)) for s in scenes.values()])
        counts = np.array([float(len(pairs)) for pairs in scenes.values()])
        mean, ends = mean_interval(sums[:, None], counts[:, None], low=-1.0, high=1.0)
        shares = np.mean([pair for pairs in scenes.values() for pair in pairs], axis=0)
        return Gain(
            imagined=float(shares[0]),
            rule=float(shares[1]),
            difference=float(mean[0]),
            interval=(float(ends[0, 0]), float(ends[1, 0])),
        )

    @cached_property
    def _agreements(self) -> dict[tuple[str, str | None], dict[str, Agreement]]:
        groups = (None, *self.tasks)
        return {
            (judge, task): self._agreement(judge, task) for judge in REPORTED for task in groups
        }

    def _agreement(self, judge: str, task: str | None) -> dict[str, Agreement]:
        results = [r for r in self.results if task in (None, r.task)]
        return agreements(results, judge, self.policies)

    def powered(self, policy: str) -> PoweredMean:
        """Returns the success rate from few true outcomes and all imagined ones, all tasks.

        An abstention counts as probability one half: leaving it out would bias the estimate.
        """
        found = self.chosen(policy, None)
        true = [result for result in found if result.index < self.num_true]
        more = [result for result in found if result.index >= self.num_true]
        return powered_mean(
            [float(result.final) for result in true], _expected(true), _expected(more)
        )

    def abstained(self, judge: str) -> Rate:
        """Returns how often a judge gave no verdict."""
        missing = sum(not isfinite(judged_by(r, judge).success) for r in self.results)
        return Rate(hits=missing, count=len(self.results))

    def confusion(self, judge: str) -> dict[str, int]:
        """Returns how estimates and true outcomes go together, by `said_true`."""
        counts = {'success_success': 0, 'success_failure': 0}
        counts |= {'failure_success': 0, 'failure_failure': 0}
        words = {True: 'success', False: 'failure'}
        for result in self.results:
            said = judged_by(result, judge).success
            if isfinite(said):
                counts[f'{words[bool(said)]}_{words[result.final]}'] += 1
        return counts

    def false_success_interval(self, judge: str) -> Interval:
        """Returns the interval of the share of real failures that were called a success.

        Policies that meet the same scene are a cluster.
        """
        scenes: dict[tuple[str, int], list[float]] = {}
        for result in self.results:
            said = judged_by(result, judge).success
            if isfinite(said) and not result.final:
                scenes.setdefault((result.task, result.index), []).append(said)
        hits = [sum(said) for said in scenes.values()]
        return clustered_wilson(np.array(hits), np.array([len(s) for s in scenes.values()]))

    def speed(self) -> dict[str, float]:
        """Returns episodes an hour of one process, and seconds an episode by stage."""
        stages = sorted({stage for result in self.results for stage in result.seconds})
        mean = {
            f'seconds, {stage}': float(np.mean([r.seconds.get(stage, 0.0) for r in self.results]))
            for stage in stages
        }
        physics, pictures, imagining = (
            mean.get(f'seconds, {stage}', 0.0) for stage in ('physics', 'rendering', 'imagining')
        )
        return {
            'imagined episodes an hour': _an_hour(imagining),
            'simulated episodes an hour, with pictures': _an_hour(physics + pictures),
            'simulated episodes an hour, physics alone': _an_hour(physics),
            **mean,
        }

    def as_json(self) -> dict[str, Any]:
        """Returns everything as plain values, NaN where not known."""
        groups = {ALL_TASKS: None, **{task: task for task in self.tasks}}
        return {
            'policies': {name: self._policy_json(name, groups) for name in self.policies},
            'agreement': {
                judge: {
                    label: {k: v.as_json() for k, v in self.agreement(judge, task).items()}
                    for label, task in groups.items()
                }
                for judge in REPORTED
            },
            'abstained': {judge: self.abstained(judge).as_json() for judge in REPORTED},
            'confusion': {judge: self.confusion(judge) for judge in REPORTED},
            'speed': self.speed(),
            'worth': {
                judge: {measure: score.as_json() for measure, score in scores.items()}
                for judge, scores in self.worth.items()
            },
            'optimism': {name: found.as_json() for name, found in self.optimism.items()},
            'num_true_for_powered': self.num_true,
            'num_rollouts': len(self.results),
            'num_cut_off_by_limit': sum(not result.is_over for result in self.results),
            'failed': {job.name: reason for job, reason in self.failed.items()},
            'provenance': dict(self.provenance),
        }

    def _policy_json(self, policy: str, groups: Mapping[str, str | None]) -> dict[str, Any]:
        powered = self.powered(policy)
        return {
            'rates': {
                label: {
                    'simulator': self.true_rate(policy, task).as_json(),
                    **{j: self.judged_rate(policy, task, j).as_json() for j in REPORTED},
                }
                for label, task in groups.items()
            },
            'powered': {
                'value': powered.value,
                'interval': powered.interval,
                'weight': powered.weight,
                'num_true': powered.num_true,
                'num_more': powered.num_more,
            },
        }


def _rightness(result: Result, judge: str) -> float:
    said = judged_by(result, judge).success
    return float(said == result.final) if isfinite(said) else 0.5


def _expected(results: Sequence[Result]) -> list[float]:
    found = [result.imagined.probability for result in results]
    return [value if isfinite(value) else 0.5 for value in found]


def _an_hour(seconds: float) -> float:
    return 3600 / seconds if seconds > 0 else nan
