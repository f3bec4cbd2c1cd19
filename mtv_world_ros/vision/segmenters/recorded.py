"""The simulator's own masks as a segmenter of recorded frames."""

from __future__ import annotations

import hashlib

import numpy as np

from mtv_world_ros.data_types import BoolArray, ByteArray, ObjectMasks
from mtv_world_ros.errors import EpisodeError
from mtv_world_ros.vision.segmenters.segmenter import check_request

#: no object has this identity
_NOWHERE = 255


class RecordedSegmenter:
    """Knows the masks of the frames of one recording; a `Segmenter`.

    It recognises a frame by its content, so it gives no masks of predicted frames: those are
    `not_recorded`.
    """

    name = 'simulator'

    def __init__(self, frames: ByteArray, ids: ByteArray | None, objects: tuple[str, ...]) -> None:
        """Remembers every recorded frame.

        Args:
            frames: (V, N, H, W, 3) uint8 RGB.
            ids: (V, N, H, W) uint8; 0 = no object, i + 1 = `objects[i]`.
            objects: the names that the identities stand for.

        Raises:
            EpisodeError: no identities were recorded.
        """
        if ids is None:
            raise EpisodeError(
                'the recording has no identities of objects; only simulated episodes have them, '
                'choose another segmenter for this one'
            )
        self._objects = objects
        self._ids = {
            _key(view, frame): ids[view, index]
            for view in range(len(frames))
            for index, frame in enumerate(frames[view])
        }

    def segment(
        self,
        frames: ByteArray,
        names: tuple[str, ...],
        first_masks: BoolArray | None = None,
        first_frames: ByteArray | None = None,
    ) -> ObjectMasks:
        """See `Segmenter.segment`; start masks are not needed."""
        check_request(frames, names, first_masks, first_frames)
        wanted = [self._objects.index(n) + 1 if n in self._objects else _NOWHERE for n in names]
        num_views, num_frames, height, width, _ = frames.shape
        masks = np.zeros((num_views, len(names), num_frames, height, width), np.bool_)
        status = []
        for view in range(num_views):
            found = [self._ids.get(_key(view, frame)) for frame in frames[view]]
            for index, ids in enumerate(found):
                if ids is not None:
                    masks[view, :, index] = [ids == number for number in wanted]
            unknown = any(ids is None for ids in found)
            seen = masks[view].any((1, 2, 3))
            status.append(
                tuple('not_recorded' if unknown else 'ok' if s else 'absent' for s in seen)
            )
        return ObjectMasks(names=names, masks=masks, status=tuple(status))


def _key(view: int, frame: ByteArray) -> tuple[int, tuple[int, ...], bytes]:
    digest = hashlib.blake2b(np.ascontiguousarray(frame).tobytes(), digest_size=16).digest()
    return view, frame.shape, digest
