"""How often do the 95 % intervals of the reports hold the truth, at few episodes?

    python experiments/interval_coverage.py [--repeats 1000] [--out experiments/results]

Draws `--repeats` sets of n episodes or scenes from populations whose true value is known, and
counts the intervals that hold it. Each kind of interval has a mild population, and one that
differs: J in two groups, rates that are U-shaped, alike or in two groups, scenes that are hard
for all policies. Sets without an interval (all values equal, say) are left out and counted.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import cache

import numpy as np
from page import parse_arguments, publish, table
from scipy.special import betaincinv, ndtr, ndtri
from scipy.stats import rankdata

from mtv_world_ros.evaluation.metrics.policy_agreement import (
    mean_maximum_rank_violation,
    pearson,
    powered_mean,
    rate_agreement,
    ScoreOfRates,
)
from mtv_world_ros.evaluation.metrics.statistics import (
    clustered_wilson,
    Interval,
    mean_interval,
    wilson,
)
from mtv_world_ros.ranking.judges import area_interval

SIZES = (4, 8, 20, 60)
#: name -> whether it is the population that differs
POPULATIONS = {'mild': False, 'differing': True}
#: rollouts a scene, policies, tasks of the mild populations
_PER_SCENE, _POLICIES, _TASKS = 10, 10, 3
_RESAMPLES = 400

Draw = Callable[[np.random.Generator, int, bool], tuple[Interval, float]]


def mean_of_j(rng: np.random.Generator, num: int, differs: bool) -> tuple[Interval, float]:
    """J of n episodes, spread as in evaluations; or a third of the episodes is much worse."""
    values, true = rng.beta(6, 4, (num, 1)), 0.6
    if differs:
        is_bad = rng.random((num, 1)) < 1 / 3
        values, true = (
            np.where(is_bad, rng.beta(3, 7, (num, 1)), rng.beta(16, 4, (num, 1))),
            19 / 30,
        )
    return _ends(values, np.ones_like(values)), true


def ratio_of_sums(rng: np.random.Generator, num: int, differs: bool) -> tuple[Interval, float]:
    """The same of episodes of unequal length (up to a factor of two); or long ones are bad."""
    counts = rng.integers(8, 17, (num, 1)).astype(float)
    if not differs:
        return _ends(rng.beta(6, 4, (num, 1)) * counts, counts), 0.6
    lengths = np.arange(8, 17)
    means = 0.9 - 0.05 * (lengths - 8)
    mean = 0.9 - 0.05 * (counts - 8)
    true = float((means * lengths).sum() / lengths.sum())
    return _ends(rng.beta(10 * mean, 10 * (1 - mean)) * counts, counts), true


def paired_difference(rng: np.random.Generator, num: int, differs: bool) -> tuple[Interval, float]:
    """How much more often one judge is right than another, by scene; or in few scenes alone."""
    first, second = (0.7, 0.6) if not differs else (0.75, 0.5)
    hard = rng.normal(size=(num, 1))
    if differs:
        hard = np.where(rng.random((num, 1)) < 0.3, 2.0, -0.5)
    trials = rng.integers(4, 13, num) if differs else np.full(num, _PER_SCENE)
    sums = np.empty(num)
    for scene, count in enumerate(trials):
        right = [
            rng.random(count) < _chance(share, hard[scene, 0], differs)
            for share in (first, second)
        ]
        sums[scene] = right[0].sum() - right[1].sum()
    _, ends = mean_interval(sums[:, None], trials[:, None].astype(float), low=-1.0, high=1.0)
    return (float(ends[0, 0]), float(ends[1, 0])), _true_difference(first, second, differs)


def _chance(share: float, hard: float, differs: bool) -> float:
    """That a judge is right in a scene; with scenes that are hard, on average `share` or less."""
    return float(ndtr((ndtri(share) - 0.6 * hard) if differs else ndtri(share) - 0.3 * hard))


@cache
def _true_difference(first: float, second: float, differs: bool) -> float:
    if differs:
        shares = [
            0.3 * _chance(p, 2.0, True) + 0.7 * _chance(p, -0.5, True) for p in (first, second)
        ]
    else:
        shares = [float(ndtr(ndtri(p) / np.sqrt(1.09))) for p in (first, second)]
    return shares[0] - shares[1]


def bootstrap_of_j(rng: np.random.Generator, num: int, differs: bool) -> tuple[Interval, float]:
    """The percentile bootstrap of the mean of J, which the reports had before."""
    values = rng.beta(6, 4, num)
    means = values[rng.integers(0, num, (_RESAMPLES, num))].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return (float(low), float(high)), 0.6


def share(rng: np.random.Generator, num: int, differs: bool) -> tuple[Interval, float]:
    """A share of n independent trials; or mostly near 0 or 1."""
    true = float(rng.beta(0.5, 0.5)) if differs else rng.uniform(0.05, 0.95)
    return wilson(int(rng.binomial(num, true)), num), true


def share_of_scenes(rng: np.random.Generator, num: int, differs: bool) -> tuple[Interval, float]:
    """A share of ten rollouts in each of n scenes, some hard for all; or 2 to 16, most alike."""
    true = rng.uniform(0.2, 0.8)
    counts = rng.integers(2, 17, num) if differs else np.full(num, _PER_SCENE)
    spread = 1.0 if differs else 4.0
    hits = rng.binomial(counts, rng.beta(spread * true, spread * (1 - true), num))
    return clustered_wilson(hits.astype(float), counts.astype(float)), true


def area(rng: np.random.Generator, num: int, differs: bool) -> tuple[Interval, float]:
    """AUROC of ten rollouts in each of n scenes, which differ; or of a nearly perfect judge."""
    return area_interval(*_judged(rng, num, differs))[1], _true_area(differs)


def _judged(
    rng: np.random.Generator, num: int, differs: bool
) -> tuple[list[np.ndarray], np.ndarray, list[tuple[str, int]]]:
    scene = np.repeat(np.arange(num), _PER_SCENE)
    hard = rng.normal(size=num)[scene] * (1.0 if differs else 0.5)
    real = rng.normal(size=len(scene)) > hard
    said = (2.5 if differs else 1.0) * real - 0.5 * hard + rng.normal(size=len(scene))
    return [said], real, [('task', int(number)) for number in scene]


@cache
def _true_area(differs: bool) -> float:
    (said,), real, _ = _judged(np.random.default_rng(5), 2000, differs)
    num_real = int(real.sum())
    above = rankdata(said)[real].sum() - num_real * (num_real + 1) / 2
    return float(above / (num_real * (len(real) - num_real)))


def powered(rng: np.random.Generator, num: int, differs: bool) -> tuple[Interval, float]:
    """A success rate from n true outcomes and ten times as many imagined ones; or biased ones."""
    hard = rng.beta(0.5, 0.5, 11 * num) if differs else rng.random(11 * num)
    real = (rng.random(11 * num) < hard).astype(float)
    said = np.clip(hard + rng.normal(0.3 if differs else 0.1, 0.15, 11 * num), 0, 1)
    return powered_mean(real[:num], said[:num], said[num:]).interval, 0.5


def _ends(values: np.ndarray, counts: np.ndarray) -> Interval:
    _, ends = mean_interval(values, counts)
    return float(ends[0, 0]), float(ends[1, 0])


#: what the table calls them
INTERVALS: dict[str, Draw] = {
    't, mean of J': mean_of_j,
    't, mean over episodes of unequal length': ratio_of_sums,
    't, paired difference of two judges': paired_difference,
    'Wilson, share of independent trials': share,
    'Wilson by scene, share of rollouts': share_of_scenes,
    'jackknife by scene, AUROC': area,
    'prediction-powered rate': powered,
    'before: percentile bootstrap, mean of J': bootstrap_of_j,
}
SCORES = {
    'pearson': ("posterior of the rates, Pearson's r of policies", pearson),
    'mmrv': ('posterior of the rates, MMRV of policies', mean_maximum_rank_violation),
}


def coverage(
    name: str, num: int, sets: int, seed: int, differs: bool = False
) -> tuple[float, int]:
    """Return how often an interval of `INTERVALS` holds the truth, and sets without one."""
    rng = np.random.default_rng([seed, list(INTERVALS).index(name), num, int(differs)])
    held = []
    for _ in range(sets):
        (low, high), true = INTERVALS[name](rng, num, differs)
        if np.isfinite(low):
            assert low < high
            held.append(low - 1e-12 <= true <= high + 1e-12)
    return float(np.mean(held)), sets - len(held)


def mild_ranking(rng: np.random.Generator, num: int) -> tuple[np.ndarray, ...]:
    """True and judged rates of ten policies; outcomes and estimates (P, K, E) of n scenes each."""
    true = np.linspace(0.1, 0.9, _POLICIES)
    judged = np.clip(0.2 + 0.6 * true + rng.normal(0, 0.12, _POLICIES), 0.02, 0.98)
    shape = (_POLICIES, _TASKS, num)
    real = (rng.random(shape) < true[:, None, None]).astype(float)
    mean = judged[:, None, None]
    said = rng.beta(2 * mean, 2 * (1 - mean), shape)
    return true, judged, real, said


def differing_ranking(rng: np.random.Generator, num: int) -> tuple[np.ndarray, ...]:
    """The same of 4 to 30 policies of one task, and outcomes in both: U-shaped, alike, two groups.

    The worlds' rates have a correlation of .3, .7 or .95 (.998: a nearly perfect judge). Of the
    luck of a rollout, .3 is the scene's, the same for all policies and both worlds, and .3 the
    policy's in that scene, the same in both worlds.
    """
    policies = int(rng.integers(4, 31))
    correlation = rng.choice([0.3, 0.7, 0.95, 0.998])
    first, other = rng.normal(size=(2, policies))
    kind = int(rng.integers(3))
    true, judged = (
        _marginal(kind, z)
        for z in (first, correlation * first + np.sqrt(1 - correlation**2) * other)
    )
    shape = (2, policies, 1, num)
    scene, own = rng.normal(size=(1, 1, 1, num)), rng.normal(size=(1, *shape[1:]))
    luck = np.sqrt(0.3) * (scene + own) + np.sqrt(0.4) * rng.normal(size=shape)
    real, said = (luck < ndtri(np.stack([true, judged]))[..., None, None]).astype(float)
    return true, judged, real, said


def _marginal(kind: int, z: np.ndarray) -> np.ndarray:
    """Rates of standard normals."""
    if kind == 0:
        rates = betaincinv(0.5, 0.5, ndtr(z))
    elif kind == 1:
        rates = betaincinv(20, 20, ndtr(z))
    else:
        rates = 0.2 + 0.6 * (z > 0) + 0.04 * z
    return np.clip(rates, 0.02, 0.98)


def ranking_scores(
    num: int, sets: int, seed: int, differs: bool
) -> dict[str, list[tuple[ScoreOfRates, float]]]:
    """Return r and MMRV of simulated rankings on n scenes, each with the truth."""
    rng = np.random.default_rng([seed, len(INTERVALS), num, int(differs)])
    found: dict[str, list[tuple[ScoreOfRates, float]]] = {name: [] for name in SCORES}
    for _ in range(sets):
        true, judged, real, said = (differing_ranking if differs else mild_ranking)(rng, num)
        for name, score in rate_agreement(said, real).items():
            if np.isfinite(score.noise_free):
                found[name].append((score, SCORES[name][1](judged, true)))
    return found


def held(scores: list[tuple[ScoreOfRates, float]]) -> float:
    """Return the share of intervals that hold the truth."""
    return float(np.mean([s.interval[0] <= true <= s.interval[1] for s, true in scores]))


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        '--rankings', type=int, default=300, help='sets for r and MMRV, which take longer'
    )


def main() -> None:
    """Simulate, and print the page."""
    options = parse_arguments(
        __doc__,
        repeats=1000,
        more=_add,
    )
    rows, errors = [], []
    for name in INTERVALS:
        for words, differs in POPULATIONS.items():
            if name.startswith('before') and differs:
                continue
            found = [coverage(name, n, options.repeats, options.seed, differs) for n in SIZES]
            rows.append([name, words, *(_cell(*one) for one in found)])
    for words, differs in POPULATIONS.items():
        by_size = [ranking_scores(n, options.rankings, options.seed, differs) for n in SIZES]
        for name, (label, _) in SCORES.items():
            scores = [one[name] for one in by_size]
            missing = [options.rankings - len(one) for one in scores]
            covered = [held(one) for one in scores]
            rows.append([label, words, *map(_cell, covered, missing)])
            errors.append([label.rpartition(', ')[2], words, *map(_errors, scores)])
    body = (
        f'Share of {options.repeats} simulated sets (r and MMRV: {options.rankings}) whose 95 % '
        'interval holds the truth, by the '
        'number n of episodes (means, shares, powered rates: true outcomes), of scenes (AUROC, '
        'differences, shares by scene) or of scenes of each task (r, MMRV; the mild population '
        'has ten policies and three tasks, the differing one 4 to 30 and one). In parentheses: '
        'sets without an interval.\n\n'
        + table(['interval', 'population', *(f'n = {num}' for num in SIZES)], rows)
        + '\n\nMean error, observed / noise-free (median of the posterior), and median width of '
        'the interval.\n\n'
        + table(['score', 'population', *(f'n = {num}' for num in SIZES)], errors)
    )
    publish(
        'interval_coverage',
        'Coverage of the intervals',
        'python experiments/interval_coverage.py',
        body,
        options,
        f'NumPy {np.__version__}',
    )


def _cell(covered: float, without: int) -> str:
    return f'{covered:.3f}' + (f' ({without})' if without else '')


def _errors(scores: list[tuple[ScoreOfRates, float]]) -> str:
    observed, free = (
        np.mean([getattr(score, name) - true for score, true in scores])
        for name in ('observed', 'noise_free')
    )
    width = np.median([score.interval[1] - score.interval[0] for score, _ in scores])
    return f'{observed:+.3f} / {free:+.3f}, {width:.2f}'


if __name__ == '__main__':
    main()
