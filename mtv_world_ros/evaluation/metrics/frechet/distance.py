"""Frechet distance between two sets of features, each taken for a Gaussian."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import MtvWorldError
from mtv_world_ros.evaluation.metrics.statistics import MIN_EPISODES, t_quantile, UNKNOWN

#: most groups of episodes that are left out in turn for an interval
MAX_GROUPS = 10


def frechet_distance(real: FloatArray, predicted: FloatArray) -> float:
    """Returns |m1 - m2|^2 + tr(C1 + C2 - 2 (C1 C2)^(1/2)) of the sample means and covariances.

    With C = A^T A the trace of the root is the sum of the singular values of A1 A2^T, so no root
    of a matrix is taken: the result is real and not negative whatever the rank of C, also with
    fewer samples than features.

    Args:
        real: (N, D) features, N >= 2.
        predicted: (M, D) features, M >= 2.

    Raises:
        MtvWorldError: fewer than two samples, other numbers of features, or not finite.
    """
    _check(real, predicted)
    (mean1, root1), (mean2, root2) = _moments(real), _moments(predicted)
    cross = np.linalg.svd(root1 @ root2.T, compute_uv=False).sum()
    spread = (root1**2).sum() + (root2**2).sum() - 2 * cross
    return float(((mean1 - mean2) ** 2).sum() + max(spread, 0.0))


def _check(real: FloatArray, predicted: FloatArray) -> None:
    for name, features in (('real', real), ('predicted', predicted)):
        if features.ndim != 2 or len(features) < 2 or not np.isfinite(features).all():
            raise MtvWorldError(
                f'Frechet distance: {name} features of shape {features.shape}; needed are at '
                'least two rows of finite numbers (score more episodes)'
            )
    if real.shape[1] != predicted.shape[1]:
        raise MtvWorldError(
            f'Frechet distance: {real.shape[1]} features against {predicted.shape[1]}; both must '
            'come from the same network'
        )


def _moments(features: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (D,) and A (at most min(N, D) rows) with A^T A the sample covariance."""
    features = np.asarray(features, np.float64)
    mean = features.mean(0)
    root = (features - mean) / np.sqrt(len(features) - 1)
    if len(root) > root.shape[1]:
        root = np.asarray(np.linalg.qr(root, mode='r'), np.float64)
    return mean, root


def frechet_interval(
    real: Sequence[FloatArray], predicted: Sequence[FloatArray]
) -> tuple[float, float]:
    """Returns a 95 % interval of the distance, by leaving out groups of episodes in turn.

    A bootstrap would not do: a resample holds some samples twice, has a smaller covariance, and
    lies further from the other set. The distance itself falls as samples grow in number; compare
    only distances of equally many.

    Args:
        real: (N, D) features of each episode.
        predicted: (M, D) features of each episode, in the same order.

    Returns:
        The distance of all -/+ the t quantile of the groups times the jackknife standard error,
        not below 0; NaN with fewer than `MIN_EPISODES` episodes.
    """
    count = len(real)
    if count < MIN_EPISODES:
        return UNKNOWN
    whole = frechet_distance(np.concatenate(real), np.concatenate(predicted))
    groups = np.array_split(np.arange(count), min(count, MAX_GROUPS))
    left = []
    for group in groups:
        kept = [index for index in range(count) if index not in set(group.tolist())]
        parts = (np.concatenate([features[k] for k in kept]) for features in (real, predicted))
        left.append(frechet_distance(*parts))
    share = (len(groups) - 1) / len(groups)
    error = np.sqrt(share * ((np.array(left) - np.mean(left)) ** 2).sum())
    half = float(t_quantile(len(groups) - 1) * error)
    return (max(whole - half, 0.0), whole + half)
