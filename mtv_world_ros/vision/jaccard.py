"""Jaccard index J of masks as in DAVIS 2017, per view, object and frame.

Frame 0 is the condition, not a prediction: pass frames 1..T. DAVIS leaves out the last frame,
too; here it counts, since an episode's outcome shows in it.
"""

from __future__ import annotations

import warnings

import numpy as np

from mtv_world_ros.core.data_types import BoolArray, FloatArray, ObjectMasks
from mtv_world_ros.core.errors import MtvWorldError

#: a prediction of this status cannot be scored; any other (`absent`, ...) is the model's doing
UNSCORABLE = frozenset({'ambiguous', 'out_of_palette'})


def jaccard(pred: BoolArray, true: BoolArray) -> FloatArray:
    """Return |pred and true| / |pred or true| over the last two axes.

    Both empty gives 1, one empty 0 (DAVIS 2017, `db_eval_iou`).

    Args:
        pred: (..., H, W) bool predicted masks.
        true: (..., H, W) bool, of the same height and width.

    Raises:
        MtvWorldError: the masks differ in height or width.
    """
    if pred.shape[-2:] != true.shape[-2:]:
        raise MtvWorldError(
            f'masks of {pred.shape[-1]}x{pred.shape[-2]} and {true.shape[-1]}x{true.shape[-2]} px '
            'cannot be compared: bring both to one size before scoring'
        )
    intersection = (pred & true).sum((-2, -1), dtype=np.float64)
    union = (pred | true).sum((-2, -1), dtype=np.float64)
    return np.where(union == 0, 1.0, intersection / np.maximum(union, 1))


def object_jaccard(pred: ObjectMasks, true: ObjectMasks) -> FloatArray:
    """Return (V, O, T) J of predicted against true masks; NaN = not scored.

    An object is not scored where its true masks are not to be trusted or where the predicted
    video leaves the segmenter in doubt which pixels are the object. An object that the
    prediction lost is scored, as DAVIS does.

    Args:
        pred: masks in the predicted frames 1..T.
        true: masks in the recorded frames at the same times.

    Raises:
        MtvWorldError: names, numbers of views or frames, or sizes differ.
    """
    if pred.names != true.names or pred.masks.shape[:3] != true.masks.shape[:3]:
        raise MtvWorldError(
            f'masks of {pred.names} {pred.masks.shape[:3]} cannot be scored against '
            f'{true.names} {true.masks.shape[:3]}: names, views and frames must be the same'
        )
    scored = scored_objects(score_statuses(pred, true))
    return np.where(scored[:, :, None], jaccard(pred.masks, true.masks), np.nan)


def score_statuses(pred: ObjectMasks, true: ObjectMasks) -> tuple[tuple[str, ...], ...]:
    """Return the status of each view's and object's score: the truth's doubt goes first."""
    return tuple(
        tuple(map(_score_status, *rows)) for rows in zip(pred.status, true.status, strict=True)
    )


def _score_status(pred: str, true: str) -> str:
    if true != 'ok':
        return f'true: {true}'
    return pred if pred == 'ok' else f'predicted: {pred}'


def scored_objects(status: tuple[tuple[str, ...], ...]) -> BoolArray:
    """Return (V, O) whether objects are scored, by the statuses of their scores."""
    scored = [[_is_scored(word) for word in row] for row in status]
    return np.array(scored, np.bool_).reshape(len(status), -1 if status else 0)


def _is_scored(status: str) -> bool:
    where, _, word = status.partition(': ')
    return where == 'ok' or (where == 'predicted' and word not in UNSCORABLE)


def held_masks(first: BoolArray, true: ObjectMasks) -> ObjectMasks:
    """Return the masks of the baseline that holds the first frame.

    Args:
        first: (V, O, H, W) masks in the recorded frame 0.
        true: masks in the recorded frames 1..T.
    """
    held = np.broadcast_to(first[:, :, None], true.masks.shape)
    status = (('ok',) * len(true.names),) * len(true.status)
    return ObjectMasks(names=true.names, masks=held, status=status)


def mean_of_known(values: FloatArray, axis: int | tuple[int, ...] | None = None) -> FloatArray:
    """Return the mean of the values that are not NaN; NaN if there are none."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', RuntimeWarning)
        return np.asarray(np.nanmean(values, axis=axis))
