"""Logistic regression with an L2 penalty, by Newton's method."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtv_world_ros.data_types import BoolArray, FloatArray
from mtv_world_ros.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class Logistic:
    """P(true) = 1 / (1 + exp(-(weights x + bias))).

    Attributes:
        weights: (F,).
        bias: is not penalised.
    """

    weights: FloatArray
    bias: float

    def probability(self, features: FloatArray) -> FloatArray:
        """Returns (N,) for features (N, F)."""
        return _sigmoid(features @ self.weights + self.bias)


def fit_logistic(
    features: FloatArray,
    labels: BoolArray,
    *,
    l2: float = 1.0,
    prior: FloatArray | None = None,
    num_steps: int = 100,
) -> Logistic:
    """Minimises -log likelihood + l2 / 2 * |weights - prior|^2 (scikit-learn's with C = 1 / l2).

    Args:
        features: (N, F).
        labels: (N,).
        l2: strength of the penalty; positive, so that there is one minimum.
        prior: (F,) weights that hold where the rows say nothing; None = zero.
        num_steps: of Newton's method at most.

    Raises:
        ConfigError: there are no rows, or `l2` is not positive.
    """
    if not len(features) or l2 <= 0:
        raise ConfigError(
            f'a logistic is fitted to {len(features)} episodes with l2 = {l2}; it needs at least '
            'one episode and a positive l2'
        )
    design = np.concatenate([features, np.ones((len(features), 1))], axis=1)
    penalty = np.full(design.shape[1], l2)
    penalty[-1] = 1e-9  # keeps the bias finite where all labels are equal
    centre = np.zeros(design.shape[1])
    if prior is not None:
        centre[:-1] = prior
    theta = centre.copy()
    for _ in range(num_steps):
        said = _sigmoid(design @ theta)
        gradient = design.T @ (said - labels) + penalty * (theta - centre)
        curvature = (design * (said * (1 - said))[:, None]).T @ design + np.diag(penalty)
        step = np.linalg.solve(curvature, gradient)
        # far from the minimum a whole step may overshoot
        theta -= step * min(1.0, 5.0 / max(float(np.abs(step).max()), 1e-12))
        if np.abs(step).max() < 1e-10 or np.abs(theta[-1]) > 30:
            break
    return Logistic(weights=theta[:-1], bias=float(theta[-1]))


def fit_non_negative(
    features: FloatArray, labels: BoolArray, *, l2: float = 1.0, prior: FloatArray
) -> Logistic:
    """Fits with weights of at least 0, for features that are larger where it is likelier.

    A feature whose weight comes out negative, the most negative one first, is left out (weight
    0) and the others are fitted again.

    Args:
        features: (N, F).
        labels: (N,).
        l2: see `fit_logistic`.
        prior: (F,), at least 0.

    Raises:
        ConfigError: see `fit_logistic`.
    """
    kept = np.arange(features.shape[1])
    while True:
        found = fit_logistic(features[:, kept], labels, l2=l2, prior=prior[kept])
        if (found.weights >= 0).all():
            break
        kept = np.delete(kept, int(np.argmin(found.weights)))
    weights = np.zeros(features.shape[1])
    weights[kept] = found.weights
    return Logistic(weights=weights, bias=found.bias)


def _sigmoid(logits: FloatArray) -> FloatArray:
    return 0.5 * (1 + np.tanh(logits / 2))
