"""Success predicates: pure functions over object poses and gripper openings.

Lengths in metres, x to the right, y away from the robot, z up. A distance in the plane is that of
the centres in x and y.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mtv_world_ros.data_types import BoolArray, FloatArray
from mtv_world_ros.geometry.mask_geometry import count_reversals
from mtv_world_ros.sim.shape_geoms import FLOOR_M

#: a gripper counts as open above this share of its range
OPEN_SHARE = 0.8
#: `final` means true in each of this many last samples (0.5 s at 10 Hz)
HELD_SAMPLES = 5

BESIDE_NEAREST_M, BESIDE_FARTHEST_M, BESIDE_DEPTH_M = 0.08, 0.2, 0.05
STACK_TOLERANCE_M = (0.025, 0.025, 0.012)
COLLECTED_M = 0.05  # from the container's centre
MOVED_TO_M = 0.03  # from the goal
MOVED_AWAY_M = 0.1  # from the start
PLATE_M, PLATE_RISE_M = 0.04, 0.02  # plate on plate
SERVED_M, SERVED_RISE_M = 0.035, 0.015  # bread or cup on plate
LIFTED_M = 0.06  # the object's lowest point over the table
NUM_REVERSALS, SWING_RAD = 2, 0.15
APART_M = 0.06  # two blocks beside each other
#: an object in a container may lean on its wall: its centre is at most this far over the wall
OVER_WALL_M = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class History:
    """What a predicate looks at, over T samples.

    Attributes:
        positions: role -> (T, 3) centre of the object in the base frame [m].
        rotations: role -> (T, 3, 3) T_base_object's rotation.
        sizes: role -> (x, y, z) full extents of the object in its own frame [m].
        openings: (A, T) gripper openings in 0..1.
        starts: role -> (3,) centre at the start of the episode [m].
        goals: of each of the task's moves, the resting centre (3,) of what is moved [m].
    """

    positions: dict[str, FloatArray]
    rotations: dict[str, FloatArray]
    sizes: dict[str, tuple[float, float, float]]
    openings: FloatArray
    starts: dict[str, FloatArray]
    goals: tuple[FloatArray, ...] = ()


Predicate = Callable[[History], BoolArray]


def grippers_open(openings: FloatArray) -> BoolArray:
    """Returns (T,) where every gripper of (A, T) `openings` is open."""
    return np.all(np.asarray(openings) > OPEN_SHARE, axis=0)


def plane_distance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Returns the (T,) distance of centres (T, 3) or (3,) in x and y [m]."""
    return np.linalg.norm((np.asarray(a) - np.asarray(b))[..., :2], axis=-1)


def beside(a: FloatArray, b: FloatArray, side: float) -> BoolArray:
    """Returns (T,) where `a` (T, 3) lies beside `b` (T, 3); side -1 = left of it, +1 = right."""
    offset = np.asarray(a) - np.asarray(b)
    distance = plane_distance(a, b)
    near = (distance > BESIDE_NEAREST_M) & (distance < BESIDE_FARTHEST_M)
    return near & (side * offset[:, 0] > 0) & (np.abs(offset[:, 1]) < BESIDE_DEPTH_M)


def stacked(upper: FloatArray, lower: FloatArray, rise: float) -> BoolArray:
    """Returns (T,) where `upper` (T, 3) rests on `lower` (T, 3).

    Args:
        upper: centre of the upper object [m].
        lower: centre of the lower object [m].
        rise: height of the upper centre over the lower one when it rests there [m].
    """
    error = np.abs(np.asarray(upper) - np.asarray(lower) - np.array([0.0, 0.0, rise]))
    return np.all(error < np.asarray(STACK_TOLERANCE_M), axis=1)


def in_frame(history: History, item: str, frame: str) -> FloatArray:
    """Returns the centres (T, 3) of one object in the frame of another [m]."""
    offset = history.positions[item] - history.positions[frame]
    return np.einsum('tji,tj->ti', history.rotations[frame], offset)


def over_floor(history: History, item: str, container: str) -> BoolArray:
    """Returns (T,) where the item's centre is between a container's floor and over its wall."""
    height = in_frame(history, item, container)[:, 2] + history.sizes[container][2] / 2
    return (height > 0.005) & (height < history.sizes[container][2] + OVER_WALL_M)


def num_reversals(up: FloatArray, swing: float = SWING_RAD) -> FloatArray:
    """Returns (T,) how often an axis has turned back by more than `swing` so far.

    Args:
        up: (T, 3) the object's own z axis in the base frame.
        swing: smaller turns are noise [rad].
    """
    lean = np.asarray(up)[:, :2]
    # the line along which it swings most
    direction = np.linalg.svd(lean - lean.mean(0))[2][0]
    angles = np.arctan2(lean @ direction, np.asarray(up)[:, 2])
    return count_reversals(angles, swing)


