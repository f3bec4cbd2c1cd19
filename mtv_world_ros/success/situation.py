"""Input of relations: poses and sizes of objects, and gripper openings, over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from mtv_world_ros.cameras.mask_geometry import count_reversals, widest_swing
from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import CannotTell

#: minimum opening of an open gripper [fraction of its range]
OPEN_SHARE = 0.8
#: distance of a tool from an object's centre beyond which it does not hold the object [m]
AWAY_M = 0.1


class Situation(Protocol):
    """Objects by their role in the task, over T samples; the last sample is the end.

    Lengths in metres in the base frame: x to the right, y away from the robot, z up from the
    table. A situation may know where objects are only at the end; then T = 1. Every method raises
    CannotTell where the answer is not known.
    """

    @property
    def tools(self) -> FloatArray | None:
        """Positions (A, T, 3) of the tools [m]; None = not known."""
        ...

    def centres(self, role: str) -> FloatArray:
        """Return the object's centre (T, 3) [m]."""
        ...

    def offsets(self, role: str, target: str) -> FloatArray:
        """Return the object's centre (T, 3) from the target's, in the target's own frame [m]."""
        ...

    def start(self, role: str) -> FloatArray:
        """Return the object's centre (3,) at the start of the episode [m]."""
        ...

    def goal(self, role: str) -> FloatArray:
        """Return where the object's centre (3,) is to be, if the scene came with a goal [m]."""
        ...

    def size(self, role: str) -> FloatArray:
        """Return the full extents (3,) of the object in its own frame [m]."""
        ...

    def seen_size(self, role: str) -> tuple[float, float]:
        """Return the object's mean width and its height as it stands at the start [m]."""
        ...

    def clearances(self, role: str) -> FloatArray:
        """Return the height (T,) of the object's lowest point over the table [m]."""
        ...

    def reversals(self, role: str, swing: float) -> FloatArray:
        """Return (T,) how often the object's lean has turned back by more than `swing` [rad]."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class TruePoses:
    """A `Situation` whose poses are known, of T samples and A grippers: a simulator's.

    Attributes:
        positions: role -> (T, 3) centre of the object in the base frame [m].
        rotations: role -> (T, 3, 3) rotation of T_base_object.
        sizes: role -> (x, y, z) full extents of the object in its own frame [m].
        openings: (A, T) gripper openings in 0..1.
        goals: role -> (3,) where the object's centre is to be [m]; of tasks whose goal is drawn
            with the scene.
        tools: (A, T, 3) positions of the tools [m]; None = not known.
    """

    positions: Mapping[str, FloatArray]
    rotations: Mapping[str, FloatArray]
    sizes: Mapping[str, tuple[float, float, float]]
    openings: FloatArray
    goals: Mapping[str, FloatArray] = field(default_factory=dict)
    tools: FloatArray | None = None

    def centres(self, role: str) -> FloatArray:
        """See `Situation`."""
        return self.positions[role]

    def offsets(self, role: str, target: str) -> FloatArray:
        """See `Situation`."""
        offset = self.positions[role] - self.positions[target]
        return np.einsum('tji,tj->ti', self.rotations[target], offset)

    def start(self, role: str) -> FloatArray:
        """See `Situation`."""
        return self.positions[role][0]

    def goal(self, role: str) -> FloatArray:
        """See `Situation`."""
        if role not in self.goals:
            raise CannotTell(f"the scene has no goal for '{role}'")
        return self.goals[role]

    def size(self, role: str) -> FloatArray:
        """See `Situation`."""
        return np.asarray(self.sizes[role])

    def seen_size(self, role: str) -> tuple[float, float]:
        """See `Situation`."""
        wide, long, high = self.sizes[role]
        return (wide + long) / 2, high

    def clearances(self, role: str) -> FloatArray:
        """See `Situation`; the object is taken as an upright cylinder."""
        width, _, height = self.sizes[role]
        tilt = np.arccos(np.clip(self.rotations[role][:, 2, 2], -1, 1))
        drop = height / 2 * np.cos(tilt) + width / 2 * np.sin(tilt)
        return self.positions[role][:, 2] - drop

    def reversals(self, role: str, swing: float) -> FloatArray:
        """See `Situation`; the lean is that of the object's z axis, where it swings most."""
        axis = self.rotations[role][:, :, 2]
        return count_reversals(np.arctan2(widest_swing(axis[:, :2]), axis[:, 2]), swing)


def grippers_open(openings: FloatArray) -> BoolArray:
    """Return (T,) where every gripper of (A, T) `openings` is open."""
    return np.all(np.asarray(openings) > OPEN_SHARE, axis=0)


def grippers_released(
    openings: FloatArray, tools: FloatArray | None, centres: FloatArray
) -> BoolArray:
    """Return (T,) where every gripper is open, or away from the objects that it was to move.

    Args:
        openings: (A, T) openings of the grippers, 0 closed to 1 open.
        tools: (A, T, 3) positions of the tools [m]; None = not known: only open ones count.
        centres: (M, T, 3) centres of the objects that may be held [m], NaN = not known.
    """
    is_free = np.asarray(openings) > OPEN_SHARE
    if tools is not None and len(centres):
        away = np.linalg.norm(tools[:, None] - centres[None], axis=-1)
        is_free = is_free | (away > AWAY_M).all(1)
    return np.all(is_free, axis=0)
