"""What a relation asks of a rollout: where its objects are; and what it answers: margins."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol, TYPE_CHECKING

from mtv_world_ros.data_types import FloatArray

if TYPE_CHECKING:
    from mtv_world_ros.success.goal_pictures import Picture

#: a placeholder, and where the centre (3,) of its object should be [m]
Goal = tuple[str, FloatArray]


class CannotTell(Exception):
    """Why there is no evidence; caught by the estimator, never a user's error."""


class Margin(NamedTuple):
    """By how much a condition holds.

    Attributes:
        condition: in words.
        value: negative = violated.
        unit: of the value: `m`, or what is counted or measured.
        soft: value that counts as one; None = the task's softness [m].
    """

    condition: str
    value: float
    unit: str = 'm'
    soft: float | None = None


class Situation(Protocol):
    """Where the objects are, by their placeholders; raises CannotTell where it is not known."""

    def end(self, role: str) -> FloatArray:
        """Returns the centre (3,) at the end [m]."""
        ...

    def start(self, role: str) -> FloatArray:
        """Returns the centre (3,) at the start of the rollout [m]."""
        ...

    def stack_height(self, upper: str, lower: str) -> float:
        """Returns the height of one centre over the other when stacked [m]."""
        ...

    def lift(self, role: str) -> float:
        """Returns how far the object was raised over its start at most [m]."""
        ...

    def swings(self, role: str, swing: float) -> int:
        """Returns how often the object turned back by more than `swing` [rad]."""
        ...

    def pictured_jaccard(self, role: str, pictures: Mapping[str, Picture]) -> float:
        """Returns J of the object's mask at the end with its mask in pictures, by view; a mean."""
        ...

    def share_inside(self, role: str, regions: Mapping[str, Picture]) -> float:
        """Returns the share of the object's mask at the end in regions, by view; the least."""
        ...
