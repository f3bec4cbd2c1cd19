"""Outcomes of grasps: whether an object goes along with the gripper, in truth and imagined.

A gripper that closes beside an object and moves on is a missed grasp. A world model dreams it as a
grasp if the imagined object goes along all the same, also if a second one grows in the gripper
while the first stays. The rule is that of `vision.held_objects`.

Shape letters: V views, T frames, O objects, A arms, H W pixels.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import nan

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.core.data_types import BoolArray
from mtv_world_ros.evaluation.metrics.statistics import Interval, wilson
from mtv_world_ros.vision.held_objects import (
    attempts,
    goes_along,
    Hold,
    HoldSettings,
    nearest_object,
    SETTINGS,
    tools_in_views,
)

#: definition of a grasp, for readers of the numbers
GRASP_RULE = (
    f'a gripper that closes within {SETTINGS.reach:.0%} of the image width of an object attempts '
    f'a grasp; the object is grasped if in {SETTINGS.min_frames} frames of a view, the tool '
    f'{SETTINGS.travel:.0%} of the width away from where it closed, a third of its area is seen '
    f'where the tool would have carried it (to {SETTINGS.margin:.0%} of the width)'
)


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspOutcome:
    """Real and imagined outcome of one attempt to grasp an object.

    Attributes:
        stretch: number of the stretch in the episode.
        frame: frame of the stretch at which the fingers have closed.
        arm: index of the tool.
        name: name of the object.
        real: whether the recorded object goes along with the gripper.
        imagined: whether the imagined object goes along with the gripper.
    """

    stretch: int
    frame: int
    arm: int
    name: str
    real: bool
    imagined: bool


def grasp_outcomes(
    motion: Motion,
    names: Sequence[str],
    real: BoolArray,
    imagined: BoolArray,
    *,
    stretch: int = 0,
    settings: HoldSettings = SETTINGS,
) -> tuple[GraspOutcome, ...]:
    """Return the outcomes of all attempts in a stretch whose tool then travels far enough.

    An object that imagination never shows is not grasped there.

    Args:
        motion: robot and cameras at the 1 + T frames of the stretch.
        names: names of the O objects.
        real: (V, O, 1 + T, H, W) masks in the recorded frames.
        imagined: (V, O, 1 + T, H, W) masks in the imagined frames; frame 0 is the recorded one.
        stretch: number of the stretch in the episode.
        settings: definition of a grasp.
    """
    found = []
    for arm, openings in enumerate(motion.openings):
        tools = tools_in_views(motion, arm)
        for closed, opened in attempts(openings, settings):
            nearest = nearest_object(real, tools[:, closed], closed, settings)
            if nearest is None:
                continue
            went = [
                goes_along(masks[:, nearest], tools, closed, opened, settings)
                for masks in (real, imagined)
            ]
            if went[0] is Hold.NOT_TOLD:
                continue  # what imagination never shows does not go along there
            found.append(
                GraspOutcome(
                    stretch=stretch,
                    frame=closed,
                    arm=arm,
                    name=names[nearest],
                    real=went[0] is Hold.HELD,
                    imagined=went[1] is Hold.HELD,
                )
            )
    return tuple(found)


@dataclass(frozen=True, slots=True, kw_only=True)
class Share:
    """A share of counted cases, NaN if there is none, and its 95 % Wilson interval."""

    hits: int
    count: int

    @property
    def value(self) -> float:
        """The share."""
        return self.hits / self.count if self.count else nan

    @property
    def interval(self) -> Interval:
        """95 % Wilson interval."""
        return wilson(self.hits, self.count)

    @property
    def text(self) -> str:
        """Counts, share and interval as text."""
        if not self.count:
            return 'none'
        low, high = self.interval
        return f'{self.hits} of {self.count} ({self.value:.2f} [{low:.2f}, {high:.2f}])'


@dataclass(frozen=True, slots=True, kw_only=True)
class Dreams:
    """Disagreement between imagination and recording on grasps and moving objects.

    Attributes:
        dreamt: missed grasps that are imagined as grasps.
        missed: grasps that are imagined as missed.
        precision: objects that move in truth, of those that move in imagination.
        recall: objects that move in imagination, of those that move in truth.
    """

    dreamt: Share
    missed: Share
    precision: Share
    recall: Share

    @classmethod
    def of(cls, grasps: Iterable[GraspOutcome], motions: Iterable[tuple[bool, bool]]) -> Dreams:
        """Count the shares from all attempts to grasp and all objects.

        Args:
            grasps: all attempts.
            motions: whether each object moves in truth, and in imagination.
        """
        attempted, motions = list(grasps), list(motions)
        misses = [grasp for grasp in attempted if not grasp.real]
        held = [grasp for grasp in attempted if grasp.real]
        both = sum(real and imagined for real, imagined in motions)
        return cls(
            dreamt=Share(hits=sum(g.imagined for g in misses), count=len(misses)),
            missed=Share(hits=sum(not g.imagined for g in held), count=len(held)),
            precision=Share(hits=both, count=sum(imagined for _, imagined in motions)),
            recall=Share(hits=both, count=sum(real for real, _ in motions)),
        )

    @property
    def line(self) -> str:
        """All shares that have cases on one line; empty if nothing was grasped at."""
        if not self.dreamt.count + self.missed.count:
            return ''
        shares = {
            'missed grasps dreamt': self.dreamt,
            'grasps missed': self.missed,
            'of what moves in imagination, moves in truth': self.precision,
            'of what moves in truth, moves in imagination': self.recall,
        }
        return '; '.join(f'{words}: {s.text}' for words, s in shares.items() if s.count)
