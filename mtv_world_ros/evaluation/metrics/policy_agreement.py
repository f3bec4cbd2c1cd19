"""Agreement of two ways of judging policies: Pearson's r, MMRV, their intervals, PPI."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
import warnings

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import binom

from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.evaluation.metrics.statistics import Interval, MIN_SCENES, t_quantile, UNKNOWN

IntArray = NDArray[np.int64]


#: standard deviations of the grid, on the arcsine scale (which reaches from 0 to pi)
_SPREADS = np.geomspace(0.04, 1.6, 12)
#: scale of their half-Cauchy prior
_SPREAD_SCALE = 0.6
#: Fisher's z of the correlations of the grid, -.98 to .9997, equally likely a priori
_FISHER = np.linspace(-2.4, 4.4, 28)
#: prior probability that policies come in two groups
_TWO_GROUPS = 0.3

# A covariance of judged and true rate is an array (3, ...): variance, covariance, variance.


def draw_rates(
    judged: FloatArray, true: FloatArray, num_draws: int = 1000, seed: int = 0
) -> FloatArray:
    """Draw judged and true success rates (2, D, P) of P policies from their posterior.

    Args:
        judged: (P, K, E) outcomes on E scenes of each of K tasks, each 0 or 1, or estimates in
            between; NaN = none. All policies meet the same scenes; the tasks are taken as given,
            not as drawn.
        true: (P, K, E) true outcomes.
        num_draws: number of draws, D.
        seed: seed of the draws.
    """
    rng = np.random.default_rng(seed)
    observed, noise = _observed(np.stack([judged, true]))
    spread, prior = _grid()
    precision = _inverse(spread[:, None] + noise[:, :, None])
    pull = _times(precision, observed[..., None])
    second = _groupings(observed)
    members = np.stack([~second, second])
    # of each group in each grouping (2, Q, P), at each point of the grid
    weight = np.einsum('gqp,cpn->cgqn', members.astype(float), precision, optimize=True)
    weighted = np.einsum('gqp,cpn->cgqn', members.astype(float), pull, optimize=True)
    is_there = np.asarray(members.any(axis=2))[..., None]
    scatter = _inverse(np.where(is_there, weight, np.array([1.0, 0.0, 1.0])[:, None, None, None]))
    means = _times(scatter, weighted)
    # the means are integrated over all pairs of rates, [0, pi] x [0, pi]
    of_groups = np.log(2 / np.pi) + 0.5 * (
        (weighted * means).sum(0) + np.log(_determinant(scatter))
    )
    likelihood = np.where(is_there, of_groups, 0.0).sum(0)
    likelihood += 0.5 * np.log(_determinant(precision)).sum(0) + prior
    likelihood -= 0.5 * (observed[..., None] * pull).sum((0, 1))
    likelihood += np.log(_prior_of_groupings(len(second)))[:, None]
    grouping, point = _choose(likelihood, num_draws, rng)
    drawn = means[:, :, grouping, point]
    drawn += _root_times(scatter[:, :, grouping, point], rng.normal(size=drawn.shape))
    centre = np.where(second[grouping], drawn[:, 1, :, None], drawn[:, 0, :, None])
    # a policy's rate lies between its group's mean and what was observed of it
    inward, outward = _inverse(spread)[:, point, None], _inverse(noise)[:, None]
    scatter = _inverse(inward + outward)
    rates = _times(scatter, _times(inward, centre) + _times(outward, observed[:, None]))
    rates += _root_times(scatter, rng.normal(size=rates.shape))
    return np.sin(np.clip(rates, 0.0, np.pi) / 2) ** 2


@cache
def _grid() -> tuple[FloatArray, FloatArray]:
    """Covariances (3, N) of the rates over policies, and the logarithm of their prior (N,)."""
    first, second, fisher = (
        axis.ravel() for axis in np.meshgrid(_SPREADS, _SPREADS, _FISHER, indexing='ij')
    )
    spread = np.stack([first**2, np.tanh(fisher) * first * second, second**2])
    # half-Cauchy in each spread, over points that are evenly spaced in its logarithm
    prior = sum(np.log(one) - np.log1p((one / _SPREAD_SCALE) ** 2) for one in (first, second))
    return spread, np.asarray(prior)


def _observed(outcomes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the rates (2, P) of outcomes (2, P, K, E), arcsine scale, and their noise covariance.

    A scene that is hard for all policies moves all rates alike, which neither r nor a rank
    violation sees: what the policies have in common is taken out. How large the rest is, as a
    share of the noise of independent trials, is taken to be the same for all policies.
    """
    if outcomes.shape[3] == 1:
        outcomes = outcomes.swapaxes(2, 3)  # no scatter within a task: its scenes are as drawn
    is_known = np.isfinite(outcomes)
    filled = np.where(is_known, outcomes, 0.0)
    count = is_known.sum(3)
    mean = filled.sum(3, keepdims=True) / np.maximum(count, 1)[..., None]
    whole = np.where(is_known, outcomes - mean, 0.0)
    common = whole.sum(1, keepdims=True) / np.maximum(is_known.sum(1, keepdims=True), 1)
    # rates near 0 or 1 are moved less (probit): by the slope at the rate
    slope = np.exp(-0.5 * ndtri((filled.sum(3) + 1) / (count + 2)) ** 2)[..., None]
    own = np.where(is_known, whole - slope / slope.mean(1, keepdims=True) * common, 0.0)
    num_policies = outcomes.shape[1]
    share = np.einsum('apke,bpke->ab', own, own) * num_policies / (num_policies - 1)
    # binary outcomes have exactly this variance; estimates of the same rate have less
    most = (count[..., None] * mean * (1 - mean)).sum((1, 2, 3))
    scale = np.maximum(np.sqrt(most), 1e-9)
    share /= scale[:, None] * scale
    hits, trials = filled.sum((2, 3)), count.sum(2)
    rates = (hits + 0.5) / (trials + 1)
    alone = np.sqrt(_arcsine_variance(rates, trials))
    # two worlds cannot share more of their noise than their rates allow
    deviation = np.sqrt(rates * (1 - rates))
    shared = np.minimum(*rates) * (1 - np.maximum(*rates))
    allowed = shared / deviation.prod(0) * deviation.prod(0).sum() / shared.sum()
    first, second = (share[world, world] * alone[world] ** 2 + 1e-5 for world in (0, 1))
    between = share[0, 1] * allowed * alone[0] * alone[1]
    limit = 0.98 * np.sqrt(first * second)
    observed = 2 * np.arcsin(np.sqrt((hits + 0.375) / (trials + 0.75)))
    return observed, np.stack([first, np.clip(between, -limit, limit), second])


