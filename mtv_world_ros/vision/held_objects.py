"""Whether an object goes along with a gripper that closed, from masks and projected tools.

Fingers that close and stop say that something may be between them. What the masks show while the
hand then moves says whether it is: a mask that goes with the hand is *held*, one that stays is
*not held*. Both are evidence; a mask that is elsewhere, or is lost, is none: it may have been
pushed, or two objects may have swapped their masks. The rule is the same for masks of the
simulator, of a segmenter, and of imagined frames.

Shape letters: V views, N frames, O objects, A arms, H W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.core.data_types import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class HoldSettings:
    """Definition of held and not held in pictures.

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
        min_area: share of the object's area that has to be seen where the tool would have carried
            it, or where it was, outside of what both have in common.
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


SETTINGS = HoldSettings()
#: definition for stops of fingers: hands may move a little before they open again
STOP_SETTINGS = HoldSettings(travel=0.04, margin=0.012, min_area=0.2)


class Hold(Enum):
    """Evidence of masks whether a gripper holds an object."""

    HELD = 'held'
    NOT_HELD = 'not held'
    #: the hand moved away, and the object is seen neither with it nor where it was
    NOT_SEEN = 'not seen'
    #: the hand has not moved far enough, or there is no object
    NOT_TOLD = 'not told'


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """Fingers that closed, and the evidence whether they hold an object.

    Attributes:
        arm: index of the tool.
        closed: row at which the fingers have closed.
        opened: first row at which they open again; the number of rows if they do not.
        item: index of the object that they closed for; None = none is near.
        hold: whether it goes along.
    """

    arm: int
    closed: int
    opened: int
    item: int | None
    hold: Hold


def judge_stops(
    motion: Motion,
    masks: BoolArray,
    stops: Sequence[tuple[int, int, int]],
    settings: HoldSettings = STOP_SETTINGS,
) -> tuple[Stop, ...]:
    """Return stops of fingers with the evidence of masks.

    Args:
        motion: robot and cameras at N frames.
        masks: (V, O, N, H, W) masks of the objects in the frames.
        stops: arm, row at which its fingers have closed, and first row at which they open again.
        settings: definition of held.
    """
    found = []
    for arm, closed, opened in stops:
        tools = tools_in_views(motion, arm)
        item = nearest_object(masks, tools[:, closed], closed, settings)
        hold = Hold.NOT_TOLD
        if item is not None:
            hold = goes_along(masks[:, item], tools, closed, opened, settings)
        found.append(Stop(arm=arm, closed=closed, opened=opened, item=item, hold=hold))
    return tuple(found)


