"""What was said against what came true, in bins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mtv_world_ros.evaluation.metrics.policy_agreement import wilson
from mtv_world_ros.evaluation.metrics.success_agreement import Bin, Judgement

_NUM_BINS = 5


def reliability_bins(judgements: Sequence[Judgement]) -> list[Bin]:
    """Returns the bins that hold an estimate of known outcome; empty = there is none."""
    judged = [
        item
        for item in judgements
        if item.outcome in ('success', 'failure') and np.isfinite(item.probability)
    ]
    said = np.array([item.probability for item in judged])
    true = np.array([item.outcome == 'success' for item in judged], bool)
    place = np.minimum((said * _NUM_BINS).astype(int), _NUM_BINS - 1)
    return [
        Bin(
            middle=(k + 0.5) / _NUM_BINS,
            said=float(said[place == k].mean()),
            came_true=float(true[place == k].mean()),
            interval=wilson(int(true[place == k].sum()), int((place == k).sum())),
            count=int((place == k).sum()),
        )
        for k in range(_NUM_BINS)
        if (place == k).any()
    ]
