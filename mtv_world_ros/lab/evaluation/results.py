"""What was seen and imagined in a scored episode, kept small on disk for later reports.

`save_rollout(rollout_path(out, episode), join(stretches))` while an episode is scored;
`load_rollout(path)` without the model. One `.npz` per episode (no pickle): three H.264 videos with
the views below each other, masks as packed bits, J per frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from io import BytesIO
import math
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.bounded_input import read_arrays
from mtv_world_ros.data_types import BoolArray, ByteArray, FloatArray, ObjectMasks
from mtv_world_ros.errors import EpisodeError
from mtv_world_ros.files import write_whole
from mtv_world_ros.lab.evaluation.imagined_stretches import Stretch
from mtv_world_ros.lab.evaluation.metrics.scores import episode_means, QUALITY, ScoreRow
from mtv_world_ros.prediction import Prediction
from mtv_world_ros.rendering.images import resize_frames, resize_labels
from mtv_world_ros.rendering.video import compare, decode_video, encode_video


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeResult:
    """Scores of one episode.

    Attributes:
        episode: name of its folder.
        task: its name.
        zero_shot: what the model was not trained for in it: `view`, `task`, `object`; or empty.
        outcome: `success`, `failure` or `unknown`.
        rows: scores.
        quality: PSNR and the like by view, as far as measured.
        probability: the success estimate at the end of its last stretch; NaN = abstained.
        reasons: of that estimate.
        notes: what was wrong with the recording, and what could not be imagined.
        seconds_per_chunk: mean time to imagine a chunk [s].
        seconds: what the time of the episode went into [s].
        features: of that estimate, by name; empty where it abstained.
        observed: of the estimate at the end of the recorded frames, likewise; empty where they
            were not judged.
        resumed: likewise, where all but the last chunk was seen.
        has_ids: which objects move was read from recorded identities.
    """

    episode: str
    task: str
    zero_shot: str
    outcome: str
    rows: tuple[ScoreRow, ...]
    quality: Mapping[str, Mapping[str, float]]
    probability: float
    reasons: tuple[str, ...]
    notes: tuple[str, ...]
    seconds_per_chunk: float
    seconds: Mapping[str, float]
    has_ids: bool
    features: Mapping[str, float] = field(default_factory=dict)
    observed: Mapping[str, float] = field(default_factory=dict)
    resumed: Mapping[str, float] = field(default_factory=dict)

    def means(self, view: str | None) -> dict[str, float]:
        """Returns the numbers of a view (None = all views) that are averaged over episodes."""
        views = [numbers for name, numbers in self.quality.items() if view in (None, name)]
        known = [name for name in QUALITY if views and all(name in numbers for numbers in views)]
        quality = {n: float(np.mean([numbers[n] for numbers in views])) for n in known}
        return {**episode_means(self.rows, view), **quality}

    def as_json(self) -> dict[str, Any]:
        """Returns plain values."""
        return {**asdict(self), 'rows': [row.as_json() for row in self.rows]}

    @staticmethod
    def from_json(values: dict[str, Any]) -> EpisodeResult:
        """The inverse of `as_json`, read back from a file."""
        read: dict[str, Any] = dict(values)
        read['rows'] = tuple(ScoreRow.from_json(row) for row in values['rows'])
        read['reasons'], read['notes'] = tuple(values['reasons']), tuple(values['notes'])
        read['probability'] = np.nan if values['probability'] is None else values['probability']
        for name in ('features', 'observed', 'resumed'):
            given = values.get(name, {})
            read[name] = {k: np.nan if v is None else v for k, v in given.items()}
        return EpisodeResult(**read)


#: frames are shrunk until neither side is longer [px]; with `MAX_FRAMES` it bounds a file's size
MAX_SIDE = 320
#: frames of an episode that are kept
MAX_FRAMES = 600
#: of x264; at 96x72 the mean error is 0.4 of 255
_CRF = 10
_VIDEOS = ('real', 'trajectory', 'imagined')
_MASKS = ('true_masks', 'masks')


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredRollout:
    """Predicted frames beside the recorded ones: V views, T frames, O objects.

    Attributes:
        views: V names.
        objects: O names.
        fps: frames a second.
        stretches: (T,) int, number of the stretch that each frame belongs to; where it changes,
            the imagination started anew from a recorded frame.
        times: (T,) [s] since the episode's first frame.
        real: (V, T, H, W, 3) uint8 RGB recorded frames.
        trajectory: (V, T, H, W, 3) uint8 RGB trajectory video.
        imagined: (V, T, H, W, 3) uint8 RGB predicted frames.
        true_masks: (V, O, T, H, W) bool masks of the recorded frames.
        masks: (V, O, T, H, W) bool masks of the predicted frames.
        j: (V, O, T) J per frame, NaN = not scored.
    """

    views: tuple[str, ...]
    objects: tuple[str, ...]
    fps: float
    stretches: np.ndarray
    times: FloatArray
    real: ByteArray
    trajectory: ByteArray
    imagined: ByteArray
    true_masks: BoolArray
    masks: BoolArray
    j: FloatArray

    def __post_init__(self) -> None:
        num_views, num_objects, num_frames = len(self.views), len(self.objects), len(self.times)
        size = self.real.shape[2:4]
        wanted = {
            **dict.fromkeys(_VIDEOS, (num_views, num_frames, *size, 3)),
            **dict.fromkeys(_MASKS, (num_views, num_objects, num_frames, *size)),
            'j': (num_views, num_objects, num_frames),
            'stretches': (num_frames,),
        }
        for name, shape in wanted.items():
            found = getattr(self, name).shape
            if found != shape:
                raise EpisodeError(f'rollout: {name} has shape {found}, expected {shape}')


def stored_stretch(
    chunks: Sequence[Prediction],
    stretch: Stretch,
    *,
    start_seconds: float,
    fps: float,
    true_masks: ObjectMasks,
    masks: ObjectMasks,
    j: FloatArray,
) -> StoredRollout:
    """Returns what is kept of one stretch.

    Args:
        chunks: imagined from the stretch's first frame.
        stretch: the recorded frames.
        start_seconds: of the stretch since the episode's first frame [s].
        fps: of the model.
        true_masks: of the recorded frames 1..T.
        masks: of the predicted frames.
        j: (V, O, T) J per frame.
    """
    shown = compare(chunks, stretch.frames[:, 1:])
    return StoredRollout(
        views=shown.views,
        objects=masks.names,
        fps=fps,
        stretches=np.full(len(shown.times), stretch.index),
        times=shown.times + start_seconds,
        real=shown.real,
        trajectory=shown.trajectory,
        imagined=shown.imagined,
        true_masks=true_masks.masks,
        masks=masks.masks,
        j=j,
    )


def rollout_path(out: Path, episode: str) -> Path:
    """Returns where the rollout of an episode lies in an evaluation's folder."""
    return Path(out) / 'episodes' / f'{episode}.rollout.npz'