def attempts(openings: FloatArray, settings: HoldSettings = SETTINGS) -> list[tuple[int, int]]:
    """Return at which rows a gripper has closed, and the first row after it opens again.

    Args:
        openings: (N,) openings of one gripper, 0 closed to 1 open.
        settings: definition of an attempt.
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


def tools_in_views(motion: Motion, arm: int) -> FloatArray:
    """Return (V, N, 2) pixels of a tool centre point; NaN behind a camera."""
    points = motion.tool_points[arm]
    return np.stack(
        [
            project(camera, poses, points)[0]
            for camera, poses in zip(motion.cameras, motion.camera_poses, strict=True)
        ]
    )


def nearest_object(
    masks: BoolArray, tools: FloatArray, closed: int, settings: HoldSettings = SETTINGS
) -> int | None:
    """Return the object that a tool (V, 2) is at, by its last mask that shows it well.

    Args:
        masks: (V, O, N, H, W) masks of the objects.
        tools: (V, 2) pixels of the tool at that row.
        closed: row at which the fingers have closed.
        settings: definition of near.
    """
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


@dataclass(frozen=True, slots=True, kw_only=True)
class HoldEvidence:
    """Evidence of frames since fingers closed at an object, of one arm.

    Attributes:
        start: (V, H, W) masks of the object when they closed.
        closed_at: (V, 2) pixels of the tool then; NaN = behind a camera.
        num_far: (V,) frames in which the tool was away from there.
        num_along: (V,) of these, frames that show the object where the tool would carry it.
        num_left: (V,) of these, frames that show it where it was, and not at the hand.
    """

    start: BoolArray
    closed_at: FloatArray
    num_far: NDArray[np.int64]
    num_along: NDArray[np.int64]
    num_left: NDArray[np.int64]

    @classmethod
    def begin(cls, start: BoolArray, closed_at: FloatArray) -> HoldEvidence:
        """Return the evidence before the hand has moved."""
        none = np.zeros(len(start), np.int64)
        return cls(start=start, closed_at=closed_at, num_far=none, num_along=none, num_left=none)

    def after(
        self, masks: BoolArray, tools: FloatArray, settings: HoldSettings = SETTINGS
    ) -> HoldEvidence:
        """Return the evidence after one more frame.

        Args:
            masks: (V, H, W) masks of the object.
            tools: (V, 2) pixels of the tool.
            settings: definition of held.
        """
        width, ways = masks.shape[-1], tools - self.closed_at
        margin = round(settings.margin * width)
        far = np.linalg.norm(ways, axis=-1) >= settings.travel * width
        far &= self.start.any((-2, -1))
        along, left = np.zeros(len(masks), np.bool_), np.zeros(len(masks), np.bool_)
        for view in map(int, np.flatnonzero(far)):
            start, mask, way = self.start[view], masks[view], ways[view]
            stays, goes = grown(start, margin), grown(_shifted(start, way), margin)
            enough = settings.min_area * start.sum()
            along[view] = (mask & goes & ~stays).sum() >= enough
            # of a towel that fingers hold by its edge most stays, and the hand stays at it
            is_beside = mask.any() and _distance(mask, tools[view]) >= np.linalg.norm(way) / 2
            left[view] = is_beside and (mask & stays & ~goes).sum() >= enough
        return replace(
            self,
            num_far=self.num_far + far,
            num_along=self.num_along + along,
            num_left=self.num_left + left,
        )

    def hold(self, settings: HoldSettings = SETTINGS) -> Hold:
        """Return what the frames say together; one view that shows it along decides."""
        if (self.num_along >= settings.min_frames).any():
            return Hold.HELD
        if (self.num_left >= settings.min_frames).any():
            return Hold.NOT_HELD
        is_far = (self.num_far >= settings.min_frames).any()
        return Hold.NOT_SEEN if is_far else Hold.NOT_TOLD


def goes_along(
    masks: BoolArray,
    tools: FloatArray,
    closed: int,
    opened: int,
    settings: HoldSettings = SETTINGS,
) -> Hold:
    """Return whether an object goes along with a tool.

    Args:
        masks: (V, N, H, W) masks of the object.
        tools: (V, N, 2) pixels of the tool.
        closed: row at which the fingers have closed.
        opened: first row at which they open again.
        settings: definition of held.
    """
    start = np.stack([_last_shown(of_view[: closed + 1]) for of_view in masks])
    evidence = HoldEvidence.begin(start, tools[:, closed])
    for row in range(closed, opened):
        evidence = evidence.after(masks[:, row], tools[:, row], settings)
    return evidence.hold(settings)


def attempted_places(
    masks: BoolArray,
    openings: FloatArray,
    tools: FloatArray,
    settings: HoldSettings = SETTINGS,
) -> BoolArray:
    """Return (V, N, H, W) where an object was that a gripper closes at, and would be if it held.

    From where it closed the object goes along with the tool until the gripper opens, and stays
    there; and it stays where it was. Which of both it does changes nothing.

    Args:
        masks: (V, O, N, H, W) masks of the objects.
        openings: (N,) openings of the gripper, 0 closed to 1 open.
        tools: (V, N, 2) pixels of the tool.
        settings: definition of an attempt.
    """
    found = attempts(openings, settings)
    rows, margin = len(openings), round(settings.margin * masks.shape[-1])
    if 1 - openings[0] >= settings.closes_by:
        opens = np.flatnonzero(openings > openings[0] + settings.opens_by)
        found = [(0, int(opens[0]) if len(opens) else rows), *found]  # it closed before
    places = np.zeros((len(masks), *masks.shape[2:]), np.bool_)
    for closed, opened in found:
        nearest = nearest_object(masks, tools[:, closed], closed, settings)
        if nearest is None:
            continue
        for view in range(len(masks)):
            of_view = masks[view, nearest, : closed + 1]
            if not of_view.any() or not np.isfinite(tools[view]).all():
                continue
            start = _last_shown(of_view)
            for row in range(closed, rows):
                way = tools[view, min(row, opened - 1)] - tools[view, closed]
                places[view, row] |= start | grown(_shifted(start, way), margin)
    return places


def _last_shown(masks: BoolArray) -> BoolArray:
    """Return the last of masks (N, H, W) that shows half of the largest area or more."""
    areas = masks.sum((-2, -1))
    return masks[int(np.flatnonzero(2 * areas >= areas.max())[-1])]


def _distance(mask: BoolArray, pixel: FloatArray) -> float:
    rows, columns = np.nonzero(mask)
    return float(np.hypot(columns - pixel[0], rows - pixel[1]).min())


def _shifted(mask: BoolArray, way: FloatArray) -> BoolArray:
    """Return a mask (H, W) shifted by (2,) pixels."""
    shift = np.array([[1, 0, round(way[0])], [0, 1, round(way[1])]], np.float32)
    return cv2.warpAffine(mask.astype(np.uint8), shift, mask.shape[::-1]) > 0


def grown(mask: BoolArray, pixels: int) -> BoolArray:
    """Return a mask (H, W) that reaches further by some pixels."""
    size = 2 * pixels + 1
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return cv2.dilate(mask.astype(np.uint8), shape) > 0
