"""How well one way of judging policies agrees with another: r, MMRV, intervals, PPI."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import warnings

import numpy as np

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import ConfigError
from mtv_world_ros.lab.evaluation.metrics.rate_posterior import draw_rates
from mtv_world_ros.lab.evaluation.metrics.statistics import (
    Interval,
    MIN_SCENES,
    t_quantile,
    UNKNOWN,
)

#: fewer policies than this have no interval of r or MMRV
MIN_POLICIES = 3
#: of the posterior below and above an interval; with .025 an interval held the truth too rarely
#: (`benchmark/interval_coverage.py`)
_TAILS = (0.0125, 0.0125)
#: the same of r where policies have few episodes, up to so many; from many on, it is as above
_TAILS_OF_FEW, _FEW, _MANY = (0.0075, 0.0025), 20, 60


def pearson(judged: Sequence[float] | FloatArray, true: Sequence[float] | FloatArray) -> float:
    """Returns Pearson's r of two lists of success rates, one entry a policy.

    Pairs in which one is NaN do not count. NaN where less than two are left, or all of one list
    are equal.
    """
    a, b = _known(judged, true)
    if len(a) < 2:
        return np.nan
    a, b = a - a.mean(), b - b.mean()
    scale = float(np.sqrt((a**2).sum() * (b**2).sum()))
    return float((a * b).sum()) / scale if scale > 1e-12 else np.nan


def mean_maximum_rank_violation(
    judged: Sequence[float] | FloatArray, true: Sequence[float] | FloatArray
) -> float:
    """Returns MMRV: for each policy the worst pair that is ranked wrongly, on average.

    A wrongly ranked pair weighs by how far the true success rates lie apart, so the order of the
    arguments matters (SIMPLER, arXiv 2405.05941; ties as in its published code: the better one
    of a pair that is judged equal counts as ranked wrongly). 0 = no pair is ranked wrongly.
    Pairs in which one is NaN do not count; NaN where less than two are left.
    """
    a, b = _known(judged, true)
    if len(a) < 2:
        return np.nan
    is_violated = (a[:, None] > a) != (b[:, None] > b)
    return float(np.where(is_violated, np.abs(b[:, None] - b), 0.0).max(axis=1).mean())


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
    """Returns the success rate (P,) of outcomes (P, ...); NaN does not count."""
    flat = outcomes.reshape(len(outcomes), -1)
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', RuntimeWarning)
        return np.nanmean(flat, axis=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoreOfRates:
    """A score of how well judged rates agree with true ones.

    Attributes:
        observed: of the observed rates, as it is published elsewhere. The noise of few scenes is
            contained in it: r is too small, MMRV too large.
        noise_free: estimate of the score on endless scenes of the same kind: the median of its
            posterior; NaN where there is no interval.
        interval: 95 % interval of the latter, widened to hold `observed`; NaN for fewer than
            `MIN_SCENES` scenes or `MIN_POLICIES` policies, where `observed` is not defined, or
            where all outcomes are judged as they are.
    """

    observed: float
    noise_free: float
    interval: Interval


def rate_agreement(judged: FloatArray, true: FloatArray) -> dict[str, ScoreOfRates]:
    """Returns `pearson` and `mmrv` of the policies' success rates, over all tasks.

    Args:
        judged: (P, K, E) outcomes of P policies on E episodes of each of K tasks, or estimates
            of them, 0 to 1; NaN = none.
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
    return _TAILS_OF_FEW + np.interp(episodes, (_FEW, _MANY), (0, 1)) * np.subtract(
        _TAILS, _TAILS_OF_FEW
    )


def _draws(judged: FloatArray, true: FloatArray) -> FloatArray | None:
    """Rates (2, D, P) without the noise of few scenes; None where there is too little."""
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
    """(D,) of draws (D, P)."""
    a, b = (rates - rates.mean(axis=1, keepdims=True) for rates in (judged, true))
    return (a * b).sum(axis=1) / np.maximum(
        np.sqrt((a**2).sum(axis=1) * (b**2).sum(axis=1)), 1e-12
    )


def _violation_of(judged: FloatArray, true: FloatArray) -> FloatArray:
    """(D,) of draws (D, P)."""
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
        interval: 95 %, with the t quantile of the true values, cut to [0, 1]; NaN where these
            are fewer than `MIN_SCENES` or do not vary.
        weight: of the predictions (lambda), 0 = the mean of the true values alone.
        num_true: true values.
        num_more: predictions without a true value.
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
    """Returns the prediction-powered estimate of the mean of true values in [0, 1].

    Unbiased however wrong the predictions are: their error is measured where both are known.

    Args:
        true: n true values.
        predicted: n predictions of them.
        more: N predictions for others of the same population.
        weight: lambda; 1 = plain PPI (arXiv 2301.09633), None = what makes the interval
            shortest (PPI++, arXiv 2311.01453, example 6.1: cov(Y, f) / ((1 + n/N) var f)).

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
    """The weight of the shortest interval, within [0, 1]."""
    spread = float(np.concatenate([f, u]).var(ddof=1)) if len(f) + len(u) > 1 else 0.0
    if len(y) < 2 or spread < 1e-12:
        return 0.0
    together = float(((y - y.mean()) * (f - f.mean())).sum() / (len(y) - 1))
    return float(np.clip(together / ((1 + len(y) / len(u)) * spread), 0.0, 1.0))
