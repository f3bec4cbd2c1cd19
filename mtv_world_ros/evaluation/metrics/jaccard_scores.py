"""Jaccard indices of imagined against recorded frames, as rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import BoolArray, ByteArray, FloatArray, ObjectMasks
from mtv_world_ros.evaluation.imagined_stretches import Stretch
from mtv_world_ros.evaluation.metrics.object_scores import (
    displaced_objects,
    moving_objects,
    object_scores,
    ObjectScores,
)
from mtv_world_ros.vision.jaccard import held_masks
from mtv_world_ros.vision.segmenters.segmenter import masks_from_ids, Segmenter

#: definition of `moving`, for readers of the numbers
MOVING_RULE = (
    'an object moves in a stretch if in some recorded frame its mask and its first mask share '
    'less than half of the smaller of the two; {source} masks; frames that show less than a '
    'quarter of its largest area do not count, and what two views of a recording show at one '
    'place stays'
)

#: largest displacement of an object that stays, as masks in two views of a real camera show it [m]
STAYS_M = 0.02

#: statuses of a start mask that may belong to another object; later frames cannot correct it
START_DOUBTS = frozenset({'ambiguous', 'low_confidence'})

#: fields of a row that hold a value per frame
FRAME_FIELDS = ('j_frames', 'j_copy_frames', 'j_shuffled_frames')


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoreRow:
    """J of one object in one view over one stretch; NaN = not scored.

    Attributes:
        stretch: number of the stretch in the episode.
        num_frames: number of predicted frames, T.
        view: name of the view.
        name: name of the object; empty for the union of the scored objects.
        status: `ok`, or why it is not scored, or why to doubt it.
        moving: whether it really moves (see `MOVING_RULE`).
        j: mean over frames.
        j_visible: mean over the frames that really show it.
        j_copy: J of the first frame held.
        j_shuffled: J with the actions of another episode.
        j_zero: J with the joints held where they were.
        j_ceiling: J of recorded frames that went through the autoencoder.
        j_self: J of the recorded frames themselves, segmented in the same way.
        j_frames: (T,) J per frame.
        j_copy_frames: J per frame of the held first frame.
        j_shuffled_frames: J per frame with the actions of another episode; empty = not imagined.
        moving_imagined: whether it moves in the predicted frames, by the same rule, or a part of
            it is seen elsewhere (see `displaced_objects`).
        f: mean boundary F over frames.
        f_copy: F of the held first frame.
        f_self: F of the recorded frames themselves.
    """

    stretch: int
    num_frames: int
    view: str
    name: str
    status: str
    moving: bool
    j: float
    j_visible: float = np.nan
    j_copy: float = np.nan
    j_shuffled: float = np.nan
    j_zero: float = np.nan
    j_ceiling: float = np.nan
    j_self: float = np.nan
    j_frames: tuple[float, ...] = ()
    j_copy_frames: tuple[float, ...] = ()
    j_shuffled_frames: tuple[float, ...] = ()
    moving_imagined: bool = False
    f: float = np.nan
    f_copy: float = np.nan
    f_self: float = np.nan

    def as_json(self) -> dict[str, Any]:
        """Return plain values, None for NaN."""
        values = asdict(self)
        for field in FRAME_FIELDS:
            values[field] = [_known(value) for value in values[field]]
        return {
            key: _known(value) if isinstance(value, float) else value
            for key, value in values.items()
        }

    @staticmethod
    def from_json(values: dict[str, Any]) -> ScoreRow:
        """Return the inverse of `as_json`."""
        read: dict[str, Any] = {
            key: np.nan if value is None else value for key, value in values.items()
        }
        read.pop('j_mirrored', None)  # of version 0.1.0
        for field in FRAME_FIELDS:
            read[field] = tuple(np.nan if v is None else v for v in values[field])
        return ScoreRow(**read)


def _known(value: float) -> float | None:
    return round(float(value), 5) if np.isfinite(value) else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """Masks of a recorded stretch.

    Attributes:
        first: (V, O, H, W) masks of frame 0.
        first_frames: (V, H, W, 3) uint8 RGB, frame 0.
        masks: (V, O, T, H, W) masks of the frames 1..T.
        moving: (V, O) whether each object really moves.
    """

    first: ObjectMasks
    first_frames: ByteArray
    masks: ObjectMasks
    moving: np.ndarray

    @property
    def names(self) -> tuple[str, ...]:
        """O names."""
        return self.masks.names


def true_masks(
    stretch: Stretch,
    segmenter: Segmenter,
    names: tuple[str, ...],
    objects: tuple[str, ...],
    *,
    use_ids: bool,
) -> Truth:
    """Return the masks that predictions are scored against.

    Args:
        stretch: recorded frames.
        segmenter: finds the masks, as it will in the predicted frames.
        names: names of the O objects to score.
        objects: names that the recorded identities number, from 1.
        use_ids: score against the recorded identities instead, where there are any. Which
            objects move is read from them in any case.
    """
    start = stretch.frames[:, 0]
    first = segmenter.segment(start[:, None], names)
    masks = segmenter.segment(
        stretch.frames[:, 1:], names, first_masks=first.masks[:, :, 0], first_frames=start
    )
    masks = keep_doubts(first, masks)
    ids = stretch.object_ids
    if ids is None:
        moving = moving_objects(masks.masks, first.masks[:, :, 0])
        return Truth(first=first, first_frames=start, masks=masks, moving=moving)
    true_first = masks_from_ids(ids[:, :1], objects, names)
    true = masks_from_ids(ids[:, 1:], objects, names)
    moving = moving_objects(true.masks, true_first.masks[:, :, 0])
    if stretch.points is not None:
        moving &= ~_stay(stretch.points, objects, names)
    if use_ids:
        return Truth(first=true_first, first_frames=start, masks=true, moving=moving)
    return Truth(first=first, first_frames=start, masks=masks, moving=moving)


def _stay(points: FloatArray, objects: tuple[str, ...], names: tuple[str, ...]) -> BoolArray:
    """Return (O,) whether two views show that an object stays where it is.

    Masks that a segmenter found in recordings come and go where something stands before an object.
    """
    stays = np.zeros(len(names), np.bool_)
    for number, name in enumerate(names):
        if name in objects:
            way = points[:, objects.index(name)] - points[0, objects.index(name)]
            # NaN = not seen by two views, which says nothing
            stays[number] = bool((np.linalg.norm(way, axis=-1) < STAYS_M).all())
    return stays


def keep_doubts(first: ObjectMasks, masks: ObjectMasks) -> ObjectMasks:
    """Return `masks` with the doubts about their first masks added to the status.

    Args:
        first: masks of the start frame.
        masks: masks that were tracked from the first ones.
    """
    status = tuple(
        tuple(
            doubt if doubt in START_DOUBTS and word == 'ok' else word
            for doubt, word in zip(doubts, words, strict=True)
        )
        for doubts, words in zip(first.status, masks.status, strict=True)
    )
    return ObjectMasks(names=masks.names, masks=masks.masks, status=status)


def find_masks(frames: ByteArray, truth: Truth, segmenter: Segmenter) -> ObjectMasks:
    """Segment (V, T, H, W, 3) frames, starting from the recorded first frame and masks."""
    return segmenter.segment(
        frames,
        truth.names,
        first_masks=truth.first.masks[:, :, 0],
        first_frames=truth.first_frames,
    )


def score_frames(frames: ByteArray, truth: Truth, segmenter: Segmenter) -> ObjectScores:
    """Score (V, T, H, W, 3) frames; the segmenter starts from the recorded first masks."""
    return object_scores(find_masks(frames, truth, segmenter), truth.masks)


#: baselines that are scored like the prediction; each is column `j_<name>` of a row
OTHERS = ('shuffled', 'zero', 'ceiling', 'self')


def score_rows(
    stretch: Stretch,
    views: tuple[str, ...],
    truth: Truth,
    predicted: ObjectScores,
    others: Mapping[str, ObjectScores],
    masks: ObjectMasks | None = None,
) -> list[ScoreRow]:
    """Return a row per view and object, and one per view for the union of objects.

    Args:
        stretch: the imagined stretch.
        views: names of the V views.
        truth: masks of the recorded frames.
        predicted: scores of the prediction.
        others: scores of the baselines by name (a key of `OTHERS`); missing = not measured.
        masks: masks in the predicted frames; None = imagined motion is not known.
    """
    first = truth.first.masks[:, :, 0]
    imagined = np.zeros_like(truth.moving)
    if masks is not None:
        imagined = moving_objects(masks.masks, first) | displaced_objects(masks.masks, first)
    scores = {**others, 'copy': object_scores(held_masks(first, truth.masks), truth.masks)}
    rows = []
    for v, view in enumerate(views):
        for o, name in enumerate(truth.names):
            rows.append(
                ScoreRow(
                    stretch=stretch.index,
                    num_frames=stretch.num_frames,
                    view=view,
                    name=name,
                    status=predicted.status[v][o],
                    moving=bool(truth.moving[v, o]),
                    j=float(predicted.objects[v, o]),
                    j_visible=float(predicted.visible[v, o]),
                    j_frames=_frames(predicted, v, o),
                    j_copy_frames=_frames(scores['copy'], v, o),
                    j_shuffled_frames=_frames(scores.get('shuffled'), v, o),
                    moving_imagined=bool(imagined[v, o]),
                    f=float(predicted.boundary[v, o]),
                    f_copy=float(scores['copy'].boundary[v, o]),
                    f_self=float(scores['self'].boundary[v, o]) if 'self' in scores else np.nan,
                    **_values(scores, lambda found, v=v, o=o: found.objects[v, o]),
                )
            )
        rows.append(_union_row(stretch, view, predicted.union[v], scores, v))
    return rows


def _frames(scores: ObjectScores | None, view: int, item: int) -> tuple[float, ...]:
    return () if scores is None else tuple(scores.frames[view, item].tolist())


def _values(
    scores: Mapping[str, ObjectScores], value: Callable[[ObjectScores], float]
) -> dict[str, Any]:
    """Return the columns `j_<name>` of all baselines; NaN if a baseline was not scored."""
    return {
        f'j_{name}': float(value(scores[name])) if name in scores else np.nan
        for name in ('copy', *OTHERS)
    }


def _union_row(
    stretch: Stretch, view: str, j: float, scores: Mapping[str, ObjectScores], v: int
) -> ScoreRow:
    return ScoreRow(
        stretch=stretch.index,
        num_frames=stretch.num_frames,
        view=view,
        name='',
        status='ok' if np.isfinite(j) else 'no object is scored',
        moving=False,
        j=float(j),
        **_values(scores, lambda found: found.union[v]),
    )


#: means over rows of one episode: name -> (field of the row, which rows)
MEANS = {
    'j_object_mean': ('j', 'object'),
    'j_visible': ('j_visible', 'object'),
    'j_copy_mean': ('j_copy', 'object'),
    'j_ceiling': ('j_ceiling', 'object'),
    'j_self': ('j_self', 'object'),
    'j_union': ('j', 'union'),
    'j_copy_union': ('j_copy', 'union'),
    'j_moving': ('j', 'moving'),
    'j_moving_either': ('j', 'moving_either'),
    'j_copy_moving': ('j_copy', 'moving'),
    'j_shuffled_moving': ('j_shuffled', 'moving'),
    'j_zero_moving': ('j_zero', 'moving'),
    'j_ceiling_moving': ('j_ceiling', 'moving'),
    'j_self_moving': ('j_self', 'moving'),
    'f_moving': ('f', 'moving'),
    'f_copy_moving': ('f_copy', 'moving'),
    'f_self_moving': ('f_self', 'moving'),
    'f_object_mean': ('f', 'object'),
}
#: J&F of DAVIS: the mean of a J and an F
BOTH = {
    'jf_moving': ('j_moving', 'f_moving'),
    'jf_copy_moving': ('j_copy_moving', 'f_copy_moving'),
    'jf_self_moving': ('j_self_moving', 'f_self_moving'),
    'jf_object_mean': ('j_object_mean', 'f_object_mean'),
}
#: means over frames of one episode that are not of objects
QUALITY = ('psnr', 'ssim', 'lpips')
#: Fréchet distances of frames and of clips, over all episodes
DISTANCES = ('fid', 'fvd')
#: functions of the means: name -> (minuend, subtrahend); paired within each episode
MARGINS = {
    'margin_moving': ('j_moving', 'j_copy_moving'),
    'margin_over_shuffled': ('j_moving', 'j_shuffled_moving'),
    'margin_of_shuffled': ('j_shuffled_moving', 'j_copy_moving'),
}


def episode_means(rows: Sequence[ScoreRow], view: str | None) -> dict[str, float]:
    """Return `MEANS` and `MARGINS` of an episode in a view (None = all); frames weigh equally.

    Only rows with a J count, also in the baselines. Margins are over the rows that have all the
    baselines, so that they are paired, and all over the same rows: where a chunk could not be
    imagined with other commands, it has no margin over the held frame either.
    """
    kept = [row for row in rows if view in (None, row.view) and np.isfinite(row.j)]
    chosen = {
        'object': [row for row in kept if row.name],
        'union': [row for row in kept if not row.name],
        'moving': [row for row in kept if row.name and row.moving],
        'moving_either': [row for row in kept if row.name and (row.moving or row.moving_imagined)],
    }
    means = {name: _mean(chosen[which], field) for name, (field, which) in MEANS.items()}
    for name, (area, edge) in BOTH.items():
        means[name] = (means[area] + means[edge]) / 2
    compared = [row for row in chosen['moving'] if np.isfinite(row.j_shuffled)]
    paired = compared or chosen['moving']
    for name, keys in MARGINS.items():
        minuend, subtrahend = (_mean(paired, MEANS[key][0]) for key in keys)
        means[name] = minuend - subtrahend
    return means


def _mean(rows: Sequence[ScoreRow], field: str) -> float:
    values = np.array([getattr(row, field) for row in rows], np.float64)
    weights = np.array([row.num_frames for row in rows], np.float64)
    known = np.isfinite(values)
    return float(np.average(values[known], weights=weights[known])) if known.any() else np.nan
