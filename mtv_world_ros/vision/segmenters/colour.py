"""Object masks from colour words, without weights; says so where it does not know."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import ceil

import cv2
import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.data_types import BoolArray, ByteArray, ObjectMasks
from mtv_world_ros.vision.colour_words import colour_of, PALETTE
from mtv_world_ros.vision.segmenters.segmenter import check_request
from mtv_world_ros.vision.segmenters.tracking import (
    part_of,
    Track,
    track,
    TrackingConfig,
    with_part,
)

Floats = NDArray[np.floating]
# Saturation is CIELAB chroma / (lightness + 16): it keeps its value when a surface is shaded.
#: largest distance to the colour word's hue [degrees]; hues nearer to another word are that word's
_MAX_HUE_ERROR = 28.0
#: share of the palette colour's saturation below which nothing is found
_MIN_SATURATION = 0.3
#: shares of the object's own saturation between which its edge may lie
_EDGE_RANGE = (0.25, 0.6)
#: darker pixels have no hue [0-100]
_MIN_LIGHTNESS = 8.0
_TRACKING = TrackingConfig()
#: pixels of at least this share of the core's saturation say what colour the object has
_STRONG_SHARE = 0.8
#: pixels of a view from which on views are looked at in threads of their own
_LEAST_FOR_THREADS = 1_000_000


class ColourSegmenter:
    """Finds objects whose name holds a word of the palette.

    A pixel belongs to the word whose hue is nearest. The edge of an object is where saturation
    falls to that of a pixel half object, half background, so blur moves it little. Connected
    pieces are then followed from frame to frame.
    """

    name = 'colour'

    def __init__(self) -> None:
        self._words = tuple(PALETTE)
        colours = _lab(np.array([list(PALETTE.values())], np.uint8))[0]
        self._saturations = _saturation(colours)
        self._word_of_ab = _hue_table(colours)
        self._boxes = [self._box(word) for word in range(len(self._words))]

    def _box(self, word: int) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
        """Least and greatest 8-bit L, a, b of pixels that `_pixels` may count as a word's."""
        darkest = min(ceil(_MIN_LIGHTNESS * 2.55), 255)
        floor = _MIN_SATURATION * self._saturations[word]
        a, b = np.meshgrid(np.arange(256), np.arange(256), indexing='ij')
        saturation = np.hypot(a - 128, b - 128) / (darkest * 100 / 255 + 16)
        # a share of the core's, which is above the floor; less, for rounding
        is_near = (self._word_of_ab == word) & (saturation > 0.99 * _STRONG_SHARE * floor)
        rows, columns = np.flatnonzero(is_near.any(1)), np.flatnonzero(is_near.any(0))
        if not len(rows):
            return (255, 255, 255), (0, 0, 0)
        low = darkest, int(rows[0]), int(columns[0])
        return low, (255, int(rows[-1]), int(columns[-1]))

    def segment(
        self,
        frames: ByteArray,
        names: tuple[str, ...],
        first_masks: BoolArray | None = None,
        first_frames: ByteArray | None = None,
    ) -> ObjectMasks:
        """See `Segmenter.segment`; `first_frames` are not needed."""
        check_request(frames, names, first_masks, first_frames)
        num_views, num_frames, height, width, _ = frames.shape
        masks = np.zeros((num_views, len(names), num_frames, height, width), np.bool_)

        def look_at(view: int) -> tuple[str, ...]:
            firsts = None if first_masks is None else first_masks[view]
            tracks = self._segment_view(frames[view], names, firsts, masks[view])
            for index, found in enumerate(tracks):
                if not np.shares_memory(found.masks, masks):
                    masks[view, index] = found.masks
            return tuple(found.status for found in tracks)

        if num_frames * height * width < _LEAST_FOR_THREADS or cv2.getNumThreads() < 2:
            status = tuple(map(look_at, range(num_views)))
        else:  # most of it is OpenCV and numpy, which run beside each other
            with ThreadPoolExecutor(min(num_views, cv2.getNumThreads())) as pool:
                status = tuple(pool.map(look_at, range(num_views)))
        return ObjectMasks(names=names, masks=masks, status=status)

    def _segment_view(
        self,
        frames: ByteArray,
        names: tuple[str, ...],
        firsts: BoolArray | None,
        out: BoolArray,
    ) -> list[Track]:
        """Tracks of the named objects in (T, H, W, 3) frames of one view; `out` may take them."""
        images = self._look(frames, names)
        tracks: list[Track] = []
        for index, name in enumerate(names):
            word = colour_of(name)
            if word is None:
                tracks.append(Track.missing(frames.shape[:3], 'out_of_palette'))
                continue
            rivals = [
                i for i, other in enumerate(names) if colour_of(other) == word and i != index
            ]
            first = None if firsts is None or not firsts[index].any() else firsts[index]
            others = _others(tracks, rivals, index)
            pixels = self._pixels(images, word)
            found = track(pixels, first, _TRACKING, taken=others, out=out[index])
            if rivals and first is None and found.status == 'ok':
                found = Track(masks=found.masks, status='ambiguous')
            tracks.append(found)
        return [
            self._complete(tracks, index, name, firsts, images) for index, name in enumerate(names)
        ]

    def _complete(
        self,
        tracks: Sequence[Track],
        index: int,
        name: str,
        firsts: BoolArray | None,
        images: _Images,
    ) -> Track:
        """The track of an object with its part of another colour, where its noun has one."""
        word = part_of(name, colour_of(name))
        if word is None or not tracks[index].masks.any():
            return tracks[index]
        pixels = self._pixels(images, word)
        others = [track.masks for i, track in enumerate(tracks) if i != index]
        first = None if firsts is None else firsts[index]
        return with_part(tracks[index], pixels, others, first, _TRACKING)

    def _look(self, frames: ByteArray, names: tuple[str, ...]) -> _Images:
        """Looks at (T, H, W, 3) frames for pixels of the hues that the names speak of.

        All that are out of a word's box in CIELAB are too pale for `_pixels`: most of an image
        is, and is looked at only once.
        """
        colours = [colour_of(name) for name in names]
        parts = [part_of(name, word) for name, word in zip(names, colours, strict=True)]
        wanted = sorted({word for word in (*colours, *parts) if word is not None})
        nothing = (np.zeros(0, np.intp), np.zeros((0, 3), np.uint8))
        found = {word: [nothing] for word in wanted}
        num_pixels, width = frames[0, ..., 0].size, frames.shape[2]
        for number, frame in enumerate(frames):
            lab = np.asarray(cv2.cvtColor(frame, cv2.COLOR_RGB2LAB), np.uint8)
            for word, pieces in found.items():
                index = self._words.index(word)
                near = cv2.findNonZero(cv2.inRange(lab, *self._boxes[index]))
                if near is None:
                    continue
                at = np.asarray(near, np.intp).reshape(-1, 2) @ np.array([1, width])
                values = lab.reshape(-1, 3).take(at, axis=0)
                is_word = self._word_of_ab[values[:, 1], values[:, 2]] == index
                if not is_word.all():
                    at, values = at[is_word], values[is_word]
                pieces.append((at + number * num_pixels, values))
        return _Images(
            frames=frames,
            background=_median(frames[:, ::4, ::4]),
            inside={
                word: (np.concatenate([at for at, _ in pieces]),
                       np.concatenate([values for _, values in pieces]))
                for word, pieces in found.items()
            },
        )  # fmt: skip

    def _pixels(self, images: _Images, word: str) -> BoolArray:
        """(T, H, W) pixels of a colour, down to where the object makes up half of a pixel."""
        floor = _MIN_SATURATION * self._saturations[self._words.index(word)]
        inside, values = images.inside[word]
        saturation = _saturation(_centred(values))
        shape = images.frames.shape[:3]
        num_core = shape[0] * max(1, _TRACKING.min_area(shape) // 2)
        pixels = np.zeros(shape, np.bool_)
        if np.count_nonzero(saturation > floor) > num_core:
            core = float(np.partition(saturation, -num_core)[-num_core])
            strong = inside[saturation > _STRONG_SHARE * core]
            colour = _median(images.frames.reshape(-1, 3).take(strong, axis=0))
            floor = max(floor, _edge(colour, images.background, core))
        pixels.reshape(-1)[inside[saturation > floor]] = True
        return pixels


@dataclass(frozen=True, slots=True, kw_only=True)
class _Images:
    """The frames of one view, and what in them may be coloured objects.

    Attributes:
        frames: (T, H, W, 3) uint8 RGB.
        background: (3,) the median colour, RGB.
        inside: by word the N pixels of its hue, but for some of the palest: flat indices (N,)
            into T, H, W, and (N, 3) uint8 CIELAB as OpenCV packs it.
    """

    frames: ByteArray
    background: Floats
    inside: dict[str, tuple[NDArray[np.intp], ByteArray]]


def _edge(colour: Floats, background: Floats, core: float) -> float:
    """Saturation of a pixel that is half object, half background.

    A dark object's edge pixels look pale beside it, a light one's do not.
    """
    mixed = np.round((colour + background) / 2).astype(np.uint8)
    edge = float(_saturation(_lab(mixed[None, None]))[0, 0])
    return min(max(edge, _EDGE_RANGE[0] * core), _EDGE_RANGE[1] * core)


def _median(pixels: ByteArray) -> Floats:
    """(3,) the median of (..., 3) uint8 by channel, which numpy takes longer to sort."""
    channels = pixels.reshape(-1, 3).T
    middle = [(channels.shape[1] - 1) // 2, channels.shape[1] // 2]
    counts = [np.bincount(channel, minlength=256).cumsum() for channel in channels]
    return np.array([np.searchsorted(count, middle, side='right').mean() for count in counts])


def _others(tracks: Sequence[Track], rivals: Sequence[int], index: int) -> BoolArray | None:
    """Pixels that objects of the same colour word, found before, already hold."""
    held = [tracks[i].masks for i in rivals if i < index]
    return np.any(held, axis=0) if held else None


def _lab(rgb: ByteArray) -> Floats:
    """(..., 3) CIELAB of (N, M, 3) uint8 RGB, L in 0-100, a and b around 0."""
    return _centred(np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB), np.uint8))


def _centred(lab: ByteArray) -> Floats:
    """Undoes OpenCV's 8-bit packing of CIELAB."""
    centred = lab.astype(np.float32)
    centred[..., 0] *= 100 / 255
    centred[..., 1:] -= 128
    return centred


def _saturation(lab: Floats) -> Floats:
    return np.hypot(lab[..., 1], lab[..., 2]) / (lab[..., 0] + 16)


def _hue_table(colours: Floats) -> ByteArray:
    """(256, 256) index of the palette word nearest in hue for each 8-bit a, b; N = none."""
    a, b = np.meshgrid(np.arange(256) - 128, np.arange(256) - 128, indexing='ij')
    hues = np.degrees(np.arctan2(colours[:, 2], colours[:, 1]))
    error = np.degrees(np.arctan2(b, a))[..., None] - hues
    error = np.abs((error + 180) % 360 - 180)
    word = error.argmin(-1)
    word[error.min(-1) > _MAX_HUE_ERROR] = len(colours)
    return word.astype(np.uint8)
