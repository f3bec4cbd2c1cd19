"""True success rates of policies, drawn from what few scenes say about them: a Gibbs sampler.

The two rates of a policy (judged and true) are taken as normal about a common mean, with a
covariance that is unknown; what was observed is these plus the noise of the scenes. Rates of few
scenes are noisy, so their r is too small and their MMRV too large; the draws are free of that.
"""

from __future__ import annotations

import warnings

import numpy as np

from mtv_world_ros.data_types import FloatArray

#: of the inverse-Wishart prior: with three degrees r is uniform a priori
_DEGREES = 3.0
#: chains, draws kept of each (consecutive ones), steps before the first one
_CHAINS, _KEPT, _BURN = 100, 10, 12
#: scenes at which a policy's own noise weighs as much as that of all policies together
_POOL = 4.0

Triple = tuple[FloatArray, FloatArray, FloatArray]


def draw_rates(judged: FloatArray, true: FloatArray, scale: float, seed: int = 0) -> FloatArray:
    """Returns draws (2, D, P) of the judged and true rates of P policies.

    Args:
        judged: (P, S) outcomes on S scenes, each 0 or 1; NaN = none.
        true: (P, S) true outcomes.
        scale: of the inverse-Wishart prior on the covariance of the two rates over the policies:
            small = a judge may be nearly perfect, .03 = it is off by about .1.
        seed: of the draws.
    """
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', RuntimeWarning)
        observed = np.nanmean(np.stack([judged, true]), axis=-1)
        noise = _noise(np.stack([judged, true]))
    rng = np.random.default_rng(seed)
    shape = (_CHAINS, observed.shape[1])
    weight = _inverse((noise[0] + 1e-6, noise[1], noise[2] + 1e-6))
    pull = _times(weight, observed)
    rates = observed[:, None] + rng.normal(size=(2, *shape)) * np.sqrt(noise[::2])[:, None]
    kept = []
    for step in range(_BURN + _KEPT):
        middle = rates.mean(axis=-1)
        precision = _draw_precision(rates - middle[..., None], scale, rng)
        common = _root_times(_inverse(precision), rng.normal(size=middle.shape))
        centre = middle + common / np.sqrt(shape[1])
        spread = tuple(part[:, None] for part in precision)
        posterior = _inverse(tuple(a + b for a, b in zip(weight, spread, strict=True)))  # type: ignore[arg-type]
        towards = pull[:, None] + _times(precision, centre)[..., None]
        rates = _times(posterior, towards) + _root_times(posterior, rng.normal(size=rates.shape))
        if step >= _BURN:
            kept.append(rates)
    return np.concatenate(kept, axis=1)


def _noise(outcomes: FloatArray) -> FloatArray:
    """(3, P) variance, covariance, variance of the rates that outcomes (2, P, S) give.

    A scene that is hard for all policies moves all rates alike, which neither r nor a rank
    violation sees: what the policies have in common is taken out.
    """
    num_policies = outcomes.shape[1]
    own = outcomes - np.nanmean(outcomes, axis=1, keepdims=True)
    own -= np.nanmean(own, axis=2, keepdims=True)
    pairs = np.stack([own[0] ** 2, own[0] * own[1], own[1] ** 2])
    count = np.isfinite(pairs).sum(axis=2)
    single = np.nansum(pairs, axis=2) / np.maximum(count - 1, 1)
    single *= num_policies / (num_policies - 1)
    share = count / (count + _POOL)
    return (share * single + (1 - share) * single.mean(axis=1, keepdims=True)) / np.maximum(
        count, 1
    )


def _draw_precision(away: FloatArray, scale: float, rng: np.random.Generator) -> Triple:
    """Inverse covariances (C,) given how far rates (2, C, P) are from the mean: Wishart."""
    chains, num = away.shape[1:]
    a, b, d = _inverse(
        (
            (away[0] ** 2).sum(-1) + scale,
            (away[0] * away[1]).sum(-1),
            (away[1] ** 2).sum(-1) + scale,
        )
    )
    degrees = _DEGREES + num - 1
    # Bartlett: a product of triangular matrices
    first, second = (np.sqrt(rng.chisquare(n, chains)) for n in (degrees, degrees - 1))
    low = rng.normal(size=chains)
    l00, l10 = np.sqrt(a), b / np.sqrt(a)
    l11 = np.sqrt(np.maximum(d - l10**2, 1e-12))
    m00, m10, m11 = l00 * first, l10 * first + l11 * low, l11 * second
    return m00**2, m00 * m10, m10**2 + m11**2


def _inverse(matrix: Triple) -> Triple:
    """Of symmetric 2x2 matrices (a, b, d)."""
    a, b, d = matrix
    scale = a * d - b * b
    return d / scale, -b / scale, a / scale


def _times(matrix: Triple, vector: FloatArray) -> FloatArray:
    a, b, d = matrix
    return np.stack([a * vector[0] + b * vector[1], b * vector[0] + d * vector[1]])


def _root_times(matrix: Triple, vector: FloatArray) -> FloatArray:
    """A triangular root of a covariance times standard normals: a draw."""
    a, b, d = matrix
    low = b / np.sqrt(a)
    second = np.sqrt(np.maximum(d - low**2, 1e-15))
    return np.stack([np.sqrt(a) * vector[0], low * vector[0] + second * vector[1]])
