"""Comparison of plans of one scene by their outcomes in common futures.

Where contact was never fitted, a share of futures says little about this robot. Plans of one scene
meet the same futures, however, and a plan that succeeds wherever another one does, and elsewhere
too, is better under any of them.

P plans, K futures.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

from scipy.special import betainc

#: outcomes of one plan in K common futures: True or False; None = the future was lost. Empty =
#: nothing was foreseen
Outcomes = tuple[bool | None, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparisonRule:
    """Rule by which one of two plans is better.

    Attributes:
        min_futures: least number of common futures in which the better plan alone succeeds.
        max_reverse_ratio: largest number of futures in which the other plan alone succeeds, as a
            fraction of that number.
        min_known_fraction: least fraction of futures with an outcome of all plans.
    """

    min_futures: int = 2
    max_reverse_ratio: float = 0.2
    min_known_fraction: float = 0.5

    def is_better(self, num_own: int, num_other: int) -> bool:
        """Return True if a plan is better than another one.

        Args:
            num_own: number of futures in which the plan succeeds and the other one fails.
            num_other: number of futures in which the other plan succeeds and this one fails.
        """
        return num_own >= self.min_futures and num_other <= self.max_reverse_ratio * num_own

    @property
    def text(self) -> str:
        """The rule, in words."""
        return (
            f'A is better than B if A succeeds and B fails in at least {self.min_futures} common '
            f'futures, and the reverse in at most {self.max_reverse_ratio:.0%} of that number'
        )


RULE = ComparisonRule()


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedPair:
    """Two plans of one scene.

    Attributes:
        first: index of the one plan.
        second: index of the other plan.
        num_first: number of futures in which the first succeeds and the second fails.
        num_second: number of futures in which the second succeeds and the first fails.
    """

    first: int
    second: int
    num_first: int
    num_second: int

    @property
    def better(self) -> int | None:
        """Index of the better plan; None = neither is better."""
        if RULE.is_better(self.num_first, self.num_second):
            return self.first
        return self.second if RULE.is_better(self.num_second, self.num_first) else None

    @property
    def confidence(self) -> float:
        """Probability that the plan with more successes is the better one.

        The futures that differ are a sample of a distribution, which need not be this robot's. A
        beta posterior of the share, with a uniform prior: .5 where no outcome differs.
        """
        more, less = sorted((self.num_first, self.num_second), reverse=True)
        return float(1 - betainc(more + 1, less + 1, 0.5))


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Plans of one scene, compared under common futures.

    It says which plan is better under some contact, not whether a plan succeeds here.

    Attributes:
        outcomes: outcomes of each of P plans.
        pairs: all pairs of plans; empty = the plans cannot be compared.
        reason: reason why the plans cannot be compared; empty = they can.
        is_fitted: whether futures have contact that was fitted in this robot cell.
    """

    outcomes: tuple[Outcomes, ...]
    pairs: tuple[ComparedPair, ...]
    reason: str = ''
    is_fitted: bool = True

    @classmethod
    def of(
        cls, outcomes: Sequence[Outcomes], *, reason: str = '', is_fitted: bool = True
    ) -> Comparison:
        """Return the comparison of plans with outcomes in common futures.

        A future that is lost under one plan counts for none.

        Args:
            outcomes: outcomes of each plan.
            reason: reason why outcomes are no evidence; empty = they are.
            is_fitted: see the attribute.
        """
        reason = reason or _objection(outcomes)
        pairs: tuple[ComparedPair, ...] = ()
        if not reason:
            common = _common(outcomes)
            pairs = tuple(
                ComparedPair(
                    first=first,
                    second=second,
                    num_first=sum(a and not b for a, b in _at(outcomes, first, second, common)),
                    num_second=sum(b and not a for a, b in _at(outcomes, first, second, common)),
                )
                for first, second in combinations(range(len(outcomes)), 2)
            )
        return cls(outcomes=tuple(outcomes), pairs=pairs, reason=reason, is_fitted=is_fitted)

    @property
    def num_futures(self) -> int:
        """Number of futures with an outcome of every plan."""
        return 0 if self.reason else len(_common(self.outcomes))

    def pair(self, first: int, second: int) -> ComparedPair | None:
        """Return the pair of two plans; None = the plans cannot be compared."""
        wanted = {first, second}
        return next((pair for pair in self.pairs if {pair.first, pair.second} == wanted), None)

    @property
    def num_successes(self) -> tuple[int, ...]:
        """Number of common futures in which each plan succeeds; empty = not compared."""
        if self.reason:
            return ()
        common = _common(self.outcomes)
        return tuple(sum(bool(plan[k]) for k in common) for plan in self.outcomes)

    @property
    def beaten(self) -> frozenset[int]:
        """Indices of the plans to which another plan is preferred.

        Never all: a better plan succeeds in more of the common futures.
        """
        return frozenset(
            pair.first + pair.second - pair.better
            for pair in self.pairs
            if pair.better is not None
        )

    @property
    def best(self) -> int:
        """Index of the first plan to which no other is preferred."""
        return next(k for k in range(len(self.outcomes)) if k not in self.beaten)

    @property
    def text(self) -> str:
        """The choice, in words."""
        count = len(self.outcomes)
        return self.told_as(range(1, count + 1), count)

    def told_as(self, numbers: Sequence[int], count: int) -> str:
        """Return the choice in words, with other numbers for the plans.

        Args:
            numbers: number of each plan.
            count: number of all plans, including those that were not compared.
        """
        best = self.best
        title = f'plan {numbers[best]} of {count}'
        if self.reason:
            return f'{title}: not told, {self.reason}'
        done = self.num_successes
        if not any(done):
            return f'{title}: no plan does the task by its end in any future'
        text = f'{title}: succeeds in {done[best]} of {self.num_futures} futures'
        pair = self.pair(0, best) if best else None
        if pair is None:
            return f'{text}, no other plan is better'
        first = f'{text}, plan {numbers[0]} in {done[0]}'
        if pair.better == best:
            return f'{first} (better, {pair.confidence:.2f})'
        return f'{first} (not told from it, but a third plan is better)'


def _objection(outcomes: Sequence[Outcomes]) -> str:
    """Return the reason why outcomes cannot be compared; empty = they can be."""
    unknown = sum(not plan for plan in outcomes)
    if unknown:
        return f'the outcome of {unknown} of {len(outcomes)} plans is not foreseen'
    if len({len(plan) for plan in outcomes}) > 1:
        return 'the plans have different numbers of futures'
    if len(_common(outcomes)) < RULE.min_known_fraction * len(outcomes[0]):
        return 'most futures were lost'
    return ''


def _common(outcomes: Sequence[Outcomes]) -> list[int]:
    """Return the futures in which every plan has an outcome."""
    columns = enumerate(zip(*outcomes, strict=True))
    return [k for k, column in columns if None not in column]


def _at(
    outcomes: Sequence[Outcomes], first: int, second: int, common: Sequence[int]
) -> Iterator[tuple[bool, bool]]:
    """Yield the outcomes of two plans in common futures."""
    for k in common:
        yield bool(outcomes[first][k]), bool(outcomes[second][k])
