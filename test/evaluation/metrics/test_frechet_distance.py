"""Against closed forms of the Frechet distance between Gaussians (Dowson and Landau, 1982)."""

import numpy as np
import pytest

from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.evaluation.metrics.feature_store import frechet_distance, frechet_interval


def sample(mean, covariance, count=400, seed=0):
    """Features whose sample mean and covariance are exactly the given ones."""
    mean, covariance = np.asarray(mean, float), np.asarray(covariance, float)
    raw = np.random.default_rng(seed).normal(size=(count, len(mean)))
    raw -= raw.mean(0)
    white = raw @ np.linalg.inv(np.linalg.cholesky(np.cov(raw.T))).T
    values, vectors = np.linalg.eigh(covariance)
    return white @ (vectors * np.sqrt(values.clip(0)) @ vectors.T) + mean


def turned(diagonal, seed=1):
    """A covariance of these eigenvalues; equal seeds give commuting ones."""
    count = len(diagonal)
    basis = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, count)))[0]
    return basis * diagonal @ basis.T


def test_equal_sets_are_at_distance_0():
    features = sample([1, 2, 3], np.diag([1, 4, 9]))
    assert frechet_distance(features, features) == pytest.approx(0, abs=1e-9)


def test_one_dimension_is_that_of_mean_and_deviation():
    found = frechet_distance(
        sample([2.0, 0.0], np.diag([9.0, 1e-12])), sample([-1.0, 0.0], np.diag([4.0, 1e-12]))
    )
    assert found == pytest.approx(3**2 + (3 - 2) ** 2, rel=1e-5)


def test_commuting_covariances_give_the_distance_of_the_roots_of_their_eigenvalues():
    first, second = np.array([1.0, 2.0, 3.0, 0.5]), np.array([4.0, 0.25, 3.0, 2.0])
    found = frechet_distance(
        sample([0, 0, 0, 0], turned(first)), sample([1, 0, -2, 0], turned(second), seed=4)
    )
    assert found == pytest.approx(5 + ((np.sqrt(first) - np.sqrt(second)) ** 2).sum())


def test_covariances_of_two_dimensions_that_do_not_commute():
    # 2x2: tr (C1 C2)^(1/2) = sqrt(tr(C1 C2) + 2 sqrt(det C1 det C2))
    first, second = np.array([[2.0, 1.0], [1.0, 3.0]]), np.array([[4.0, -1.0], [-1.0, 1.0]])
    dets = np.linalg.det(first) * np.linalg.det(second)
    root = np.sqrt(np.trace(first @ second) + 2 * np.sqrt(dets))
    expected = np.trace(first) + np.trace(second) - 2 * root + 2
    assert frechet_distance(sample([1, 1], first), sample([0, 0], second)) == pytest.approx(
        expected
    )


def test_rank_deficient_covariances_have_a_distance():
    # along one axis each: nothing is shared, so the root vanishes
    line = np.linspace(-1, 1, 5)
    zero = np.zeros(5)
    first, second = np.stack([line, zero, zero], 1), np.stack([zero, 2 * line, zero], 1)
    variance = line.var(ddof=1)
    assert frechet_distance(first, second) == pytest.approx(5 * variance)
    assert frechet_distance(first, 3 * first) == pytest.approx((3 - 1) ** 2 * variance)


def test_fewer_samples_than_features_agree_with_the_same_in_their_own_plane():
    rng = np.random.default_rng(2)
    flat = [rng.normal(size=(6, 3)) * scale for scale in (1.0, 2.0)]
    basis = np.linalg.qr(rng.normal(size=(200, 3)))[0]
    expected = _by_eigenvalues(*flat)
    assert frechet_distance(flat[0] @ basis.T, flat[1] @ basis.T) == pytest.approx(expected)


def _by_eigenvalues(first, second):
    product = np.cov(first.T) @ np.cov(second.T)
    root = np.sqrt(np.linalg.eigvals(product).real.clip(0)).sum()
    spread = np.cov(first.T).trace() + np.cov(second.T).trace() - 2 * root
    return ((first.mean(0) - second.mean(0)) ** 2).sum() + spread


def test_too_few_or_other_features_are_an_error():
    good = np.zeros((3, 4))
    with pytest.raises(MtvWorldError, match='at least two rows'):
        frechet_distance(good, good[:1])
    with pytest.raises(MtvWorldError, match='4 features against 5'):
        frechet_distance(good, np.zeros((3, 5)))
    with pytest.raises(MtvWorldError, match='finite'):
        frechet_distance(good, np.full((3, 4), np.nan))


def test_interval_holds_the_true_distance_as_often_as_it_says():
    # one feature, unit variances, means 2 apart: the distance is 4
    rng = np.random.default_rng(3)
    hits = 0
    for _ in range(100):
        real = [rng.normal(0, 1, (5, 1)) for _ in range(40)]
        other = [rng.normal(2, 1, (5, 1)) for _ in range(40)]
        low, high = frechet_interval(real, other)
        hits += low <= 4 <= high
    assert 88 <= hits <= 100


def test_interval_of_two_episodes_is_unknown():
    assert np.isnan(frechet_interval([np.zeros((2, 1))] * 2, [np.ones((2, 1))] * 2)).all()
