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
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np

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


SETTINGS = HoldSettings()


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
    settings: HoldSettings = SETTINGS,
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
    width, hold = masks.shape[-1], Hold.NOT_TOLD
    for view, way in enumerate(tools - tools[:, closed : closed + 1]):
        start = _last_shown(masks[view, : closed + 1])
        if not start.any():
            continue
        lengths = np.linalg.norm(way[closed:opened], axis=-1)
        rows = closed + np.flatnonzero(lengths >= settings.travel * width)
        if len(rows) < settings.min_frames:
            continue
        stays = _grown(start, round(settings.margin * width))
        along = [
            _area_along(masks[view, row], start, stays, way[row], settings.margin * width)
            for row in rows
        ]
        if _enough(along, settings):
            return Hold.HELD
        left = [(masks[view, row] & stays).sum() / start.sum() for row in rows]
        if _enough(left, settings):
            hold = Hold.NOT_HELD
        elif hold is Hold.NOT_TOLD:
            hold = Hold.NOT_SEEN
    return hold


def _enough(shares: Sequence[float], settings: HoldSettings) -> bool:
    return sum(share >= settings.min_area for share in shares) >= settings.min_frames


def _last_shown(masks: BoolArray) -> BoolArray:
    """Return the last of masks (N, H, W) that shows half of the largest area or more."""
    areas = masks.sum((-2, -1))
    return masks[int(np.flatnonzero(2 * areas >= areas.max())[-1])]


def _distance(mask: BoolArray, pixel: FloatArray) -> float:
    rows, columns = np.nonzero(mask)
    return float(np.hypot(columns - pixel[0], rows - pixel[1]).min())


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
