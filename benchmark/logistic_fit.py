"""The calibration's logistic fit against scipy's SLSQP on random data sets.

Half of the sets contradict the prior, some are separable, some have features that never vary.
Prints how far the objective and the weights of `fit_logistic` are from the other solver's.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.optimize import Bounds, minimize
from scipy.special import expit, log_expit

from mtv_world_ros.lab.evaluation.calibration.fit import fit_logistic, MAX_BIAS


def random_set(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Returns features (N, F), labels (N,), a prior (F,) and a penalty."""
    rng = np.random.default_rng(seed)
    num, count = int(rng.integers(8, 300)), int(rng.integers(1, 9))
    features = rng.normal(size=(num, count))
    features[:, rng.uniform(size=count) < 0.1] = 0.0
    prior = np.abs(rng.normal(size=count)) * 10.0 ** rng.uniform(-1, 1)
    truth = prior * (-1 if seed % 2 else 1) * rng.uniform(0, 2, count)
    logits = features @ truth + rng.normal()
    labels = logits > 0 if seed % 10 == 9 else rng.uniform(size=num) < expit(logits)
    return features, labels, prior, float(10.0 ** rng.uniform(-2, 1))


def objective(
    theta: np.ndarray, features: np.ndarray, labels: np.ndarray, prior: np.ndarray, l2: float
) -> float:
    """Returns what the fit minimises, written down once more."""
    signs = np.where(labels, 1.0, -1.0) * (features @ theta[:-1] + theta[-1])
    return float(-log_expit(signs).sum() + l2 / 2 * ((theta[:-1] - prior) ** 2).sum())


def other_solver(
    features: np.ndarray, labels: np.ndarray, prior: np.ndarray, l2: float
) -> np.ndarray:
    """Returns the weights and the bias that scipy's SLSQP finds."""
    design = np.column_stack([features, np.ones(len(features))])
    penalty = np.append(np.full(features.shape[1], l2), 0.0)
    centre = np.append(prior, 0.0)

    def gradient(theta: np.ndarray) -> np.ndarray:
        return design.T @ (expit(design @ theta) - labels) + penalty * (theta - centre)

    low = np.append(np.zeros(features.shape[1]), -MAX_BIAS)
    high = np.append(np.full(features.shape[1], np.inf), MAX_BIAS)
    start = np.append(prior + 0.1, 0.0)
    for _ in range(20):  # begun anew where the line search gave up
        found = minimize(
            objective, start, (features, labels, prior, l2), method='SLSQP',
            jac=lambda theta, *_: gradient(theta), bounds=Bounds(low, high),  # type: ignore
            options={'ftol': 1e-15, 'maxiter': 2000},
        )  # fmt: skip
        if np.abs(found.x - start).max() < 1e-9:
            break
        start = found.x
    return start


def compared(seed: int) -> tuple[float, float, bool]:
    """Returns how much higher our objective is, the largest difference, one outcome only.

    The difference is that of a weight or of the bias; of a set of one outcome of a weight alone:
    its bias has no minimum within reach (exp(-26) of a slope is left at 26), only a bound.
    """
    features, labels, prior, l2 = random_set(seed)
    ours = fit_logistic(features, labels, l2=l2, prior=prior, non_negative=True)
    mine = np.append(ours.weights, ours.bias)
    theirs = other_solver(features, labels, prior, l2)
    values = [objective(theta, features, labels, prior, l2) for theta in (mine, theirs)]
    one_outcome = bool(labels.all() or not labels.any())
    differences = np.abs(mine - theirs)[: -1 if one_outcome else None]
    return values[0] - values[1], float(differences.max()), one_outcome


def main() -> None:
    """Compares and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--sets', type=int, default=1000)
    num = parser.parse_args().sets
    found = np.array([compared(seed) for seed in range(num)])
    print(
        f'{num} data sets, {num // 2} of them contradict the prior, {found[:, 2].sum():.0f} have '
        'one outcome only (their bias is not compared)'
    )
    print(f'objective above the other solver at most {found[:, 0].max():.2e}')
    better = found[:, 0] < -1e-6
    print(f'sets in which the other solver stopped above our minimum: {better.sum()}')
    found = found[~better]
    print(f'largest difference of a weight or bias: median {np.median(found[:, 1]):.2e}, '
          f'99th percentile {np.percentile(found[:, 1], 99):.2e}, '
          f'most {found[:, 1].max():.2e}')  # fmt: skip


if __name__ == '__main__':
    main()
