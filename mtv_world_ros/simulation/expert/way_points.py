"""Way points of an arm, and the random draws for one move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mtv_world_ros.core.data_types import FloatArray


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


Stops = list[WayPoint]


@dataclass(frozen=True, slots=True, kw_only=True)
class Draws:
    """Random draws for a faulty move: side, direction and errors of way points.

    Attributes:
        yaw: yaw of the grasp [rad]; the fingers travel along it.
        sign: +1 or -1.
        angle: angle of a direction in the plane [rad].
        errors: (N, 3) errors of way points, standard normal.
        openings: (N,) errors of the gripper openings, standard normal.
        play: draws anew for every plan that is tried.
        objects: (3,) centre of every object of the scene [m].
        other_home: (3,) rest position of another arm's tool [m].
    """

    yaw: float
    sign: float
    angle: float
    errors: FloatArray
    openings: FloatArray
    play: np.random.Generator
    objects: Sequence[FloatArray]
    other_home: FloatArray | None = None
