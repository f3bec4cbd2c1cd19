"""Objects found by name in the first frame only, then followed from their masks there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from mtv_world_ros.data_types import BoolArray, ByteArray, ObjectMasks
from mtv_world_ros.errors import ModelMemoryError
from mtv_world_ros.vision.segmenters.mask_tracking import SamVideo, track_masks
from mtv_world_ros.vision.segmenters.segmenter import check_request
from mtv_world_ros.vision.segmenters.tracking import judge, TrackingConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class FirstMasks:
    """What was found in one frame.

    Attributes:
        masks: (O, H, W) bool, empty where nothing was found.
        status: O words: `ok`, `absent`, `ambiguous` or `low_confidence`.
    """

    masks: BoolArray
    status: tuple[str, ...]


class Finder(Protocol):
    """Finds named objects in one frame."""

    def find(self, frame: ByteArray, names: tuple[str, ...]) -> FirstMasks:
        """Returns the masks of O names in an (H, W, 3) uint8 RGB frame."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class PromptedSegmenter:
    """A `Segmenter` that looks for names once and then follows masks.

    Two videos that are given the same first masks are followed from the same prompt, so their
    objects correspond without matching.

    Attributes:
        name: of the models, for reports.
        finder: finds the names where no first masks are given.
        video: follows the masks.
        tracking: when a followed mask is to be doubted.
    """

    name: str
    finder: Finder
    video: SamVideo
    tracking: TrackingConfig = field(default_factory=TrackingConfig)

    def segment(
        self,
        frames: ByteArray,
        names: tuple[str, ...],
        first_masks: BoolArray | None = None,
        first_frames: ByteArray | None = None,
    ) -> ObjectMasks:
        """See `Segmenter.segment`.

        First masks without their frames are taken for masks of `frames[:, 0]`, and that frame is
        then segmented like the others.

        Raises:
            ModelMemoryError: the device ran out of memory.
        """
        check_request(frames, names, first_masks, first_frames)
        num_views, num_frames, height, width, _ = frames.shape
        masks = np.zeros((num_views, len(names), num_frames, height, width), np.bool_)
        status = []
        for view in range(num_views if num_frames else 0):
            given = None
            if first_masks is not None:
                start = frames[view, 0] if first_frames is None else first_frames[view]
                given = start, first_masks[view]
            with memory_errors(self.name, self.video.device):
                row = self._segment_view(frames[view], names, given, masks[view])
            status.append(row)
        rows = status or [('absent',) * len(names)] * num_views
        return ObjectMasks(names=names, masks=masks, status=tuple(rows))

    def _segment_view(
        self,
        frames: ByteArray,
        names: tuple[str, ...],
        given: tuple[ByteArray, BoolArray] | None,
        masks: BoolArray,
    ) -> tuple[str, ...]:
        """Fills the (O, T, H, W) masks of one view and returns the statuses."""
        if given is None:
            found = self.finder.find(frames[0], names)
            start, firsts = frames[0], found.masks
            doubts = found.status
            masks[:, 0] = firsts
            later = slice(1, None)
        else:
            start, firsts = given
            doubts = ('ok',) * len(names)
            later = slice(0, None)
        known = firsts.any((1, 2))
        tracked = masks[:, later]
        steps = track_masks(self.video, start, firsts[known], frames[later])
        for index, step in enumerate(steps):
            tracked[known, index] = step
        return tuple(
            _status(doubt, firsts[item], masks[item], self.tracking)
            for item, doubt in enumerate(doubts)
        )


@contextmanager
def memory_errors(name: str, device: str) -> Iterator[None]:
    """Turns torch's error into one that says what can be done."""
    import torch

    try:
        yield
    except torch.OutOfMemoryError as error:
        raise ModelMemoryError(
            f"the segmenter '{name}' does not fit on '{device}' ({error}); set another device or "
            'segmenter, or weights of a smaller model'
        ) from error


def _status(doubt: str, first: BoolArray, masks: BoolArray, config: TrackingConfig) -> str:
    """The finder's doubt, else the tracker's."""
    if doubt != 'ok':
        return doubt
    return judge(masks, first, config) if first.any() else 'absent'
