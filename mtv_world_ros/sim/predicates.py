"""Success predicates: pure functions over object positions and gripper openings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtv_world_ros.data_types import BoolArray, FloatArray

#: a gripper counts as open above this share of its range
OPEN_SHARE = 0.8
#: `final` means true in each of this many last samples (0.5 s at 10 Hz)
HELD_SAMPLES = 5

BESIDE_NEAREST_M, BESIDE_FARTHEST_M, BESIDE_DEPTH_M = 0.08, 0.2, 0.05
STACK_TOLERANCE_M = (0.025, 0.025, 0.012)


@dataclass(frozen=True, slots=True, kw_only=True)
class History:
    """What a predicate looks at, over T samples.

    Attributes:
        positions: role -> (T, 3) centre of the object in the base frame [m].
        heights: role -> height of the object [m].
        openings: (A, T) gripper openings in 0..1.
    """

    positions: dict[str, FloatArray]
    heights: dict[str, float]
    openings: FloatArray


def grippers_open(openings: FloatArray) -> BoolArray:
    """Returns (T,) where every gripper of (A, T) `openings` is open."""
    return np.all(np.asarray(openings) > OPEN_SHARE, axis=0)


def left_of(a: FloatArray, b: FloatArray) -> BoolArray:
    """Returns (T,) where `a` (T, 3) lies beside `b` (T, 3), on its left (smaller x)."""
    offset = np.asarray(a)[:, :2] - np.asarray(b)[:, :2]
    distance = np.linalg.norm(offset, axis=1)
    near = (distance > BESIDE_NEAREST_M) & (distance < BESIDE_FARTHEST_M)
    return near & (offset[:, 0] < 0) & (np.abs(offset[:, 1]) < BESIDE_DEPTH_M)


def stacked(upper: FloatArray, lower: FloatArray, rise: float) -> BoolArray:
    """Returns (T,) where `upper` (T, 3) rests on `lower` (T, 3).

    Args:
        upper: centre of the upper object [m].
        lower: centre of the lower object [m].
        rise: height of the upper centre over the lower one when it rests there [m].
    """
    error = np.abs(np.asarray(upper) - np.asarray(lower) - np.array([0.0, 0.0, rise]))
    return np.all(error < np.asarray(STACK_TOLERANCE_M), axis=1)


def a_left_of_b(history: History) -> BoolArray:
    """Returns (T,) success of `place_block_a2b_left`."""
    beside = left_of(history.positions['a'], history.positions['b'])
    return beside & grippers_open(history.openings)


def a_on_b(history: History) -> BoolArray:
    """Returns (T,) success of `stack_blocks_two`: block `a` on block `b`."""
    rise = (history.heights['a'] + history.heights['b']) / 2
    on = stacked(history.positions['a'], history.positions['b'], rise)
    return on & grippers_open(history.openings)


def ever_and_final(success: BoolArray, held: int = HELD_SAMPLES) -> tuple[bool, bool]:
    """Returns whether (T,) `success` held at any sample, and in each of the last `held`."""
    return bool(success.any()), bool(len(success) >= held and success[-held:].all())
