"""Way points of an arm, and the visit of a second arm: what the expert plans and faults change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mtv_world_ros.core.data_types import FloatArray

#: mask of the horizontal components of a vector
FLAT = np.array([1.0, 1.0, 0.0])
#: unit vector upwards
UP = np.array([0.0, 0.0, 1.0])


def ring(angle: float) -> FloatArray:
    """Return the unit vector (3,) in the plane at an angle [rad] from x."""
    return np.array([np.cos(angle), np.sin(angle), 0.0])


@dataclass(frozen=True, slots=True)
class WayPoint:
    """Pose of one arm's tool and opening of its gripper at the end of a segment.

    Attributes:
        phase: `above`, `grasp`, `close`, `lift`, `carry`, `lower`, `open`, `retreat` or `home`.
        position: (3,) position of the tool [m].
        yaw: yaw of the tool [rad].
        opening: opening of the gripper, 0..1.
        seconds: duration of the segment; None = by the arm's speed.
        lean: lean of the tool about its own x [rad].
    """

    phase: str
    position: FloatArray
    yaw: float
    opening: float
    seconds: float | None = None
    lean: float = 0.0

    def moved(self, way: FloatArray) -> WayPoint:
        """Return it shifted by (3,) [m]."""
        return replace(self, position=self.position + way)

    def turned(self, *, yaw: float = 0.0, lean: float = 0.0) -> WayPoint:
        """Return it turned by angles [rad]."""
        return replace(self, yaw=self.yaw + yaw, lean=self.lean + lean)

    def opened(self, least: float) -> WayPoint:
        """Return it with the gripper open by at least a fraction of its range."""
        return replace(self, opening=max(self.opening, min(least, 1.0)))


Stops = list[WayPoint]


@dataclass(frozen=True, slots=True, kw_only=True)
class Visit:
    """A visit of a second arm in one move.

    Attributes:
        ways: way points of the visit up to the rest position, for a share of the way there.
        share: share of the way that the arm goes; less where the place is out of reach.
        meets: time at which `done` way points are done, from the begin of the move, before scaling
            [s].
        done: number of way points that are done at that time.
        waits: the first arm waits at its first way point if the second one takes longer.
        is_timed: whether that time is that of a way point of the first arm.
    """

    ways: Callable[[float], Stops]
    share: float = 1.0
    meets: float
    done: int = 0
    waits: bool = False
    is_timed: bool = True
