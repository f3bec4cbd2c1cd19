"""Protocol of segmenters, and their shared functions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import cv2
import numpy as np

from mtv_world_ros.core.data_types import BoolArray, ByteArray, ObjectMasks
from mtv_world_ros.core.errors import ObservationError


class Segmenter(Protocol):
    """Finds named objects in videos.

    A class that is chosen by name has a class method `create(options)`, which takes
    `weights.SegmenterOptions`, or is called without arguments.
    """

    @property
    def name(self) -> str:
        """Name of the segmenter, for reports."""
        ...

    def segment(
        self,
        frames: ByteArray,
        names: tuple[str, ...],
        first_masks: BoolArray | None = None,
        first_frames: ByteArray | None = None,
    ) -> ObjectMasks:
        """Return the objects' masks in every frame, with a status per view and object.

        Args:
            frames: (V, T, H, W, 3) uint8 RGB.
            names: names of the O objects.
            first_masks: (V, O, H, W) masks just before the first frame, where known.
            first_frames: (V, H, W, 3) uint8 RGB, the frames that `first_masks` belong to.

        Raises:
            ObservationError: sizes or numbers do not fit each other.
        """
        ...


def check_request(
    frames: ByteArray,
    names: tuple[str, ...],
    first_masks: BoolArray | None,
    first_frames: ByteArray | None,
) -> None:
    """Check the arguments of `Segmenter.segment`.

    Raises:
        ObservationError: sizes or numbers do not fit each other.
    """
    if frames.ndim != 5 or frames.shape[-1] != 3 or frames.dtype != np.uint8:
        raise ObservationError(
            f'frames to segment are {frames.shape} {frames.dtype}; they must be '
            '(views, frames, height, width, 3) uint8 RGB'
        )
    num_views, _, height, width, _ = frames.shape
    wanted = (num_views, len(names), height, width)
    if first_masks is not None and first_masks.shape != wanted:
        raise ObservationError(
            f'the start masks are {first_masks.shape} (views, objects, height, width), the frames '
            f'and names want {wanted}; bring both to one size with `resize_masks`'
        )
    wanted = (num_views, height, width, 3)
    if first_frames is not None and first_frames.shape != wanted:
        raise ObservationError(
            f'the frames of the start masks are {first_frames.shape}; they must be {wanted} like '
            'the frames to segment'
        )


def masks_from_ids(ids: ByteArray, objects: Sequence[str], names: Sequence[str]) -> ObjectMasks:
    """Return the true masks of a simulator's identity images.

    Args:
        ids: (V, T, H, W) uint8; 0 = no object, i + 1 = `objects[i]`.
        objects: the names that the identities stand for.
        names: O names to return, in this order; one that is not among `objects` is `absent`.
    """
    wanted = [objects.index(name) + 1 if name in objects else 255 for name in names]
    masks = np.stack([ids == index for index in wanted], axis=1)
    seen = np.asarray(masks.any((-3, -2, -1)))
    status = tuple(tuple('ok' if known else 'absent' for known in row) for row in seen)
    return ObjectMasks(names=tuple(names), masks=masks, status=status)


def resize_masks(masks: BoolArray, width: int, height: int) -> BoolArray:
    """Return (..., height, width) masks; a pixel is set where at least half of it is covered."""
    if masks.shape[-2:] == (height, width):
        return masks
    shrinks = height <= masks.shape[-2] and width <= masks.shape[-1]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    flat = masks.reshape(-1, *masks.shape[-2:]).astype(np.float32)
    small = [cv2.resize(mask, (width, height), interpolation=method) >= 0.5 for mask in flat]
    return np.array(small, np.bool_).reshape(*masks.shape[:-2], height, width)
