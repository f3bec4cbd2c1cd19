"""Object masks from colour words, without weights; the status states every doubt.

A pixel belongs to the word whose hue is nearest. The edge of an object is where saturation falls
to that of a pixel half object, half background, so blur moves it little. Connected pieces are then
followed from frame to frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import ceil
from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.core.data_types import BoolArray, ByteArray, ObjectMasks
from mtv_world_ros.vision.segmenters.segmenter import check_request
from mtv_world_ros.vision.segmenters.tracking import (
    ObjectTrack,
    part_of,
    track,
    TrackingConfig,
    with_part,
)

#: colour word -> RGB (uint8). Neighbours lie at least 23 degrees of CIELAB hue apart, and keep
#: apart when the colour is shaded to a third or washed out by a dull highlight.
PALETTE: MappingProxyType[str, tuple[int, int, int]] = MappingProxyType(
    {
        'red': (210, 25, 35),
        'orange': (245, 130, 15),
        'yellow': (240, 220, 30),
        'green': (35, 165, 55),
        'cyan': (20, 195, 200),
        'blue': (15, 105, 220),
        'purple': (125, 40, 185),
        'pink': (245, 105, 180),
    }
)


def colour_of(name: str) -> str | None:
    """Return the palette word in an object's name, or None."""
    return next((word for word in name.lower().split() if word in PALETTE), None)


Floats = NDArray[np.floating]
# Saturation is CIELAB chroma / (lightness + 16): it keeps its value when a surface is shaded.
#: largest distance to the colour word's hue [degrees]; hues nearer to another word are that word's
_MAX_HUE_ERROR = 28.0
#: minimum saturation of a detected pixel [fraction of the palette colour's saturation]
_MIN_SATURATION = 0.3
#: range of the saturation at the edge of an object [fraction of its own saturation]
_EDGE_RANGE = (0.25, 0.6)
#: minimum lightness of a pixel with a hue [0-255]
_MIN_LIGHTNESS_8BIT = ceil(0.08 * 255)
#: of pixels with the hue of a word, saturation in HSV as a share of that in CIELAB, at the least
_HSV_SHARE = 0.6
_TRACKING = TrackingConfig()
#: minimum saturation of pixels that define the colour of an object [fraction of the core's]
_STRONG_SHARE = 0.8
#: number of pixels of a view at which each view is segmented in a thread of its own
_MIN_PIXELS_FOR_THREADS = 1_000_000


