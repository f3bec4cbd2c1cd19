"""Follows an object through the pixels of its colours: a mask per frame, and its status."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, hypot
from types import MappingProxyType
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.core.data_types import BoolArray, FloatArray

Labels = NDArray[np.integer]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingConfig:
    """Settings of joining and tracking pieces of a colour.

    Attributes:
        min_area_share: smallest area of a piece, as a share of the image's.
        max_area_share: a larger piece is background of that colour.
        rival_share: a second piece of this share of the largest makes the first frame
            ambiguous.
        join_gap: pieces this near to the main one belong to it, as a share of its diameter (a
            finger in front of a block splits it).
        max_step: largest motion between frames, as a share of the image's diagonal.
        max_growth: largest area, relative to that of the frame before; areas below a few
            `min_area_share` count as that, for an object may come out from behind a gripper.
        max_missing: share of frames without the object above which it is absent or, where it was
            seen before, lost.
        max_slivers: share of the frames with the object that may show no more than a sliver of
            it, one pixel thin; such a mask is as much edge as object.
    """

    min_area_share: float = 0.0006
    max_area_share: float = 0.15
    rival_share: float = 0.4
    join_gap: float = 0.5
    max_step: float = 0.2
    max_growth: float = 2.5
    max_missing: float = 0.5
    max_slivers: float = 0.2

    def min_area(self, shape: tuple[int, ...]) -> int:
        """Return the smallest area of a piece [px] in frames of (..., H, W)."""
        return max(2, ceil(self.min_area_share * shape[-2] * shape[-1]))


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectTrack:
    """One object in one view.

    Attributes:
        masks: (T, H, W) bool masks of the object.
        status: a word of `ObjectMasks.status`.
    """

    masks: BoolArray
    status: str

    @staticmethod
    def missing(shape: tuple[int, int, int], status: str) -> ObjectTrack:
        """Return empty masks with a reason."""
        return ObjectTrack(masks=np.zeros(shape, np.bool_), status=status)


@dataclass(slots=True)
class _State:
    """Last position, size and edge contact of a tracked object.

    `shown` counts the frames with the object, `slivers` those with no more than a sliver of it.
    """

    centre: FloatArray | None = None
    area: float = 0.0
    gap: int = 0
    at_edge: bool = False
    status: str = 'ok'
    shown: int = 0
    slivers: int = 0

    def doubt(self, status: str) -> None:
        """Keep the first reason for doubt."""
        if self.status == 'ok':
            self.status = status


def track(
    pixels: BoolArray,
    first: BoolArray | None,
    config: TrackingConfig,
    taken: BoolArray | None = None,
    out: BoolArray | None = None,
) -> ObjectTrack:
    """Follow one object through the pixels of its colour.

    Args:
        pixels: (T, H, W) pixels of the object's colour.
        first: (H, W) mask of the object just before frame 0, if known.
        config: thresholds for joining and tracking pieces of a colour.
        taken: (T, H, W) pixels that another object of the same colour holds.
        out: (T, H, W) array of False that takes the masks; None = a new array.
    """
    if taken is not None:
        pixels = pixels & ~taken
    masks = np.zeros(pixels.shape, np.bool_) if out is None else out
    state = _State()
    if first is not None:
        _remember(_patch(first), state)
    for frame, mask in zip(pixels, masks, strict=True):
        if not _find(_patch(frame), state, config, mask):
            state.gap += 1
    _doubt_whole(len(masks), state, config)
    return ObjectTrack(masks=masks, status=state.status)


def judge_tracks(masks: BoolArray, first: BoolArray, config: TrackingConfig) -> str:
    """Return the status of masks that another method tracked.

    Args:
        masks: (T, H, W) tracked masks.
        first: (H, W) the mask they were tracked from, not empty.
        config: when to doubt.
    """
    state = _State()
    _remember(_patch(first), state)
    for mask in masks:
        patch = _patch(mask)
        if patch.pixels.size:
            _check(patch, state, config)
        else:
            state.gap += 1
    _doubt_whole(len(masks), state, config)
    return state.status


class _Patch(NamedTuple):
    """The part of a frame or mask outside which nothing is set.

    Attributes:
        pixels: (h, w) bool; a view.
        top: first row of the patch in the frame.
        left: first column of the patch in the frame.
        shape: (H, W) shape of the frame.
    """

    pixels: BoolArray
    top: int
    left: int
    shape: tuple[int, int]

    def inside(self, mask: BoolArray) -> BoolArray:
        """Return the view of an (H, W) mask that the patch covers."""
        height, width = self.pixels.shape
        return mask[self.top : self.top + height, self.left : self.left + width]


def _patch(frame: BoolArray) -> _Patch:
    """Return the patch that covers the pixels set in a frame (H, W).

    Begins at even pixels, empty if nothing is.

    Connected components are found in blocks of 2 by 2: those of the patch are numbered as those
    of the frame.
    """
    left, top, width, height = cv2.boundingRect(frame.view(np.uint8))
    right, bottom = left + width, top + height
    left, top = left - left % 2, top - top % 2
    return _Patch(frame[top:bottom, left:right], top, left, frame.shape)


def _doubt_whole(num_frames: int, state: _State, config: TrackingConfig) -> None:
    """Set the status of an object that is absent, out of view, lost or barely visible."""
    if state.shown >= (1 - config.max_missing) * num_frames and state.shown:
        if state.slivers > config.max_slivers * state.shown:
            state.doubt('barely_visible')
    elif state.centre is None:
        state.doubt('absent')
    elif state.at_edge:
        state.doubt('out_of_view')
    else:
        state.doubt('lost')


def _find(patch: _Patch, state: _State, config: TrackingConfig, mask: BoolArray) -> bool:
    """Find the object in the pixels of one frame and update the state.

    Args:
        patch: pixels of the object's colour.
        state: state of the track.
        config: thresholds for joining and tracking pieces of a colour.
        mask: (H, W) array of False in which the object is set.

    Returns:
        Whether it was found.
    """
    if not patch.pixels.size:
        return False
    components = cv2.connectedComponentsWithStats(patch.pixels.view(np.uint8), connectivity=8)
    labels: Any = components[1]
    stats = np.asarray(components[2], np.int64)
    areas = stats[:, cv2.CC_STAT_AREA].astype(np.float64)
    areas[0] = 0
    largest = config.max_area_share * mask.size
    pieces = np.flatnonzero((areas >= config.min_area(mask.shape)) & (areas <= largest))
    if not len(pieces):
        if areas.max() > largest:
            state.doubt('ambiguous')
        return False
    if state.centre is None or len(pieces) == 1:
        main = int(pieces[np.argmax(areas[pieces])])
    else:
        # sums of whole pixels, which are exact, so that the frame's edge does not matter
        sums = np.rint(np.asarray(components[3]) * stats[:, 4:]) + stats[:, 4:] * patch[2:0:-1]
        centres = sums[pieces] / stats[pieces, 4:]
        main = _nearest(pieces, areas, centres, state.centre, config.max_step * hypot(*mask.shape))
    joined = _join(main, pieces, stats, config)
    rest = [areas[piece] for piece in pieces if piece not in joined]
    if state.centre is None and rest and max(rest) >= config.rival_share * areas[main]:
        state.doubt('ambiguous')
    is_joined = np.zeros(len(areas), np.bool_)
    is_joined[joined] = True
    found = is_joined[labels]
    patch.inside(mask)[...] = found
    _check(patch._replace(pixels=found), state, config)
    return True


def _nearest(
    pieces: Labels, areas: FloatArray, centres: FloatArray, centre: FloatArray, reach: float
) -> int:
    """Label of the piece nearest to the last position; small pieces must be clearly nearer."""
    steps = np.hypot(*(centres - centre).T)
    size = np.sqrt(areas[pieces] / areas[pieces].max())
    return int(pieces[np.argmin(steps / reach - size)])


def _join(main: int, pieces: Labels, stats: Labels, config: TrackingConfig) -> list[int]:
    """Return the labels of the main piece and of the pieces whose boxes lie next to it."""
    left, top, width, height = stats[:, :4].T
    reach = config.join_gap * max(width[main], height[main])
    across = np.maximum(left - left[main] - width[main], left[main] - left - width)
    down = np.maximum(top - top[main] - height[main], top[main] - top - height)
    near = np.maximum(across, down) <= reach
    return [int(piece) for piece in pieces if piece == main or near[piece]]


def _has_body(mask: BoolArray) -> bool:
    """Return True if the mask contains a block of two by two pixels."""
    pairs = mask[1:] & mask[:-1]
    return bool((pairs[:, 1:] & pairs[:, :-1]).any())


def _check(patch: _Patch, state: _State, config: TrackingConfig) -> None:
    """Doubt jumps in place or area, then remember the mask, which is not empty."""
    centre, area = state.centre, state.area
    gap = state.gap
    _remember(patch, state)
    if centre is not None and state.centre is not None:
        step = hypot(*(state.centre - centre))
        if step > config.max_step * hypot(*patch.shape) * (1 + gap):
            state.doubt('teleport')
    if area and state.area > config.max_growth * max(area, 5 * config.min_area(patch.shape)):
        state.doubt('area_jump')
    state.shown += 1
    state.slivers += not _has_body(patch.pixels)


def _remember(patch: _Patch, state: _State) -> None:
    by_row, by_column = np.count_nonzero(patch.pixels, 1), np.count_nonzero(patch.pixels, 0)
    area = by_row.sum()
    x = (by_column @ np.arange(patch.left, patch.left + len(by_column))) / area
    y = (by_row @ np.arange(patch.top, patch.top + len(by_row))) / area
    state.centre, state.area, state.gap = np.array([x, y]), float(area), 0
    ends = np.array([patch.top + len(by_row), patch.left + len(by_column)]) == patch.shape
    starts = patch.top == 0, patch.left == 0
    border = (
        starts[0] and by_row[0],
        ends[0] and by_row[-1],
        starts[1] and by_column[0],
        ends[1] and by_column[-1],
    )
    state.at_edge = any(map(bool, border))


#: noun -> colour of a part that differs from the main colour of the object
PARTS: MappingProxyType[str, str] = MappingProxyType(
    {'carrot': 'green', 'corn': 'green', 'eggplant': 'green'}
)
#: maximum distance of a part from the main piece [fraction of the image's diagonal]
_MAX_PART_GAP = 0.008
#: maximum area of a piece of the same object [largest main pieces]
_MAX_AREA_RATIO = 3.0


def part_of(name: str, colour: str | None) -> str | None:
    """Return the colour word of the part that an object of that name has, or None."""
    word = PARTS.get(name.lower().split()[-1]) if name.split() else None
    return None if word == colour else word


def with_part(
    found: ObjectTrack,
    pixels: BoolArray,
    others: Sequence[BoolArray],
    first: BoolArray | None,
    config: TrackingConfig,
) -> ObjectTrack:
    """Add the pieces of the part's colour that touch the main piece.

    Args:
        found: the object by its main colour.
        pixels: (T, H, W) pixels of the part's colour.
        others: (T, H, W) masks of the other objects.
        first: (H, W) mask of the object just before frame 0, if known.
        config: when to doubt the sum.
    """
    free = pixels & ~np.any(others, axis=0) if others else pixels
    masks = np.array(found.masks)
    largest = masks.sum((1, 2)).max(initial=0)
    reach = ceil(_MAX_PART_GAP * hypot(*masks.shape[1:]))
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    for mask, frame in zip(masks, free, strict=True):
        if not mask.any() or not frame.any():
            continue
        labels = np.asarray(cv2.connectedComponents(frame.view(np.uint8), connectivity=8)[1])
        near = cv2.dilate(mask.view(np.uint8), kernel) > 0
        areas = np.bincount(labels.ravel())
        pieces = [
            n for n in np.unique(labels[near]) if n and areas[n] <= _MAX_AREA_RATIO * largest
        ]
        mask |= np.isin(labels, pieces)
    status = found.status
    if status == 'ok':
        start = next((m for m in (first, *masks) if m is not None and m.any()), None)
        status = 'ok' if start is None else judge_tracks(masks, start, config)
    return ObjectTrack(masks=masks, status=status)
