"""What else an estimate has to doubt than the pictures: the cameras, the physics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import isfinite, nan

from mtv_world_ros.data_types import SuccessEstimate


def doubted(
    estimate: SuccessEstimate, notes: Sequence[str] = (), refusal: str = ''
) -> SuccessEstimate:
    """Returns an estimate that says its doubts.

    Args:
        estimate: of pictures and foreseen motions.
        notes: remarks for the reader, one line each.
        refusal: why there is no verdict; empty = there may be one.
    """
    if refusal:
        return replace(
            estimate,
            probability=nan,
            interval=(nan, nan),
            reasons=(f'abstains: {refusal}', *estimate.reasons),
        )
    return replace(estimate, reasons=(*estimate.reasons, *notes)) if notes else estimate


#: an estimate that is doubted is drawn to even chances by this share, and known no better than so
_DRAWN, _HALF_WIDTH = 0.5, 0.35


def widened(estimate: SuccessEstimate, doubt: str) -> SuccessEstimate:
    """Returns an estimate of futures that are not to be believed as they are.

    Args:
        estimate: as if they were.
        doubt: why they are not.
    """
    reasons = (doubt, *estimate.reasons)
    if not isfinite(estimate.probability):
        return replace(estimate, reasons=reasons)
    middle = 0.5 + (1 - _DRAWN) * (estimate.probability - 0.5)
    low, high = estimate.interval
    interval = (
        max(min(low, middle - _HALF_WIDTH), 0.0),
        min(max(high, middle + _HALF_WIDTH), 1.0),
    )
    return replace(estimate, probability=middle, interval=interval, reasons=reasons)
