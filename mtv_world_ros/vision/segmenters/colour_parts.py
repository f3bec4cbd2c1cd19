"""Small parts of another colour that belong to an object: the green of a carrot."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, hypot
from types import MappingProxyType

import cv2
import numpy as np

from mtv_world_ros.data_types import BoolArray
from mtv_world_ros.vision.segmenters.tracking import judge, Track, TrackingConfig

#: noun -> colour word of a part that such things have beside their main colour
PARTS: MappingProxyType[str, str] = MappingProxyType(
    {'carrot': 'green', 'corn': 'green', 'eggplant': 'green'}
)
#: a part lies this near to the main piece, as a share of the image's diagonal
_GAP = 0.008
#: a larger piece, relative to the largest main piece, is another thing
_MAX_SHARE = 3.0


def part_of(name: str, colour: str | None) -> str | None:
    """Returns the colour word of the part that an object of that name has, or None."""
    word = PARTS.get(name.lower().split()[-1]) if name.split() else None
    return None if word == colour else word


def with_part(
    found: Track,
    pixels: BoolArray,
    others: Sequence[BoolArray],
    first: BoolArray | None,
    config: TrackingConfig,
) -> Track:
    """Adds the pieces of the part's colour that touch the main piece.

    Args:
        found: the object by its main colour.
        pixels: (T, H, W) pixels of the part's colour.
        others: (T, H, W) masks of the other objects.
        first: (H, W) its mask just before frame 0, where known.
        config: when to doubt the sum.
    """
    free = pixels & ~np.any(others, axis=0) if others else pixels
    masks = np.array(found.masks)
    largest = masks.sum((1, 2)).max(initial=0)
    reach = ceil(_GAP * hypot(*masks.shape[1:]))
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    for mask, frame in zip(masks, free, strict=True):
        if not mask.any() or not frame.any():
            continue
        labels = np.asarray(cv2.connectedComponents(frame.view(np.uint8), connectivity=8)[1])
        near = cv2.dilate(mask.view(np.uint8), kernel) > 0
        areas = np.bincount(labels.ravel())
        pieces = [n for n in np.unique(labels[near]) if n and areas[n] <= _MAX_SHARE * largest]
        mask |= np.isin(labels, pieces)
    status = found.status
    if status == 'ok':
        start = next((m for m in (first, *masks) if m is not None and m.any()), None)
        status = 'ok' if start is None else judge(masks, start, config)
    return Track(masks=masks, status=status)
