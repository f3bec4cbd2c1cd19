"""What else an estimate has to doubt than the pictures: the cameras, the physics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import nan

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
