"""What an estimate amounts to: a success, a failure, or neither."""

from __future__ import annotations

from math import isnan, nan

#: an estimate from here on is called a success. A false success costs more than a false failure,
#: so that more than an even chance is required
SUCCESS_FROM = 0.75
#: an estimate below this is called a failure; between the two, the verdict is open
FAILURE_BELOW = 0.5


def verdict(probability: float) -> float:
    """Returns 1 = a success, 0 = a failure, NaN = open, or the estimator abstained (NaN)."""
    if probability >= SUCCESS_FROM:
        return 1.0
    return 0.0 if probability < FAILURE_BELOW else nan


def verdict_word(probability: float) -> str:
    """Returns `success`, `failure`, `open`, or `abstains` where the probability is NaN."""
    if isnan(probability):
        return 'abstains'
    return {1.0: 'success', 0.0: 'failure'}.get(verdict(probability), 'open')