def _arcsine_variance(rates: FloatArray, trials: IntArray) -> FloatArray:
    """Variance of a rate on the arcsine scale, of independent trials: 1 / n but near 0 and 1."""
    hits = np.arange(trials.max() + 1)
    chance = binom.pmf(hits, trials[..., None], rates[..., None])
    value = 2 * np.arcsin(np.sqrt(np.minimum((hits + 0.375) / (trials[..., None] + 0.75), 1.0)))
    mean = (chance * value).sum(-1, keepdims=True)
    return (chance * (value - mean) ** 2).sum(-1)


def _groupings(observed: FloatArray) -> BoolArray:
    """(Q, P) which policies are the second group: none, or a cut along a rate or their sum."""
    num = observed.shape[1]
    cuts = np.arange(num)[None] >= np.arange(1, num)[:, None]
    found = [np.zeros((1, num), np.bool_)]
    for along in (*observed, observed.sum(0)):
        one = np.empty_like(cuts)
        one[:, np.argsort(along, kind='stable')] = cuts
        found.append(one ^ one[:, :1])  # the first policy is of the first group
    return np.unique(np.concatenate(found), axis=0)


def _prior_of_groupings(num: int) -> FloatArray:
    return np.array([1 - _TWO_GROUPS, *[_TWO_GROUPS / max(num - 1, 1)] * (num - 1)])


def _choose(
    likelihood: FloatArray, num: int, rng: np.random.Generator
) -> tuple[IntArray, IntArray]:
    """Return the grouping and point of the grid of each draw, by their (Q, N) posterior."""
    share = np.exp(likelihood - likelihood.max()).cumsum()
    at = (np.arange(num) + rng.random(num)) / num * share[-1]
    found = np.minimum(np.searchsorted(share, at), len(share) - 1)
    return np.divmod(found, likelihood.shape[1])


def _determinant(matrix: FloatArray) -> FloatArray:
    return matrix[0] * matrix[2] - matrix[1] ** 2


def _inverse(matrix: FloatArray) -> FloatArray:
    return np.stack([matrix[2], -matrix[1], matrix[0]]) / _determinant(matrix)


def _times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    a, b, d = matrix
    return np.stack([a * vector[0] + b * vector[1], b * vector[0] + d * vector[1]])


