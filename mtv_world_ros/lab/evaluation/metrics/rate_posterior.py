"""Success rates that policies would have on endless scenes, drawn given few scenes.

Rates of few scenes are noisy: their r is too small and their MMRV too large. The rates here are
free of that. They are taken as normal on the arcsine scale, on which the noise of a rate hardly
depends on the rate, about one mean or about two (policies that come in two groups); means,
spreads and correlation are unknown and summed over a grid.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import binom

from mtv_world_ros.data_types import BoolArray, FloatArray

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
    """Returns draws (2, D, P) of the judged and true rates of P policies on endless scenes.

    Args:
        judged: (P, K, E) outcomes on E scenes of each of K tasks, each 0 or 1, or estimates in
            between; NaN = none. All policies meet the same scenes; the tasks are taken as given,
            not as drawn.
        true: (P, K, E) true outcomes.
        num_draws: D.
        seed: of the draws.
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
    """Rates (2, P) that outcomes (2, P, K, E) give, arcsine scale, and covariance of their noise.

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
    # outcomes scatter just so much; estimates of the same rate less
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
    """(Q, P) which policies are the second group: first none, then each cut along either rate.

    Along their sum as well.
    """
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
    """Grouping and point of the grid of each draw, by their (Q, N) posterior."""
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
    """A triangular root of a covariance times standard normals: a draw."""
    a, b, d = matrix
    low = b / np.sqrt(a)
    second = np.sqrt(np.maximum(d - low**2, 1e-15))
    return np.stack([np.sqrt(a) * vector[0], low * vector[0] + second * vector[1]])
