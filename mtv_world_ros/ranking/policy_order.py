"""Order of policies by pairs of rollouts of one scene under common futures.

Where contact was never fitted, estimates of single rollouts are mostly open. Rollouts of one scene
meet the same futures, and which of two policies does better under them can often be told.

P policies, S scenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from math import nan
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import betainc, expit

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.evaluation.metrics.statistics import Interval, MIN_SCENES, t_quantile, UNKNOWN
from mtv_world_ros.ranking.jobs import Result
from mtv_world_ros.success.comparison import ComparedPair, Comparison

#: least probability that a policy is better in most scenes that tell, of an ordered pair
MIN_CONFIDENCE = 0.95
#: least number of scenes that order a pair, all for one policy: 1 - 0.5^(4 + 1) > MIN_CONFIDENCE
MIN_TELLING = 4
#: prior standard deviation of a strength in the Bradley-Terry model, in log odds
PRIOR_DEVIATION = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyPair:
    """Two policies in the scenes that both met under common futures.

    Attributes:
        first: name of the one policy.
        second: name of the other policy.
        num_first: number of scenes in which the first policy's rollout is better.
        num_second: number of scenes in which the second policy's rollout is better.
        num_scenes: number of scenes, including those that do not tell.
    """

    first: str
    second: str
    num_first: int
    num_second: int
    num_scenes: int

    @property
    def leader(self) -> str:
        """Policy that is better in more scenes; empty = neither."""
        if self.num_first == self.num_second:
            return ''
        return self.first if self.num_first > self.num_second else self.second

    @property
    def confidence(self) -> float:
        """Probability that the leader is better in most scenes that tell.

        A beta posterior of the share of these scenes, with a uniform prior; a scene counts once.
        """
        more, less = sorted((self.num_first, self.num_second), reverse=True)
        return float(1 - betainc(more + 1, less + 1, 0.5))

    @property
    def better(self) -> str:
        """The better policy; empty = not told."""
        return self.leader if self.confidence >= MIN_CONFIDENCE else ''

    def other(self, policy: str) -> str:
        """Return the policy of the pair that is not the given one."""
        return self.second if policy == self.first else self.first


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyOrder:
    """Partial order of policies.

    Attributes:
        policies: P names, the strongest first.
        strengths: (P,) probability that a policy is better than a policy of mean strength, in a
            scene that tells (Bradley-Terry).
        intervals: 95 % intervals of the strengths; NaN with few scenes.
        pairs: all pairs with a common scene.
        num_scenes: number of scenes with common futures of two policies or more.
        num_without: number of rollouts of which nothing is foreseen.
        is_fitted: contact parameters were fitted in the robot cell of all rollouts.
    """

    policies: tuple[str, ...]
    strengths: tuple[float, ...]
    intervals: tuple[Interval, ...]
    pairs: tuple[PolicyPair, ...]
    num_scenes: int
    num_without: int
    is_fitted: bool

    @classmethod
    def of(cls, results: Sequence[Result]) -> PolicyOrder:
        """Return the order of the policies of rollouts.

        Args:
            results: rollouts; those of one task and episode begin at the same first picture.
        """
        names = list(dict.fromkeys(result.policy for result in results))
        scenes: dict[tuple[str, int], list[Result]] = {}
        for result in results:
            scenes.setdefault((result.task, result.index), []).append(result)
        # wins[s, p, q]: policy p is better than q in scene s
        wins = np.zeros((len(scenes), len(names), len(names)))
        met = np.zeros(wins.shape, np.bool_)
        for number, scene in enumerate(scenes.values()):
            for one, other in combinations(scene, 2):
                pair = names.index(one.policy), names.index(other.policy)
                compared = compare_rollouts(one, other)
                if compared is None:
                    continue
                met[number][pair] = met[number][pair[::-1]] = True
                if compared.better is not None:
                    wins[number][pair if compared.better == 0 else pair[::-1]] = 1
        strengths, intervals = bradley_terry(wins)
        ranks = sorted(range(len(names)), key=lambda p: -strengths[p])
        total, num_met = wins.sum(0).astype(int), met.sum(0)
        known = [result.futures for result in results if result.futures is not None]
        return cls(
            policies=tuple(names[p] for p in ranks),
            strengths=tuple(strengths[p] for p in ranks),
            intervals=tuple(intervals[p] for p in ranks),
            pairs=tuple(
                PolicyPair(
                    first=names[p],
                    second=names[q],
                    num_first=int(total[p, q]),
                    num_second=int(total[q, p]),
                    num_scenes=int(num_met[p, q]),
                )
                for p, q in combinations(ranks, 2)
                if num_met[p, q]
            ),
            num_scenes=int(met.any((1, 2)).sum()),
            num_without=len(results) - len(known),
            is_fitted=all(futures.is_fitted for futures in known),
        )

    def as_json(self) -> dict[str, Any]:
        """Return plain values, NaN where not known."""
        return {
            'policies': {
                name: {'strength': strength, 'interval': interval}
                for name, strength, interval in zip(
                    self.policies, self.strengths, self.intervals, strict=True
                )
            },
            'pairs': [
                {**asdict(pair), 'better': pair.better, 'confidence': pair.confidence}
                for pair in self.pairs
            ],
            'num_scenes': self.num_scenes,
            'num_without': self.num_without,
            'is_fitted': self.is_fitted,
        }

    @property
    def num_ordered(self) -> int:
        """Number of ordered pairs."""
        return sum(bool(pair.better) for pair in self.pairs)


def compare_rollouts(one: Result, other: Result) -> ComparedPair | None:
    """Return two rollouts of one scene as a pair, 0 and 1; None = their futures are not common."""
    if one.futures is None or other.futures is None or one.futures.key != other.futures.key:
        return None
    return Comparison.of([one.futures.outcomes, other.futures.outcomes]).pair(0, 1)


def bradley_terry(wins: FloatArray) -> tuple[tuple[float, ...], tuple[Interval, ...]]:
    """Return strengths of P policies and their 95 % intervals, by the Bradley-Terry model.

    A logistic regression with a normal prior, which keeps the strength of a policy that always
    wins finite. The variance is the larger one of the model's and of that over scenes, whose
    comparisons depend on each other.

    Args:
        wins: (S, P, P) number of comparisons in each scene in which policy p is better than q.

    Returns:
        The probability to be better than a policy of mean strength, and its interval; NaN for
        fewer than `MIN_SCENES` scenes with an ordered pair.
    """
    num = wins.shape[1]
    total, centre = wins.sum(0), np.eye(num) - 1 / max(num, 1)
    told = wins[wins.any((1, 2))]
    if not len(told):
        return (nan,) * num, (UNKNOWN,) * num

    def loss(strengths: FloatArray) -> float:
        odds = strengths[:, None] - strengths[None]
        prior = (strengths**2).sum() / (2 * PRIOR_DEVIATION**2)
        return float((total * np.logaddexp(0, -odds)).sum() + prior)

    found = minimize(loss, np.zeros(num), method='BFGS').x
    chances = expit(found[:, None] - found[None])
    played = total + total.T
    weights = played * chances * (1 - chances)
    inverse = np.linalg.inv(np.diag(weights.sum(1)) - weights + np.eye(num) / PRIOR_DEVIATION**2)
    # gradient of the log likelihood of each scene
    lost = told * (1 - chances)
    scores = lost.sum(2) - lost.sum(1)
    over_scenes = inverse @ (scores.T @ scores) @ inverse
    deviations = np.sqrt(
        np.maximum(np.diag(centre @ inverse @ centre.T), np.diag(centre @ over_scenes @ centre.T))
    )
    middle = centre @ found
    half = float(t_quantile(len(told) - 1)) * deviations
    intervals = [
        (float(expit(m - h)), float(expit(m + h))) for m, h in zip(middle, half, strict=True)
    ]
    if len(told) < MIN_SCENES:
        intervals = [UNKNOWN] * num
    return tuple(map(float, expit(middle))), tuple(intervals)
