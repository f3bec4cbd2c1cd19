"""Real, drawn and imagined frames of a rollout with their masks, kept small in one file.

One `.npz` (no pickle): three H.264 videos with the views below each other, masks as packed bits, J
per frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from io import BytesIO
import math
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.core.bounded_input import read_arrays
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.files import write_whole
from mtv_world_ros.core.images import resize_frames, resize_labels
from mtv_world_ros.viewing.scored_rollout import MASKS, StoredRollout
from mtv_world_ros.viewing.video import decode_video, encode_video, KINDS

#: frames are shrunk until neither side is longer [px]; with `MAX_FRAMES` it bounds a file's size
MAX_SIDE = 320
#: maximum number of kept frames of an episode
MAX_FRAMES = 600
#: constant rate factor of x264; at 96x72 the mean error is 0.4 of 255
_CRF = 10


def join_stretches(stretches: Sequence[StoredRollout]) -> StoredRollout:
    """Return the stretches of an episode in a row.

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
    axes = {'stretches': 0, 'times': 0, **dict.fromkeys(KINDS, 1), 'j': 2}
    axes |= dict.fromkeys(MASKS, 2)
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(stretch, name) for stretch in stretches], axis=axis)
        for name, axis in axes.items()
    }
    return StoredRollout(views=first.views, objects=first.objects, fps=first.fps, **joined)


def save_rollout(path: Path, rollout: StoredRollout) -> None:
    """Write a rollout atomically, within the limits `MAX_SIDE` and `MAX_FRAMES`."""
    write_whole(path, rollout_bytes(rollout))


def rollout_bytes(rollout: StoredRollout) -> bytes:
    """Return the file of a rollout that `load_rollout` reads."""
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
    for name in KINDS:
        stacked = np.concatenate(list(getattr(kept, name)), axis=1)
        data = encode_video(stacked, kept.fps, crf=_CRF, full_colour=True)
        held[name] = np.frombuffer(data, np.uint8)
    for name in MASKS:
        held[name] = np.packbits(getattr(kept, name))
    archive = BytesIO()
    np.savez_compressed(archive, **held)
    return archive.getvalue()


def load_rollout(path: Path) -> StoredRollout:
    """Read a rollout back.

    Raises:
        EpisodeError: the file is missing or cannot be read.
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
    for name in KINDS:
        stacked = decode_video(held[name].tobytes())
        frames = stacked.reshape(num_frames, num_views, height, width, 3)
        read[name] = frames.swapaxes(0, 1)
    num_bits = math.prod(masks)
    for name in MASKS:
        if min(masks) < 0 or held[name].size != math.ceil(num_bits / 8):
            raise ValueError(f"'{name}' has {held[name].size} bytes for masks of shape {masks}")
        bits = np.unpackbits(held[name], count=num_bits)
        read[name] = bits.reshape(masks).astype(bool)
    views = tuple(map(str, held['views']))
    return StoredRollout(views=views, objects=objects, fps=float(held['fps']), **read)


def _bounded(rollout: StoredRollout) -> StoredRollout:
    """Return the first frames, shrunk where they are large."""
    kept: dict[str, Any] = {field.name: getattr(rollout, field.name) for field in fields(rollout)}
    height, width = rollout.real.shape[2:4]
    factor = min(1.0, MAX_SIDE / max(height, width))
    size = max(round(width * factor), 1), max(round(height * factor), 1)
    for name in KINDS:
        kept[name] = np.stack([resize_frames(v[:MAX_FRAMES], *size) for v in kept[name]])
    for name in MASKS:
        masks = kept[name][:, :, :MAX_FRAMES]
        flat = masks.reshape(-1, height, width).astype(np.uint8)
        small = resize_labels(flat, *size) if len(flat) else np.zeros((0, *size[::-1]), np.uint8)
        kept[name] = small.reshape(*masks.shape[:3], *size[::-1]).astype(bool)
    for name in ('stretches', 'times'):
        kept[name] = kept[name][:MAX_FRAMES]
    kept['j'] = kept['j'][:, :, :MAX_FRAMES]
    return StoredRollout(**kept)
