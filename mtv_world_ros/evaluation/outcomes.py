"""How well success estimates agree with what really happened."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """The estimate at the end of an episode.

    Attributes:
        probability: NaN = abstained.
        outcome: `success`, `failure` or `unknown`.
    """

    probability: float
    outcome: str


def agreement(judgements: Sequence[Judgement]) -> dict[str, Any]:
    """Returns counts, accuracy at one half, Brier score and false-success rate; None = unknown.

    The false-success rate is the share of real failures that were called a success.
    """
    known = [item for item in judgements if item.outcome in ('success', 'failure')]
    judged = [item for item in known if np.isfinite(item.probability)]
    probability = np.array([item.probability for item in judged])
    real = np.array([item.outcome == 'success' for item in judged], bool)
    called = probability > 0.5
    return {
        'num_outcomes_known': len(known),
        'num_abstained': len(known) - len(judged),
        'real_success_rate': _mean(np.array([item.outcome == 'success' for item in known])),
        'estimated_success_rate': _mean(probability),
        'accuracy': _mean(called == real),
        'brier': _mean((probability - real) ** 2),
        'false_success_rate': _mean(called[~real]),
    }


def _mean(values: np.ndarray) -> float | None:
    return float(np.mean(values)) if len(values) else None
