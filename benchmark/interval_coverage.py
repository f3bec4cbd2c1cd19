"""How often do the 95 % intervals of the reports hold the truth, at few episodes?

    python benchmark/interval_coverage.py [--repeats 1000] [--out benchmark/results]

Draws `--repeats` sets of n episodes or scenes from populations whose true value is known, and
counts the intervals that hold it. Sets that have no interval (all values equal, say) are left out
and counted.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from page import parse_arguments, publish, table

from mtv_world_ros.evaluation.metrics.policy_agreement import (
    agreement_interval,
    mean_maximum_rank_violation,
    pearson,
    powered_mean,
)
from mtv_world_ros.evaluation.metrics.statistics import (
    clustered_wilson,
    Interval,
    mean_interval,
    wilson,
)

SIZES = (4, 8, 20, 60)
#: rollouts a scene, policies, tasks of the simulated rankings
_PER_SCENE, _POLICIES, _TASKS = 10, 10, 3
_RESAMPLES = 400

Draw = Callable[[np.random.Generator, int], tuple[Interval, float]]


def mean_of_j(rng: np.random.Generator, num: int) -> tuple[Interval, float]:
    """J of n episodes, spread as in evaluations."""
    values = rng.beta(6, 4, (num, 1))
    _, ends = mean_interval(values, np.ones_like(values))
    return (float(ends[0, 0]), float(ends[1, 0])), 0.6


def ratio_of_sums(rng: np.random.Generator, num: int) -> tuple[Interval, float]:
    """The same of episodes that differ in length by up to a factor of two."""
    counts = rng.integers(8, 17, (num, 1)).astype(float)
    _, ends = mean_interval(rng.beta(6, 4, (num, 1)) * counts, counts)
    return (float(ends[0, 0]), float(ends[1, 0])), 0.6


def bootstrap_of_j(rng: np.random.Generator, num: int) -> tuple[Interval, float]:
    """The percentile bootstrap of the same mean, which the reports had before."""
    values = rng.beta(6, 4, num)
    means = values[rng.integers(0, num, (_RESAMPLES, num))].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return (float(low), float(high)), 0.6


def share(rng: np.random.Generator, num: int) -> tuple[Interval, float]:
    """A share of n independent trials."""
    true = rng.uniform(0.05, 0.95)
    return wilson(int(rng.binomial(num, true)), num), true


def share_of_scenes(rng: np.random.Generator, num: int) -> tuple[Interval, float]:
    """A share of ten rollouts in each of n scenes, some of which are hard for all."""
    true = rng.uniform(0.2, 0.8)
    hits = rng.binomial(_PER_SCENE, rng.beta(4 * true, 4 * (1 - true), num)).astype(float)
    return clustered_wilson(hits, np.full(num, float(_PER_SCENE))), true


def r_of_rates(rng: np.random.Generator, num: int) -> tuple[Interval, float]:
    """Pearson's r of ten policies' rates on n scenes of each of three tasks."""
    true, judged, real, said = _ranking(rng, num)
    return agreement_interval(pearson, said, real), pearson(judged, true)


def mmrv_of_rates(rng: np.random.Generator, num: int) -> tuple[Interval, float]:
    """MMRV of the same."""
    true, judged, real, said = _ranking(rng, num)
    return (
        agreement_interval(mean_maximum_rank_violation, said, real),
        mean_maximum_rank_violation(judged, true),
    )


def _ranking(rng: np.random.Generator, num: int) -> tuple[np.ndarray, ...]:
    """True and judged rates of the policies, and outcomes (P, K, E) drawn from them."""
    true = np.linspace(0.1, 0.9, _POLICIES)
    judged = np.clip(0.2 + 0.6 * true + rng.normal(0, 0.12, _POLICIES), 0.02, 0.98)
    shape = (_POLICIES, _TASKS, num)
    real, said = (
        (rng.random(shape) < rates[:, None, None]).astype(float) for rates in (true, judged)
    )
    return true, judged, real, said


def powered(rng: np.random.Generator, num: int) -> tuple[Interval, float]:
    """A success rate from n true outcomes and ten times as many imagined ones."""
    hard = rng.random(11 * num)
    real = (rng.random(11 * num) < hard).astype(float)
    said = np.clip(hard + rng.normal(0.1, 0.15, 11 * num), 0, 1)
    return powered_mean(real[:num], said[:num], said[num:]).interval, 0.5


#: what the table calls them; those of the first four have to hold .93 to .97
INTERVALS: dict[str, Draw] = {
    't, mean of J': mean_of_j,
    't, mean over episodes of unequal length': ratio_of_sums,
    'Wilson, share of independent trials': share,
    'Wilson by scene, share of rollouts': share_of_scenes,
    "posterior of the rates, Pearson's r of policies": r_of_rates,
    'posterior of the rates, MMRV of policies': mmrv_of_rates,
    'prediction-powered rate': powered,
    'before: percentile bootstrap, mean of J': bootstrap_of_j,
}


def coverage(name: str, num: int, sets: int, seed: int) -> tuple[float, int]:
    """Returns how often an interval of `INTERVALS` holds the truth, and sets without one."""
    rng = np.random.default_rng([seed, list(INTERVALS).index(name), num])
    held = []
    for _ in range(sets):
        (low, high), true = INTERVALS[name](rng, num)
        if np.isfinite(low):
            held.append(low - 1e-12 <= true <= high + 1e-12)
    return float(np.mean(held)), sets - len(held)


def main() -> None:
    """Simulates, and prints the page."""
    options = parse_arguments(__doc__, repeats=1000)
    rows = []
    for name in INTERVALS:
        found = [coverage(name, num, options.repeats, options.seed) for num in SIZES]
        rows.append([name, *(_cell(*one) for one in found)])
    body = (
        f'Share of {options.repeats} simulated sets whose 95 % interval holds the truth, by the '
        'number n of episodes (means, shares, powered rates: true outcomes) or of scenes of each '
        'task (r, MMRV: ten policies, three tasks). In parentheses: sets without an interval.\n\n'
        + table(['interval', *(f'n = {num}' for num in SIZES)], rows)
    )
    publish(
        'interval_coverage',
        'Coverage of the intervals',
        'python benchmark/interval_coverage.py',
        body,
        options,
        f'NumPy {np.__version__}',
    )


def _cell(covered: float, without: int) -> str:
    return f'{covered:.3f}' + (f' ({without})' if without else '')


if __name__ == '__main__':
    main()