def join(stretches: Sequence[StoredRollout]) -> StoredRollout:
    """Returns the stretches of an episode in a row.

    Raises:
        EpisodeError: there is none, or they differ in views, objects or size.
    """
    if not stretches:
        raise EpisodeError('a rollout needs at least one stretch')
    first = stretches[0]
    for other in stretches:
        same = (first.views, first.objects, first.fps, first.real.shape[2:])
        if (other.views, other.objects, other.fps, other.real.shape[2:]) != same:
            raise EpisodeError('the stretches of a rollout differ in views, objects, rate or size')
    axes = {'stretches': 0, 'times': 0, **dict.fromkeys(_VIDEOS, 1), 'j': 2}
    axes |= dict.fromkeys(_MASKS, 2)
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(stretch, name) for stretch in stretches], axis=axis)
        for name, axis in axes.items()
    }
    return StoredRollout(views=first.views, objects=first.objects, fps=first.fps, **joined)


def save_rollout(path: Path, rollout: StoredRollout) -> None:
    """Writes a rollout beside its name and renames it; see `MAX_SIDE` and `MAX_FRAMES`."""
    write_whole(path, rollout_bytes(rollout))


def rollout_bytes(rollout: StoredRollout) -> bytes:
    """Returns the file of a rollout that `load_rollout` reads."""
    kept = _bounded(rollout)
    shape = kept.real.shape[:4]
    held: dict[str, Any] = {
        'views': np.array(kept.views),
        'objects': np.array(kept.objects, dtype=np.str_),
        'fps': np.float64(kept.fps),
        'shape': np.array(shape),
        'stretches': kept.stretches.astype(np.int32),
        'times': kept.times.astype(np.float64),
        'j': kept.j.astype(np.float32),
    }
    for name in _VIDEOS:
        stacked = np.concatenate(list(getattr(kept, name)), axis=1)
        data = encode_video(stacked, kept.fps, crf=_CRF, full_colour=True)
        held[name] = np.frombuffer(data, np.uint8)
    for name in _MASKS:
        held[name] = np.packbits(getattr(kept, name))
    archive = BytesIO()
    np.savez_compressed(archive, **held)
    return archive.getvalue()


