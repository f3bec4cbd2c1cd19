"""Scores of objects against recorded masks: J and boundary F as in DAVIS 2017, and motion."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, hypot

import cv2
import numpy as np

from mtv_world_ros.core.data_types import BoolArray, FloatArray, ObjectMasks
from mtv_world_ros.vision.jaccard import (
    jaccard,
    mean_of_known,
    object_jaccard,
    score_statuses,
    scored_objects,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectScores:
    """J of one video against another; NaN is 'not scored', with the reason in `status`.

    Attributes:
        names: names of the O objects.
        frames: (V, O, T) J per frame.
        visible: (V, O) mean J over the frames in which the true mask is not empty.
        objects: (V, O) mean J over frames, both-empty frames counted as 1 (DAVIS).
        boundary: (V, O) mean F over frames.
        union: (V,) mean J of the union of the scored objects (the paper's formula).
        status: V tuples of O words: `ok`, or the reason for a missing or doubtful score.
    """

    names: tuple[str, ...]
    frames: FloatArray
    visible: FloatArray
    objects: FloatArray
    boundary: FloatArray
    union: FloatArray
    status: tuple[tuple[str, ...], ...]


def object_scores(pred: ObjectMasks, true: ObjectMasks) -> ObjectScores:
    """Score predicted against true masks; see `object_jaccard` for what is not scored.

    Args:
        pred: masks in the predicted frames 1..T.
        true: masks in the recorded frames at the same times.

    Raises:
        MtvWorldError: names, numbers of views or frames, or sizes differ.
    """
    frames = object_jaccard(pred, true)
    status = score_statuses(pred, true)
    scored = scored_objects(status)
    edges = np.full(frames.shape, np.nan)
    edges[scored] = boundary_f(pred.masks[scored], true.masks[scored])
    return ObjectScores(
        names=true.names,
        frames=frames,
        visible=mean_of_known(np.where(true.masks.any((-2, -1)), frames, np.nan), axis=2),
        objects=mean_of_known(frames, axis=2),
        boundary=mean_of_known(edges, axis=2),
        union=_union(pred.masks, true.masks, scored),
        status=status,
    )


def _union(pred: BoolArray, true: BoolArray, scored: BoolArray) -> FloatArray:
    """(V,) mean over frames of J of the union of the scored objects, NaN where none is scored."""
    keep = scored[:, :, None, None, None]
    frames = jaccard(np.any(pred & keep, axis=1), np.any(true & keep, axis=1))
    if frames.shape[1] == 0:
        return np.full(len(frames), np.nan)
    return np.where(scored.any(1), frames.mean(1), np.nan)


#: maximum distance of matching boundaries [fraction of the image diagonal]
BOUNDARY_SHARE = 0.008


def boundary_f(pred: BoolArray, true: BoolArray) -> FloatArray:
    """Return F of the boundaries of masks: the harmonic mean of their precision and recall.

    A pixel of one boundary counts where the other boundary is at most `BOUNDARY_SHARE` of the
    image's diagonal away. Both empty gives 1, one empty 0 (DAVIS 2017, `db_eval_boundary`).

    Args:
        pred: (..., H, W) bool predicted masks.
        true: masks of the real frames, of the same shape.
    """
    height, width = true.shape[-2:]
    reach = ceil(BOUNDARY_SHARE * hypot(height, width))
    offsets = np.arange(-reach, reach + 1)
    disk = (offsets[:, None] ** 2 + offsets**2 <= reach**2).astype(np.uint8)
    pairs = zip(pred.reshape(-1, height, width), true.reshape(-1, height, width), strict=True)
    values = [_boundary_f(one, other, disk) for one, other in pairs]
    return np.array(values, np.float64).reshape(true.shape[:-2])


def _boundary_f(pred: BoolArray, true: BoolArray, disk: np.ndarray) -> float:
    edges = [_boundary(mask) for mask in (pred, true)]
    counts = [int(edge.sum()) for edge in edges]
    if not all(counts):
        return float(counts == [0, 0])
    near = [cv2.dilate(edge.astype(np.uint8), disk).astype(bool) for edge in edges]
    precision, recall = ((edges[k] & near[1 - k]).sum() / counts[k] for k in (0, 1))
    return float(2 * precision * recall / (precision + recall)) if precision + recall else 0.0


def _boundary(mask: BoolArray) -> BoolArray:
    """Return pixels that differ from the one to the right, below, or both (DAVIS, `seg2bmap`)."""
    right, below, corner = mask.copy(), mask.copy(), mask.copy()
    right[:, :-1], below[:-1], corner[:-1, :-1] = mask[:, 1:], mask[1:], mask[1:, 1:]
    found = (mask ^ right) | (mask ^ below) | (mask ^ corner)
    found[-1], found[:, -1] = mask[-1] ^ right[-1], mask[:, -1] ^ below[:, -1]
    found[-1, -1] = False
    return found


#: an object that is seen twice has moved if this share of its first area is seen elsewhere
COPY_AREA = 1 / 3
#: distance from the first mask that is elsewhere [fraction of image width]
COPY_DISTANCE = 0.03
#: definition of what else moves in imagination, for readers of the numbers
COPY_RULE = (
    f'in imagination it also moves if {COPY_AREA:.0%} of its first area is seen more than '
    f'{COPY_DISTANCE:.0%} of the image width away from its first mask in two frames; an object '
    'that the first frame does not show has no place to move from, and counts as one that stays'
)


def displaced_objects(masks: BoolArray, first: BoolArray) -> BoolArray:
    """Return (V, O) True for objects that appear away from their first mask in two frames or more.

    A copy that appears elsewhere while the object itself stays counts, too; `moving_objects` does
    not see it. An object that frame 0 does not show may enter later, or a hand may uncover it; it
    counts as one that stays, here and in `moving_objects`.

    Args:
        masks: (V, O, T, H, W) masks in the frames.
        first: (V, O, H, W) masks in frame 0.
    """
    size = 2 * round(COPY_DISTANCE * first.shape[-1]) + 1
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    found = np.zeros(first.shape[:2], np.bool_)
    for place in np.ndindex(found.shape):
        near = cv2.dilate(first[place].astype(np.uint8), shape) > 0
        away = (masks[place] & ~near).sum((-2, -1))
        area = first[place].sum()
        found[place] = area > 0 and (away >= COPY_AREA * area).sum() >= 2
    return found


def moving_objects(true: BoolArray, first: BoolArray) -> BoolArray:
    """Return (V, O) True for objects that move in the recording.

    It moves if in some frame its mask and its first mask share less than half of the smaller of
    the two. Hiding it, wholly or in part, leaves that share at 1. Frames that show
    less than a quarter of its largest area do not count.

    Args:
        true: (V, O, T, H, W) masks in the recorded frames.
        first: (V, O, H, W) masks in the recorded frame 0.
    """
    area = true.sum((-2, -1))
    first_area = first.sum((-2, -1))[:, :, None]
    shared = (true & first[:, :, None]).sum((-2, -1))
    largest = np.maximum(area.max(2, initial=0, keepdims=True), first_area)
    smaller = np.minimum(area, first_area)
    shown = (smaller > 0) & (4 * smaller >= largest)
    return (shown & (2 * shared < smaller)).any(2)
