"""Segmenters prompted by names: objects are detected once, then tracked by SAM."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from mtv_world_ros.core.data_types import BoolArray, ByteArray, ObjectMasks
from mtv_world_ros.core.errors import ModelMemoryError
from mtv_world_ros.vision.segmenters.segmenter import check_request
from mtv_world_ros.vision.segmenters.tracking import judge_tracks, TrackingConfig

Tensor = Any  # torch is imported where it is used


class SamVideo(Protocol):
    """A video model of the SAM family: SAM 2 and the tracker inside SAM 3 share this interface."""

    #: of the session's tensors
    device: str

    @property
    def tracker(self) -> Any:
        """The model whose `config`, memory and `image_size` count."""
        ...

    def open_session(self, height: int, width: int) -> Any:
        """Return an empty session for frames of that size [px]."""
        ...

    def advance(self, session: Any, frame: ByteArray, index: int) -> Any:
        """Run one (H, W, 3) frame, the session's `index`-th, and return the model's output."""
        ...


def track_masks(
    model: SamVideo,
    first_frame: ByteArray,
    first_masks: BoolArray,
    frames: Iterable[ByteArray],
) -> Iterator[BoolArray]:
    """Yield the masks (O, H, W) of each frame when it arrives.

    Memory does not grow with the number of frames: frames beyond the model's memory are dropped,
    which changes no mask.

    Args:
        model: tracker.
        first_frame: (H, W, 3) uint8 RGB, the frame that the masks belong to.
        first_masks: (O, H, W), none empty.
        frames: (H, W, 3) uint8 RGB, the following frames.
    """
    if not len(first_masks):
        for frame in frames:
            yield np.zeros((0, *frame.shape[:2]), np.bool_)
        return
    session = start_session(model, first_frame, first_masks)
    for index, frame in enumerate(frames, start=1):
        yield output_masks(model.advance(session, frame, index), *frame.shape[:2])
        drop_old(session, index, reach(model.tracker.config))


def start_session(model: SamVideo, first_frame: ByteArray, first_masks: BoolArray) -> Any:
    """Return a session that remembers the objects of the first frame; arguments as above."""
    session = model.open_session(*first_frame.shape[:2])
    for number, mask in enumerate(first_masks):
        index = session.obj_id_to_idx(number)
        session.add_mask_inputs(index, 0, _square_mask(mask, model))
    session.obj_with_new_inputs = list(range(len(first_masks)))
    model.advance(session, first_frame, 0)
    return session


def output_masks(output: Any, height: int, width: int) -> BoolArray:
    """Return the (O, H, W) masks of a model's output, at the size of the frames."""
    import torch

    logits = torch.nn.functional.interpolate(
        output.pred_masks.float(), size=(height, width), mode='bilinear', align_corners=False
    )
    return (logits[:, 0] > 0).cpu().numpy()


def reach(config: Any) -> int:
    """Return how many frames back a tracker looks: mask memories and object pointers."""
    return max(config.num_maskmem, config.max_object_pointers_in_encoder) + 1


def drop_old(session: Any, index: int, kept: int) -> None:
    """Forget frames up to `index` and what was found more than `kept` frames before it."""
    for old in [number for number in session.processed_frames if number <= index]:
        del session.processed_frames[old]
    for item, outputs in session.output_dict_per_obj.items():
        tracked = session.frames_tracked_per_obj[item]
        for store in (outputs['non_cond_frame_outputs'], tracked):
            for old in [number for number in store if number < index - kept]:
                del store[old]


def _square_mask(mask: BoolArray, model: SamVideo) -> Tensor:
    """Return (1, 1, S, S) the prompt, at the model's own size.

    A small object keeps a pixel at least.
    """
    import torch

    size = int(model.tracker.image_size)
    pixels = torch.tensor(mask, device=model.device)[None, None].float()
    pixels = torch.nn.functional.interpolate(
        pixels, size=(size, size), mode='bilinear', align_corners=False, antialias=True
    )
    return (pixels >= min(0.5, float(pixels.max()))).float()


@dataclass(frozen=True, slots=True, kw_only=True)
class FirstMasks:
    """Masks of the objects detected in one frame.

    Attributes:
        masks: (O, H, W) bool, empty where nothing was found.
        status: O words: `ok`, `absent`, `ambiguous` or `low_confidence`.
    """

    masks: BoolArray
    status: tuple[str, ...]


class Finder(Protocol):
    """Finds named objects in one frame."""

    def find(self, frame: ByteArray, names: tuple[str, ...]) -> FirstMasks:
        """Return the masks of O names in an (H, W, 3) uint8 RGB frame."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class PromptedSegmenter:
    """A `Segmenter` that looks for names once and then follows masks.

    Two videos that are given the same first masks are followed from the same prompt, so their
    objects correspond without matching.

    Attributes:
        name: name of the models, for reports.
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
        """Fill the (O, T, H, W) masks of one view and return the statuses."""
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
    """Turn torch's out-of-memory error into one that names remedies."""
    import torch

    try:
        yield
    except torch.OutOfMemoryError as error:
        raise ModelMemoryError(
            f"the segmenter '{name}' does not fit on '{device}' ({error}); set another device or "
            'segmenter, or weights of a smaller model'
        ) from error


def _status(doubt: str, first: BoolArray, masks: BoolArray, config: TrackingConfig) -> str:
    """Return the finder's doubt, else the tracker's."""
    if doubt != 'ok':
        return doubt
    return judge_tracks(masks, first, config) if first.any() else 'absent'