class ColourSegmenter:
    """Objects whose name holds one of eight colour words.

    They are red, orange, yellow, green, cyan, blue, purple and pink.
    """

    name = 'colour'

    def __init__(self) -> None:
        self._words = tuple(PALETTE)
        colours = _lab(np.array([list(PALETTE.values())], np.uint8))[0]
        self._saturations = _saturation(colours)
        self._word_of_ab = _hue_table(colours)
        steps = np.arange(256, dtype=np.uint8)
        a, b = np.meshgrid(steps, steps, indexing='ij')
        centred = _centred(np.stack([a, a, b], -1))
        self._chroma_of_ab = np.hypot(centred[..., 1], centred[..., 2])
        self._shade_of_lightness = centred[:, 0, 0] + 16

    def _least_hsv(self, words: Sequence[str]) -> tuple[int, int, int]:
        """8-bit hue, saturation and value that no pixel falls short of that may be of a word."""
        floors = [_MIN_SATURATION * self._saturations[self._words.index(word)] for word in words]
        least = 255 * _HSV_SHARE * _STRONG_SHARE * min(floors, default=1.0)
        return 0, int(least), _MIN_LIGHTNESS_8BIT

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

        if num_frames * height * width < _MIN_PIXELS_FOR_THREADS or cv2.getNumThreads() < 2:
            status = tuple(map(look_at, range(num_views)))
        else:  # OpenCV and numpy take most of the time and release the interpreter lock
            with ThreadPoolExecutor(min(num_views, cv2.getNumThreads())) as pool:
                status = tuple(pool.map(look_at, range(num_views)))
        return ObjectMasks(names=names, masks=masks, status=status)

    def _segment_view(
        self,
        frames: ByteArray,
        names: tuple[str, ...],
        firsts: BoolArray | None,
        out: BoolArray,
    ) -> list[ObjectTrack]:
        """Return the tracks of the named objects in (T, H, W, 3) frames of one view.

        `out` may take them.
        """
        images = self._look(frames, names)
        tracks: list[ObjectTrack] = []
        for index, name in enumerate(names):
            word = colour_of(name)
            if word is None:
                tracks.append(ObjectTrack.missing(frames.shape[:3], 'out_of_palette'))
                continue
            rivals = [
                i for i, other in enumerate(names) if colour_of(other) == word and i != index
            ]
            first = None if firsts is None or not firsts[index].any() else firsts[index]
            others = _others(tracks, rivals, index)
            pixels = self._pixels(images, word)
            found = track(pixels, first, _TRACKING, taken=others, out=out[index])
            if rivals and first is None and found.status == 'ok':
                found = ObjectTrack(masks=found.masks, status='ambiguous')
            tracks.append(found)
        return [
            self._complete(tracks, index, name, firsts, images) for index, name in enumerate(names)
        ]

    def _complete(
        self,
        tracks: Sequence[ObjectTrack],
        index: int,
        name: str,
        firsts: BoolArray | None,
        images: _Images,
    ) -> ObjectTrack:
        """Return track of an object with its part of another colour, where its noun has one."""
        word = part_of(name, colour_of(name))
        if word is None or not tracks[index].masks.any():
            return tracks[index]
        pixels = self._pixels(images, word)
        others = [track.masks for i, track in enumerate(tracks) if i != index]
        first = None if firsts is None else firsts[index]
        return with_part(tracks[index], pixels, others, first, _TRACKING)

    def _look(self, frames: ByteArray, names: tuple[str, ...]) -> _Images:
        """Look at (T, H, W, 3) frames for pixels of the hues that the names speak of.

        What is too pale or dark to be of a word shows in HSV, at a fifth of the cost of CIELAB:
        most of an image is, and is looked at no further.
        """
        colours = [colour_of(name) for name in names]
        parts = [part_of(name, word) for name, word in zip(names, colours, strict=True)]
        wanted = sorted({word for word in (*colours, *parts) if word is not None})
        least = self._least_hsv(wanted)
        nothing = (np.zeros(0, np.intp), np.zeros(0, np.float32))
        found = {word: [nothing] for word in wanted}
        hsv = np.empty(frames.shape[1:], np.uint8)
        for number, frame in enumerate(frames if wanted else ()):
            cv2.cvtColor(frame, cv2.COLOR_RGB2HSV, dst=hsv)
            at = np.flatnonzero(np.not_equal(cv2.inRange(hsv, least, (255, 255, 255)), 0))
            if not len(at):
                continue
            rgb = frame.reshape(-1, 3).take(at, axis=0)
            lightness, a, b = np.asarray(cv2.cvtColor(rgb[None], cv2.COLOR_RGB2LAB))[0].T
            ab = a.astype(np.intp) * 256 + b
            saturation = self._chroma_of_ab.take(ab) / self._shade_of_lightness.take(lightness)
            words = np.where(lightness >= _MIN_LIGHTNESS_8BIT, self._word_of_ab.take(ab), 255)
            at += number * frame[..., 0].size
            for word, pieces in found.items():
                is_word = words == self._words.index(word)
                pieces.append((at[is_word], saturation[is_word]))
        return _Images(
            frames=frames,
            background=_median(frames[:, ::4, ::4]),
            inside={
                word: (np.concatenate([at for at, _ in pieces]),
                       np.concatenate([saturation for _, saturation in pieces]))
                for word, pieces in found.items()
            },
        )  # fmt: skip

    def _pixels(self, images: _Images, word: str) -> BoolArray:
        """(T, H, W) pixels of a colour, down to where the object makes up half of a pixel."""
        floor = _MIN_SATURATION * self._saturations[self._words.index(word)]
        inside, saturation = images.inside[word]
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
        inside: pixels of the hue of each colour word, but for some of the palest, by word: (N,)
            flat indices into T, H, W, and (N,) saturations.
    """

    frames: ByteArray
    background: Floats
    inside: dict[str, tuple[NDArray[np.intp], Floats]]


def _edge(colour: Floats, background: Floats, core: float) -> float:
    """Return the saturation of a pixel that is half object, half background.

    Edge pixels of a dark object are paler than the object; those of a light object are not.
    """
    mixed = np.round((colour + background) / 2).astype(np.uint8)
    edge = float(_saturation(_lab(mixed[None, None]))[0, 0])
    return min(max(edge, _EDGE_RANGE[0] * core), _EDGE_RANGE[1] * core)


def _median(pixels: ByteArray) -> Floats:
    """Return (3,) the median of (..., 3) uint8 by channel, which numpy takes longer to sort."""
    image = np.ascontiguousarray(pixels).reshape(1, -1, 3)
    middle = [(image.shape[1] - 1) // 2, image.shape[1] // 2]
    counts = [cv2.calcHist([image], [channel], None, [256], [0, 256]) for channel in range(3)]
    return np.array([
        np.searchsorted(np.cumsum(count, dtype=np.float64), middle, side='right').mean()
        for count in counts
    ])  # fmt: skip


def _others(tracks: Sequence[ObjectTrack], rivals: Sequence[int], index: int) -> BoolArray | None:
    """Return the pixels that objects of the same colour word, found before, already hold."""
    held = [tracks[i].masks for i in rivals if i < index]
    return np.any(held, axis=0) if held else None


def _lab(rgb: ByteArray) -> Floats:
    """Return (..., 3) CIELAB of (N, M, 3) uint8 RGB, L in 0-100, a and b around 0."""
    return _centred(np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB), np.uint8))


def _centred(lab: ByteArray) -> Floats:
    """Undo OpenCV's 8-bit packing of CIELAB."""
    centred = lab.astype(np.float32)
    centred[..., 0] *= 100 / 255
    centred[..., 1:] -= 128
    return centred


def _saturation(lab: Floats) -> Floats:
    return np.hypot(lab[..., 1], lab[..., 2]) / (lab[..., 0] + 16)


def _hue_table(colours: Floats) -> ByteArray:
    """Return (256, 256) index of the palette word nearest in hue for each 8-bit a, b; N = none."""
    a, b = np.meshgrid(np.arange(256) - 128, np.arange(256) - 128, indexing='ij')
    hues = np.degrees(np.arctan2(colours[:, 2], colours[:, 1]))
    error = np.degrees(np.arctan2(b, a))[..., None] - hues
    error = np.abs((error + 180) % 360 - 180)
    word = error.argmin(-1)
    word[error.min(-1) > _MAX_HUE_ERROR] = len(colours)
    return word.astype(np.uint8)
