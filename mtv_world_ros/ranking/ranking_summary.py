"""Results of a ranking: rates per policy and task, agreement, powered estimates, speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import isfinite, nan
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.evaluation.metrics.policy_agreement import powered_mean, PoweredMean
from mtv_world_ros.evaluation.metrics.statistics import mean_interval
from mtv_world_ros.ranking.flips import find_flips
from mtv_world_ros.ranking.jobs import Job, Result
from mtv_world_ros.ranking.judges import (
    agreements,
    false_success,
    has_verdict,
    judged_by,
    JUDGES,
    kinds_of,
    REPORTED,
    RULE,
    Score,
    scores,
    true_rate,
)
from mtv_world_ros.ranking.policy_order import PolicyOrder
from mtv_world_ros.simulation.faults.catalogue import EXPERT, in_order

#: label of all tasks together
ALL_TASKS = 'all tasks'


@dataclass(frozen=True)
class Optimism:
    """Scores of all judges over a ranking's rollouts and over those of each fault kind.

    Attributes:
        results: results of the rollouts; those of the policy `expert` are the reference.
        flips: verdicts on rollouts whose true outcome differs from the expert's in the same scene,
            by name of the rollout: whether the imagined last frame is nearer to what really
            happened than to what happened under the expert's commands, where objects are in
            either. Arms do not count: they follow the commands in imagination as well.
    """

    results: Sequence[Result]
    flips: Mapping[str, bool]

    @classmethod
    def of(cls, results: Sequence[Result], folder: Path) -> Optimism:
        """Return the numbers of results whose last frames lie in a folder."""
        return cls(results=results, flips=find_flips(results, folder))

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """The policies' fault kinds, in the catalogue's order."""
        return tuple(in_order({kind for result in self.results for kind in kinds_of(result)}))

    def rollouts(self, kind: str | None) -> list[Result]:
        """Return the rollouts of policies with a fault kind; None = all rollouts."""
        return [r for r in self.results if kind is None or kind in kinds_of(r)]

    def scores(self, judge: str, kind: str | None = None) -> dict[str, Score]:
        """Return the `MEASURES` of a judge.

        Args:
            judge: key of `JUDGES`.
            kind: kind of the policies' faults; None = all. r, MMRV and AUROC of a kind are over
                its policies and the expert.
        """
        chosen = self.rollouts(kind)
        compared = [
            r for r in self.results if kind is None or r.policy == EXPERT or kind in kinds_of(r)
        ]
        return scores(chosen, compared, judge, self.flips)

    def as_json(self) -> dict[str, Any]:
        """Return everything as plain values."""
        groups = {'all': None, **{kind: kind for kind in self.kinds}}
        return {
            group: {
                'rollouts': len(self.rollouts(kind)),
                'true_success': true_rate(self.rollouts(kind)).as_json(),
                **{judge: _plain(self.scores(judge, kind)) for judge in JUDGES},
            }
            for group, kind in groups.items()
        }


@dataclass(frozen=True)
class Summary:
    """A ranking's results as numbers.

    Attributes:
        results: results of the rollouts.
        failed: rollouts without a result, and why.
        num_true: episodes of each task whose true outcomes the powered estimates may use.
        provenance: command, checkpoint and machine, by heading.
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
        """Names of the tasks, in the order of the jobs."""
        return tuple(dict.fromkeys(result.task for result in self.results))

    @cached_property
    def order(self) -> PolicyOrder:
        """The order of the policies by rollouts of one scene under common futures."""
        return PolicyOrder.of(self.results)

    def chosen(self, policy: str, task: str | None) -> list[Result]:
        """Return a policy's results on a task; None = all."""
        return [r for r in self.results if r.policy == policy and task in (None, r.task)]

    def true_rate(self, policy: str, task: str | None) -> Score:
        """Return how often it succeeded in the simulator: the task was done at the end."""
        found = self.chosen(policy, task)
        return Score.rate(sum(result.final for result in found), len(found))

    def judged_rate(self, policy: str, task: str | None, judge: str) -> Score:
        """Return how often it succeeds by the estimates, their mean; NaN is counted apart."""
        found = [judged_by(result, judge).probability for result in self.chosen(policy, task)]
        known = [value for value in found if isfinite(value)]
        return Score.rate(sum(known), len(known), len(found) - len(known))

    def agreement(self, judge: str, task: str | None) -> dict[str, Score]:
        """Return r and MMRV of a judge's rates with the simulator's, over the policies."""
        if (judge, task) not in self._agreements:
            results = [r for r in self.results if task in (None, r.task)]
            self._agreements[judge, task] = agreements(results, judge, self.policies)
        return self._agreements[judge, task]

    @cached_property
    def _agreements(self) -> dict[tuple[str, str | None], dict[str, Score]]:
        return {}

    @cached_property
    def worth(self) -> dict[str, dict[str, Score]]:
        """Scores of each judge, by measure."""
        return {judge: scores(self.results, self.results, judge) for judge in JUDGES}

    @cached_property
    def gain_over_rule(self) -> tuple[float, float, Score]:
        """Accuracy of imagination, accuracy of the no-picture rule, and their difference by scene.

        An abstention is half right. The difference has a t interval over scenes, NaN where these
        are too few.
        """
        scenes: dict[tuple[str, int], list[tuple[float, float]]] = {}
        for result in self.results:
            pair = _rightness(result, 'imagined'), _rightness(result, RULE)
            scenes.setdefault((result.task, result.index), []).append(pair)
        sums = np.array([np.sum(np.subtract.reduce(np.array(s), axis=1)) for s in scenes.values()])
        counts = np.array([float(len(pairs)) for pairs in scenes.values()])
        mean, ends = mean_interval(sums[:, None], counts[:, None], low=-1.0, high=1.0)
        shares = np.mean([pair for pairs in scenes.values() for pair in pairs], axis=0)
        interval = float(ends[0, 0]), float(ends[1, 0])
        gain = Score(value=float(mean[0]), interval=interval, count=len(self.results))
        return float(shares[0]), float(shares[1]), gain

    def powered(self, policy: str) -> PoweredMean:
        """Return the success rate from few true outcomes and all imagined ones, all tasks.

        An abstention counts as probability one half: leaving it out would bias the estimate.
        """
        found = self.chosen(policy, None)
        true = [result for result in found if result.index < self.num_true]
        more = [result for result in found if result.index >= self.num_true]
        return powered_mean(
            [float(result.final) for result in true], _expected(true), _expected(more)
        )

    def abstained(self, judge: str) -> Score:
        """Return how often a judge gave no verdict."""
        missing = sum(not has_verdict(result, judge) for result in self.results)
        return Score.rate(missing, len(self.results))

    def confusion(self, judge: str) -> dict[str, int]:
        """Return how estimates and true outcomes go together, by `said_true`."""
        counts = {'success_success': 0, 'success_failure': 0}
        counts |= {'failure_success': 0, 'failure_failure': 0}
        words = {True: 'success', False: 'failure'}
        for result in self.results:
            said = judged_by(result, judge).success
            if isfinite(said):
                counts[f'{words[bool(said)]}_{words[result.final]}'] += 1
        return counts

    def false_success(self, judge: str) -> Score:
        """Return the share of true failures that were called a success."""
        return false_success(self.results, judge)

    def speed(self) -> dict[str, float]:
        """Return episodes an hour of one process, and seconds an episode by stage."""
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
        """Return everything as plain values, NaN where not known."""
        groups = {ALL_TASKS: None, **{task: task for task in self.tasks}}
        return {
            'order': self.order.as_json(),
            'policies': {name: self._policy_json(name, groups) for name in self.policies},
            'agreement': {
                judge: {
                    label: _agreement_json(self.agreement(judge, task))
                    for label, task in groups.items()
                }
                for judge in REPORTED
            },
            'abstained': {judge: self.abstained(judge).rate_json() for judge in REPORTED},
            'confusion': {judge: self.confusion(judge) for judge in REPORTED},
            'speed': self.speed(),
            'worth': {judge: _plain(found) for judge, found in self.worth.items()},
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
                    'simulator': self.true_rate(policy, task).rate_json(),
                    **{j: self.judged_rate(policy, task, j).rate_json() for j in REPORTED},
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


def _plain(found: Mapping[str, Score]) -> dict[str, Any]:
    return {measure: score.as_json() for measure, score in found.items()}


def _agreement_json(found: Mapping[str, Score]) -> dict[str, Any]:
    return {
        name: {
            'value': found[name].value,
            'noise_free': found[f'{name}_noise_free'].value,
            'interval': found[f'{name}_noise_free'].interval,
            'num_policies': found[name].count,
        }
        for name in ('pearson', 'mmrv')
    }


def _rightness(result: Result, judge: str) -> float:
    said = judged_by(result, judge).success
    return float(said == result.final) if isfinite(said) else 0.5


def _expected(results: Sequence[Result]) -> list[float]:
    found = [result.imagined.probability for result in results]
    return [value if isfinite(value) else 0.5 for value in found]


def _an_hour(seconds: float) -> float:
    return 3600 / seconds if seconds > 0 else nan
