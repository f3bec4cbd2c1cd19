"""Outcomes of grasps: whether an object goes along with the gripper, in truth and imagined.

A gripper that closes beside an object and moves on is a missed grasp. A world model dreams it as a
grasp if the imagined object goes along all the same, also if a second one grows in the gripper
while the first stays. All is read from masks and projected tools, so that it is the same with the
simulator's masks and with those of a segmenter.

Shape letters: V views, T frames, O objects, A arms, H W pixels.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import nan

import cv2
import numpy as np

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.evaluation.metrics.statistics import Interval, wilson


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspSettings:
    """Definition of a grasp in pictures.

    Attributes:
        closes_by: decrease of a gripper's opening since it last opened that is an attempt
            [fraction of its range].
        rest_change: largest change of the opening from frame to frame at which closing has ended
            [fraction of its range].
        opens_by: increase of the opening at which a gripper lets go [fraction of its range].
        reach: largest distance of the tool from the object that it closes for, in every view that
            shows the object [fraction of image width].
        travel: distance from where it closed at which the tool has carried an object away
            [fraction of image width].
        margin: tolerance of an object's place [fraction of image width].
        min_area: share of the object's area that has to be seen along with the tool.
        min_frames: frames in which it has to be seen there, in one view.
    """

    closes_by: float = 0.12
    rest_change: float = 0.03
    opens_by: float = 0.06
    reach: float = 0.08
    travel: float = 0.1
    margin: float = 0.03
    min_area: float = 1 / 3
    min_frames: int = 2


SETTINGS = GraspSettings()
#: definition of a grasp, for readers of the numbers
GRASP_RULE = (
    f'a gripper that closes within {SETTINGS.reach:.0%} of the image width of an object attempts '
    f'a grasp; the object is grasped if in {SETTINGS.min_frames} frames of a view, the tool '
    f'{SETTINGS.travel:.0%} of the width away from where it closed, a third of its area is seen '
    f'where the tool would have carried it (to {SETTINGS.margin:.0%} of the width)'
)


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspOutcome:
    """Outcome of one attempt of a gripper to grasp an object.

    Attributes:
        stretch: number of the stretch in the episode.
        frame: frame of the stretch at which the fingers have closed.
        arm: index of the tool.
        name: name of the object.
        real: whether the recorded object goes along with the gripper.
        imagined: whether the imagined one does.
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
    settings: GraspSettings = SETTINGS,
) -> tuple[GraspOutcome, ...]:
    """Return the outcomes of all attempts in a stretch whose tool then travels far enough.

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
        tools = _tools_in_views(motion, arm)
        for closed, opened in attempts(openings, settings):
            nearest = _nearest_object(real, tools[:, closed], closed, settings)
            if nearest is None:
                continue
            went = [
                _goes_along(masks[:, nearest], tools, closed, opened, settings)
                for masks in (real, imagined)
            ]
            if None in went:
                continue
            found.append(
                GraspOutcome(
                    stretch=stretch,
                    frame=closed,
                    arm=arm,
                    name=names[nearest],
                    real=bool(went[0]),
                    imagined=bool(went[1]),
                )
            )
    return tuple(found)


def attempts(openings: FloatArray, settings: GraspSettings = SETTINGS) -> list[tuple[int, int]]:
    """Return at which rows a gripper has closed, and the first row after it opens again.

    Args:
        openings: (N,) openings of one gripper, 0 closed to 1 open.
        settings: definition of a grasp.
    """
    found: list[tuple[int, int]] = []
    widest, closed, narrowest = float(openings[0]), None, float(openings[0])
    for row in range(1, len(openings)):
        now, change = float(openings[row]), float(openings[row] - openings[row - 1])
        narrowest = min(narrowest, now)
        if now > narrowest + settings.opens_by:  # it opens: what was held is let go
            if closed is not None:
                found.append((closed, row))
            closed, widest, narrowest = None, now, now
        elif closed is None:
            widest = max(widest, now)
            has_closed = widest - now >= settings.closes_by
            if has_closed and change > -settings.rest_change:
                closed = row
    if closed is not None:
        found.append((closed, len(openings)))
    return found


def _tools_in_views(motion: Motion, arm: int) -> FloatArray:
    """Return (V, N, 2) pixels of a tool centre point; NaN behind a camera."""
    points = motion.tool_points[arm]
    return np.stack(
        [
            project(camera, poses, points)[0]
            for camera, poses in zip(motion.cameras, motion.camera_poses, strict=True)
        ]
    )


def _nearest_object(
    masks: BoolArray, tools: FloatArray, closed: int, settings: GraspSettings
) -> int | None:
    """Return the object that a tool (V, 2) is at, by its last mask that shows it well."""
    best: tuple[float, int] | None = None
    chosen = None
    reach = settings.reach * masks.shape[-1]
    for index in range(masks.shape[1]):
        distances, area = [], 0
        for view, tool in enumerate(tools):
            mask = _last_shown(masks[view, index, : closed + 1])
            if mask.any() and np.isfinite(tool).all():
                distances.append(_distance(mask, tool))
                area += int(mask.sum())
        if not distances or max(distances) > reach:
            continue
        # of two that the tool is over, the smaller one: a cup on its plate
        rank = (float(np.mean(distances)), area)
        if best is None or rank < best:
            best, chosen = rank, index
    return chosen


def _last_shown(masks: BoolArray) -> BoolArray:
    """Return the last of masks (N, H, W) that shows half of the largest area or more."""
    areas = masks.sum((-2, -1))
    return masks[int(np.flatnonzero(2 * areas >= areas.max())[-1])]


def _distance(mask: BoolArray, pixel: FloatArray) -> float:
    rows, columns = np.nonzero(mask)
    return float(np.hypot(columns - pixel[0], rows - pixel[1]).min())


def _goes_along(
    masks: BoolArray,
    tools: FloatArray,
    closed: int,
    opened: int,
    settings: GraspSettings,
) -> bool | None:
    """Return whether an object (V, N, H, W) goes along with a tool; None if that is not shown."""
    width = masks.shape[-1]
    is_shown = False
    for view, way in enumerate(tools - tools[:, closed : closed + 1]):
        start = _last_shown(masks[view, : closed + 1])
        if not start.any():
            continue
        lengths = np.linalg.norm(way[closed:opened], axis=-1)
        rows = closed + np.flatnonzero(lengths >= settings.travel * width)
        is_shown |= len(rows) >= settings.min_frames
        stays = _grown(start, round(settings.margin * width))
        seen = [
            _area_along(masks[view, row], start, stays, way[row], settings.margin * width)
            for row in rows
        ]
        if sum(share >= settings.min_area for share in seen) >= settings.min_frames:
            return True
    return False if is_shown else None


def _area_along(
    mask: BoolArray, start: BoolArray, stays: BoolArray, way: FloatArray, margin: float
) -> float:
    """Return the area of a mask where a tool carried it, in areas of the start mask."""
    shift = np.array([[1, 0, round(way[0])], [0, 1, round(way[1])]], np.float32)
    carried = cv2.warpAffine(start.astype(np.uint8), shift, start.shape[::-1]) > 0
    there = _grown(carried, round(margin)) & ~stays
    return float((mask & there).sum() / start.sum())


def _grown(mask: BoolArray, pixels: int) -> BoolArray:
    size = 2 * pixels + 1
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return cv2.dilate(mask.astype(np.uint8), shape) > 0


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
        """Counts, share and interval, for people."""
        if not self.count:
            return 'none'
        low, high = self.interval
        return f'{self.hits} of {self.count} ({self.value:.2f} [{low:.2f}, {high:.2f}])'


@dataclass(frozen=True, slots=True, kw_only=True)
class Dreams:
    """Where imagined objects and real ones part.

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
        """Return the shares.

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
        """Both shares of grasps on one line; empty if nothing was grasped at."""
        if not self.dreamt.count + self.missed.count:
            return ''
        return f'missed grasps dreamt: {self.dreamt.text}; grasps missed: {self.missed.text}'
