"""Way points that an arm goes by."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mtv_world_ros.data_types import FloatArray


@dataclass(frozen=True, slots=True)
class WayPoint:
    """Where one arm's tool is at the end of a segment.

    Attributes:
        phase: `above`, `grasp`, `close`, `lift`, `carry`, `lower`, `open`, `retreat` or `home`.
        position: (3,) of the tool [m].
        yaw: of the tool [rad].
        opening: of the gripper, 0..1.
        seconds: that the segment takes; None = as the arm's speed has it.
        lean: of the tool about its own x [rad].
    """

    phase: str
    position: FloatArray
    yaw: float
    opening: float
    seconds: float | None = None
    lean: float = 0.0

    def moved(self, way: FloatArray) -> WayPoint:
        """Returns it shifted by (3,) [m]."""
        return replace(self, position=self.position + way)


Stops = list[WayPoint]


@dataclass(frozen=True, slots=True)
class Pull:
    """What another arm closes on, pulls towards where it rests itself, and lets go.

    Attributes:
        position: (3,) where it closes [m].
        rise: from how high above it comes, and how far it rises again [m].
        before: number of this arm's way points that are done by then.
        size: how far it pulls [m].
    """

    position: FloatArray
    rise: float
    before: int
    size: float
