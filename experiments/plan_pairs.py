"""Tables of plans of one scene under common futures: pairs, and the best of N.

For the logs of `shifted_worlds.py`: rollouts of a scene (task and seed of a physics) are plans
that start from one picture and meet the same futures.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from math import isfinite, nan
from typing import Any

import numpy as np

from mtv_world_ros.evaluation.metrics.statistics import clustered_wilson, mean_interval
from mtv_world_ros.success.comparison import Comparison, Outcomes
from mtv_world_ros.success.estimator import verdict
from mtv_world_ros.success.share_fit import ShareEstimate

PAIRS = ('truth', 'futures of', 'scenes', 'pairs whose outcomes differ', 'ordered',
         'right, of ordered', 'two verdicts tell',
         'ordered, though outcomes are equal')  # fmt: skip
BEST = ('truth', 'futures of', 'N', 'scenes', 'first succeeds', 'chosen', 'chosen - first',
        'best of N', 'share of the gain')  # fmt: skip
#: numbers of plans that one is chosen from
NUM_PLANS = (2, 4, 8)
#: random choices and orders of N plans of each scene
DRAWS = 500
Line = dict[str, Any]


def outcomes_of(said: Line) -> Outcomes:
    """Return the outcomes that a line of a log has for one judge; empty = nothing was foreseen."""
    done, weights = said.get('done', []), said.get('weights', [])
    return tuple(bool(d) if w > 0 else None for d, w in zip(done, weights, strict=True))


def scenes_of(lines: Sequence[Line]) -> list[list[int]]:
    """Return the indices of the rollouts of each scene."""
    found: dict[tuple, list[int]] = {}
    for number, line in enumerate(lines):
        found.setdefault(tuple(line['job'][1:4]), []).append(number)
    return list(found.values())


def pair_cells(
    lines: Sequence[Line], outcomes: Sequence[Outcomes], estimates: Sequence[ShareEstimate]
) -> list[str]:
    """Return cells of `PAIRS` after the first two.

    Args:
        lines: N rollouts in one physics.
        outcomes: outcomes of each in its futures.
        estimates: absolute estimates of each.
    """
    scenes = scenes_of(lines)
    calls = [verdict(one.probability, one[1:]) for one in estimates]
    # by scene: pairs that differ, ordered of these, right of these, told by verdicts, ordered
    # though equal, equal
    counts = np.zeros((len(scenes), 6))
    for row, scene in zip(counts, scenes, strict=True):
        for a, b in combinations(scene, 2):
            (pair,) = Comparison.of([outcomes[a], outcomes[b]]).pairs or (None,)
            better = None if pair is None else pair.better
            real = [lines[a]['final'], lines[b]['final']]
            if real[0] == real[1]:
                row[4:] += better is not None, 1
                continue
            is_told = isfinite(calls[a]) and isfinite(calls[b]) and calls[a] != calls[b]
            row[:4] += 1, better is not None, better is not None and real[better], is_told
    differ, ordered, right, told, though, equal = counts.T
    return [
        str(len(scenes)),
        f'{differ.sum():.0f}',
        share(ordered, differ),
        share(right, ordered),
        share(told, differ),
        share(though, equal),
    ]


def share(hits: np.ndarray, among: np.ndarray) -> str:
    """Return a share as text, with its 95 % interval over scenes."""
    if not among.sum():
        return '–'
    low, high = clustered_wilson(hits, among)
    interval = f' [{low:.2f}, {high:.2f}]' if isfinite(low) else ''
    return f'{hits.sum():.0f} of {among.sum():.0f}{interval}'


def best_cells(lines: Sequence[Line], outcomes: Sequence[Outcomes], num: int) -> list[str] | None:
    """Return cells of `BEST` after the first three; None = no scene has as many plans.

    Args:
        lines: rollouts in one physics.
        outcomes: outcomes of each in its futures.
        num: number of plans, drawn from those of a scene in random order.
    """
    rng = np.random.default_rng(0)
    means = []
    for scene in scenes_of(lines):
        if len(scene) < num:
            continue
        found = []
        for _ in range(DRAWS):
            drawn = rng.permutation(scene)[:num]
            real = [bool(lines[k]['final']) for k in drawn]
            chosen = Comparison.of([outcomes[k] for k in drawn]).best
            found.append((real[0], real[chosen], any(real)))
        means.append(np.mean(found, axis=0))
    if not means:
        return None
    first, chosen, best = np.transpose(means)
    columns = np.stack([first, chosen, chosen - first, best], axis=1)
    mean, ends = mean_interval(columns, np.ones_like(columns), low=-1.0, high=1.0)
    gain = mean[2] / (mean[3] - mean[0]) if mean[3] > mean[0] else nan
    return [
        str(len(means)),
        f'{mean[0]:.2f}',
        f'{mean[1]:.2f}',
        f'{mean[2]:+.2f} [{ends[0, 2]:+.2f}, {ends[1, 2]:+.2f}]',
        f'{mean[3]:.2f}',
        f'{gain:.2f}' if isfinite(gain) else '–',
    ]