def all_of(*predicates: Predicate) -> Predicate:
    """Returns the predicate that holds where each of them does and both grippers are open."""

    def succeeds(history: History) -> BoolArray:
        held = [predicate(history) for predicate in predicates]
        return np.all([*held, grippers_open(history.openings)], axis=0)

    return succeeds


def is_beside(a: str, b: str, side: float) -> Predicate:
    """`a` lies on the left (-1) or the right (+1) of `b`."""
    return lambda history: beside(history.positions[a], history.positions[b], side)


def is_apart(a: str, b: str) -> Predicate:
    """Two objects stand apart."""
    return lambda history: plane_distance(history.positions[a], history.positions[b]) > APART_M


def is_stacked(upper: str, lower: str) -> Predicate:
    """One block stands on another."""

    def holds(history: History) -> BoolArray:
        rise = (history.sizes[upper][2] + history.sizes[lower][2]) / 2
        return stacked(history.positions[upper], history.positions[lower], rise)

    return holds


def has_moved(item: str) -> Predicate:
    """It is away from where it started."""
    return lambda history: (
        plane_distance(history.positions[item], history.starts[item]) > MOVED_AWAY_M
    )


def is_at_goal(move: int, item: str) -> Predicate:
    """It is where that move was to bring it, standing on the table."""

    def holds(history: History) -> BoolArray:
        goal, centres = history.goals[move], history.positions[item]
        rise = np.abs(centres[:, 2] - goal[2])
        return (plane_distance(centres, goal) < MOVED_TO_M) & (rise < MOVED_TO_M)

    return holds


def is_served(item: str, plate: str) -> Predicate:
    """Bread or a cup stands on the plate."""

    def holds(history: History) -> BoolArray:
        centres, plates = history.positions[item], history.positions[plate]
        rest = (history.sizes[item][2] - history.sizes[plate][2]) / 2 + FLOOR_M
        rise = np.abs(centres[:, 2] - plates[:, 2] - rest)
        return (plane_distance(centres, plates) < SERVED_M) & (rise < SERVED_RISE_M)

    return holds


def are_plates_stacked(upper: str, lower: str) -> Predicate:
    """One plate lies in or on another."""

    def holds(history: History) -> BoolArray:
        over = history.positions[upper] - history.positions[lower]
        rise = over[:, 2] - history.sizes[lower][2] / 2
        near = plane_distance(history.positions[upper], history.positions[lower]) < PLATE_M
        return near & (np.abs(rise) < PLATE_RISE_M)

    return holds


def are_collected(items: Sequence[str], container: str) -> Predicate:
    """Every item is near the middle of the container, in or on it."""

    def holds(history: History) -> BoolArray:
        held = [
            (plane_distance(history.positions[item], history.positions[container]) < COLLECTED_M)
            & over_floor(history, item, container)
            for item in items
        ]
        return np.all(held, axis=0)

    return holds


def are_inside(items: Sequence[str], container: str, *, footprint: bool = False) -> Predicate:
    """Every item's centre, or whole footprint, is within the container's rectangle."""

    def holds(history: History) -> BoolArray:
        held = []
        for item in items:
            room = np.asarray(history.sizes[container][:2]) / 2
            if footprint:
                room = room - max(history.sizes[item][:2]) / 2
            offset = np.abs(in_frame(history, item, container)[:, :2])
            held.append(np.all(offset < room, axis=1) & over_floor(history, item, container))
        return np.all(held, axis=0)

    return holds


def is_shaken(item: str) -> Predicate:
    """It was lifted and swung to and fro; that stays true once it has happened."""

    def holds(history: History) -> BoolArray:
        centres, size = history.positions[item], history.sizes[item]
        up = history.rotations[item][:, :, 2]
        # lowest point of the tilted cylinder
        tilt = np.arccos(np.clip(up[:, 2], -1, 1))
        drop = size[2] / 2 * np.cos(tilt) + size[0] / 2 * np.sin(tilt)
        lifted = centres[:, 2] - drop > LIFTED_M
        swung = np.diff(num_reversals(up), prepend=0.0) * lifted
        return np.cumsum(swung) >= NUM_REVERSALS

    return holds


def ever_and_final(success: BoolArray, held: int = HELD_SAMPLES) -> tuple[bool, bool]:
    """Returns whether (T,) `success` held at any sample, and in each of the last `held`."""
    return bool(success.any()), bool(len(success) >= held and success[-held:].all())