def load_rollout(path: Path) -> StoredRollout:
    """Reads a rollout back.

    Raises:
        EpisodeError: it is not there or cannot be read.
    """
    try:
        return _unpacked(read_arrays(path))
    except (OSError, ValueError, LookupError, TypeError, ArithmeticError, EpisodeError) as error:
        raise EpisodeError(
            f"rollout '{path}' cannot be read ({error}); evaluate the episode again"
        ) from error


def _unpacked(held: dict[str, Any]) -> StoredRollout:
    num_views, num_frames, height, width = (int(n) for n in held['shape'])
    objects = tuple(map(str, held['objects']))
    masks = (num_views, len(objects), num_frames, height, width)
    read: dict[str, Any] = {name: held[name] for name in ('stretches', 'times')}
    read['j'] = held['j'].astype(np.float64)
    for name in _VIDEOS:
        stacked = decode_video(held[name].tobytes())
        frames = stacked.reshape(num_frames, num_views, height, width, 3)
        read[name] = frames.swapaxes(0, 1)
    num_bits = math.prod(masks)
    for name in _MASKS:
        if min(masks) < 0 or held[name].size != math.ceil(num_bits / 8):
            raise ValueError(f"'{name}' has {held[name].size} bytes for masks of shape {masks}")
        bits = np.unpackbits(held[name], count=num_bits)
        read[name] = bits.reshape(masks).astype(bool)
    views = tuple(map(str, held['views']))
    return StoredRollout(views=views, objects=objects, fps=float(held['fps']), **read)


def _bounded(rollout: StoredRollout) -> StoredRollout:
    """The first frames, shrunk where they are large."""
    kept: dict[str, Any] = {field.name: getattr(rollout, field.name) for field in fields(rollout)}
    height, width = rollout.real.shape[2:4]
    factor = min(1.0, MAX_SIDE / max(height, width))
    size = max(round(width * factor), 1), max(round(height * factor), 1)
    for name in _VIDEOS:
        kept[name] = np.stack([resize_frames(v[:MAX_FRAMES], *size) for v in kept[name]])
    for name in _MASKS:
        masks = kept[name][:, :, :MAX_FRAMES]
        flat = masks.reshape(-1, height, width).astype(np.uint8)
        small = resize_labels(flat, *size) if len(flat) else np.zeros((0, *size[::-1]), np.uint8)
        kept[name] = small.reshape(*masks.shape[:3], *size[::-1]).astype(bool)
    for name in ('stretches', 'times'):
        kept[name] = kept[name][:MAX_FRAMES]
    kept['j'] = kept['j'][:, :, :MAX_FRAMES]
    return StoredRollout(**kept)
