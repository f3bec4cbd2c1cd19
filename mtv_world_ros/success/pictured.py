"""Relations whose goal is a picture of every view, not a place relative to another object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mtv_world_ros.success.goal_pictures import Picture
from mtv_world_ros.success.situation import Goal, Margin, Situation

#: a J, or a share of an area, that counts as one in the margins
_SOFT_SHARE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class AsPictured:
    """The subject lies as in pictures of the task done; its mask in them is the goal mask.

    Attributes:
        kind: `as_pictured`.
        subject: placeholder of the object that moves.
        pictures: view -> picture of the task done, by the calibrated camera; one view will do.
        min_jaccard: J of the subject's mask with that in the pictures, mean over the views.
    """

    kind: str
    subject: str
    pictures: Mapping[str, Picture]
    min_jaccard: float = 0.5

    def goal(self, at: Situation) -> Goal | None:
        """Nothing: the place is known in the pictures alone."""
        del at
        return None

    def margins(self, at: Situation) -> list[Margin]:
        """Returns by how much the condition holds."""
        reached = at.pictured_jaccard(self.subject, self.pictures) - self.min_jaccard
        return [Margin('as in the goal picture', reached, 'J', _SOFT_SHARE)]


@dataclass(frozen=True, slots=True, kw_only=True)
class InRegion:
    """The subject is seen within a region of the views that was painted.

    Attributes:
        kind: `in_region`.
        subject: placeholder of the object that moves.
        regions: view -> picture, white where the subject belongs, black elsewhere.
        min_share: of the subject's mask that is in the region, in every one of these views.
    """

    kind: str
    subject: str
    regions: Mapping[str, Picture]
    min_share: float = 0.8

    def goal(self, at: Situation) -> Goal | None:
        """Nothing: it may be anywhere in the region."""
        del at
        return None

    def margins(self, at: Situation) -> list[Margin]:
        """Returns by how much the condition holds."""
        inside = at.share_inside(self.subject, self.regions) - self.min_share
        return [Margin('in the painted region', inside, 'of its area', _SOFT_SHARE)]