def _root_times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Return a triangular root of a covariance times standard normals: a draw."""
    a, b, d = matrix
    low = b / np.sqrt(a)
    second = np.sqrt(np.maximum(d - low**2, 1e-15))
    return np.stack([np.sqrt(a) * vector[0], low * vector[0] + second * vector[1]])


#: fewer policies than this have no interval of r or MMRV
MIN_POLICIES = 3
#: posterior probability below and above an interval; with 0.025 the interval contained the truth
#: too rarely (`experiments/interval_coverage.py`)
_TAILS = (0.0125, 0.0125)
#: posterior probability below and above the interval of r, with `_FEW_EPISODES` a policy or fewer
_TAILS_OF_FEW = (0.0075, 0.0025)
#: episodes a policy up to which `_TAILS_OF_FEW` holds
_FEW_EPISODES = 20
#: episodes a policy from which `_TAILS` holds; linear between
_MANY_EPISODES = 60


def pearson(judged: Sequence[float] | FloatArray, true: Sequence[float] | FloatArray) -> float:
    """Return Pearson's r of two lists of success rates, one entry a policy.

    Pairs in which one is NaN do not count. NaN where less than two are left, or all of one list
    are equal.
    """
    a, b = _known(judged, true)
    if len(a) < 2 or min(np.ptp(a), np.ptp(b)) < 1e-12:
        return np.nan
    return float(_pearson_of(a[None], b[None])[0])


def mean_maximum_rank_violation(
    judged: Sequence[float] | FloatArray, true: Sequence[float] | FloatArray
) -> float:
    """Return MMRV: for each policy the worst pair that is ranked wrongly, on average.

    A wrongly ranked pair weighs by how far the true success rates lie apart, so the order of the
    arguments matters (SIMPLER, arXiv 2405.05941; ties as in its published code: the better one
    of a pair that is judged equal counts as ranked wrongly). 0 = no pair is ranked wrongly.
    Pairs in which one is NaN do not count; NaN where less than two are left.
    """
    a, b = _known(judged, true)
    if len(a) < 2:
        return np.nan
    return float(_violation_of(a[None], b[None])[0])


def _known(
    judged: Sequence[float] | FloatArray, true: Sequence[float] | FloatArray
) -> tuple[FloatArray, FloatArray]:
    a, b = np.asarray(judged, dtype=np.float64), np.asarray(true, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 1:
        raise ConfigError(
            f'success rates of the same policies are compared; got {a.shape} and {b.shape}'
        )
    known = np.isfinite(a) & np.isfinite(b)
    return a[known], b[known]


def rates(outcomes: FloatArray) -> FloatArray:
    """Return the success rate (P,) of outcomes (P, ...); NaN does not count."""
    flat = outcomes.reshape(len(outcomes), -1)
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', RuntimeWarning)
        return np.nanmean(flat, axis=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoreOfRates:
    """A score of how well judged rates agree with true ones.

    Attributes:
        observed: score of the observed rates, as it is published elsewhere. It contains the noise
            of few scenes: r is too small, MMRV too large.
        noise_free: estimate of the score on endless scenes of the same kind: the median of its
            posterior; NaN where there is no interval.
        interval: 95 % interval of the latter, widened to hold `observed`; NaN for fewer than
            `MIN_SCENES` scenes or `MIN_POLICIES` policies, where `observed` is not defined, or
            where every verdict is right.
    """

    observed: float
    noise_free: float
    interval: Interval


def rate_agreement(judged: FloatArray, true: FloatArray) -> dict[str, ScoreOfRates]:
    """Return `pearson` and `mmrv` of the policies' success rates, over all tasks.

    Args:
        judged: (P, K, E) outcomes of P policies on E episodes of each of K tasks, or estimates
            of the outcomes, 0 to 1; NaN = none.
        true: (P, K, E) true outcomes.
    """
    observed = {name: score(rates(judged), rates(true)) for name, (score, _) in _SCORES.items()}
    draws = _draws(judged, true)
    found = {}
    for name, (_, score_of_draws) in _SCORES.items():
        middle, interval = np.nan, UNKNOWN
        if draws is not None and np.isfinite(observed[name]):
            values = score_of_draws(*draws)
            below, above = _TAILS if name == 'mmrv' else _tails_of_pearson(true)
            low, high = (float(end) for end in np.quantile(values, (below, 1 - above)))
            low, high = min(low, observed[name]), max(high, observed[name])
            if low < high:
                middle, interval = float(np.median(values)), (low, high)
        found[name] = ScoreOfRates(observed=observed[name], noise_free=middle, interval=interval)
    return found


def _tails_of_pearson(true: FloatArray) -> FloatArray:
    episodes = float(np.median(np.isfinite(true).sum(axis=(1, 2))))
    return _TAILS_OF_FEW + np.interp(
        episodes, (_FEW_EPISODES, _MANY_EPISODES), (0, 1)
    ) * np.subtract(_TAILS, _TAILS_OF_FEW)


def _draws(judged: FloatArray, true: FloatArray) -> FloatArray | None:
    """Return the rates (2, D, P) without the noise of few scenes; None if there are too few."""
    both = np.stack([judged, true])
    is_known = np.isfinite(both)
    policies = is_known.any(axis=(2, 3)).all(axis=0)
    scenes = is_known[1].any(axis=0)
    if policies.sum() < MIN_POLICIES or scenes.sum() < MIN_SCENES:
        return None
    both = both[:, policies]
    if np.array_equal(both[0], both[1], equal_nan=True):
        return None
    # the same draws in whatever order the policies come
    return draw_rates(*both[:, np.lexsort([rates(outcomes) for outcomes in both])])


def _pearson_of(judged: FloatArray, true: FloatArray) -> FloatArray:
    """Return (D,) of draws (D, P)."""
    a, b = (rates - rates.mean(axis=1, keepdims=True) for rates in (judged, true))
    return (a * b).sum(axis=1) / np.maximum(
        np.sqrt((a**2).sum(axis=1) * (b**2).sum(axis=1)), 1e-12
    )


def _violation_of(judged: FloatArray, true: FloatArray) -> FloatArray:
    """Return (D,) of draws (D, P)."""
    gaps = true[:, :, None] - true[:, None]
    is_violated = (judged[:, :, None] > judged[:, None]) != (gaps > 0)
    return np.where(is_violated, np.abs(gaps), 0.0).max(axis=2).mean(axis=1)


Score = Callable[[FloatArray, FloatArray], float]
#: score of rates, and the same of draws
_SCORES: Mapping[str, tuple[Score, Callable[[FloatArray, FloatArray], FloatArray]]] = {
    'pearson': (pearson, _pearson_of),
    'mmrv': (mean_maximum_rank_violation, _violation_of),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class PoweredMean:
    """A mean from few true values and many predictions.

    Attributes:
        value: the estimate, cut to [0, 1].
        interval: 95 % interval, with the t quantile of the true values, cut to [0, 1]; NaN where
            these are fewer than `MIN_SCENES` or do not vary.
        weight: weight of the predictions (lambda), 0 = the mean of the true values alone.
        num_true: number of true values.
        num_more: number of predictions without a true value.
    """

    value: float
    interval: Interval
    weight: float
    num_true: int
    num_more: int


def powered_mean(
    true: Sequence[float] | FloatArray,
    predicted: Sequence[float] | FloatArray,
    more: Sequence[float] | FloatArray,
    *,
    weight: float | None = None,
) -> PoweredMean:
    """Return the prediction-powered estimate of the mean of true values in [0, 1].

    The estimate is unbiased even if the predictions are wrong, because their error is measured on
    the samples with both values.

    Args:
        true: n true values.
        predicted: n predictions of these values.
        more: predictions for N other samples of the same population.
        weight: lambda; 1 = plain PPI (arXiv 2301.09633), None = the value with the shortest
            interval (PPI++, arXiv 2311.01453, example 6.1: cov(Y, f) / ((1 + n/N) var f)).

    Raises:
        ConfigError: not as many predictions as true values.
    """
    y, f, u = (np.asarray(values, dtype=np.float64) for values in (true, predicted, more))
    if y.shape != f.shape or y.ndim != 1:
        raise ConfigError(f'{y.shape} true values have {f.shape} predictions; they go in pairs')
    if not len(y):
        return PoweredMean(value=np.nan, interval=UNKNOWN, weight=0.0, num_true=0, num_more=len(u))
    if not len(u):
        weight = 0.0
    elif weight is None:
        weight = _best_weight(y, f, u)
    errors = y - weight * f
    value = float(errors.mean() + (weight * u.mean() if len(u) else 0.0))
    variance = errors.var(ddof=1) / len(y) if len(y) > 1 else 0.0
    interval = UNKNOWN
    if len(y) >= MIN_SCENES and variance > 1e-12:
        if len(u) > 1:
            variance += weight**2 * u.var(ddof=1) / len(u)
        half = float(t_quantile(len(y) - 1)) * float(np.sqrt(variance))
        interval = (max(value - half, 0.0), min(value + half, 1.0))
    value = min(max(value, 0.0), 1.0)
    return PoweredMean(
        value=value, interval=interval, weight=weight, num_true=len(y), num_more=len(u)
    )


def _best_weight(y: FloatArray, f: FloatArray, u: FloatArray) -> float:
    """Return the weight of the shortest interval, within [0, 1]."""
    spread = float(np.concatenate([f, u]).var(ddof=1)) if len(f) + len(u) > 1 else 0.0
    if len(y) < 2 or spread < 1e-12:
        return 0.0
    together = float(((y - y.mean()) * (f - f.mean())).sum() / (len(y) - 1))
    return float(np.clip(together / ((1 + len(y) / len(u)) * spread), 0.0, 1.0))
