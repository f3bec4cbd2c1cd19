"""Object masks from colour words, without weights; says so where it does not know."""

from __future__ import annotations

from collections.abc import Sequence

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
        status: list[list[str]] = []
        for view in range(num_views):
            firsts = None if first_masks is None else first_masks[view]
            tracks = self._segment_view(frames[view], names, firsts)
            for index, found in enumerate(tracks):
                masks[view, index] = found.masks
            status.append([found.status for found in tracks])
        return ObjectMasks(names=names, masks=masks, status=tuple(map(tuple, status)))

    def _segment_view(
        self, frames: ByteArray, names: tuple[str, ...], firsts: BoolArray | None
    ) -> list[Track]:
        """Tracks of the named objects in (T, H, W, 3) frames of one view."""
        num_frames, height, width, _ = frames.shape
        lab = cv2.cvtColor(frames.reshape(num_frames * height, width, 3), cv2.COLOR_RGB2LAB)
        lab = np.asarray(lab, np.uint8).reshape(frames.shape)
        words = self._word_of_ab[lab[..., 1], lab[..., 2]]
        words[lab[..., 0] < _MIN_LIGHTNESS * 2.55] = len(self._words)
        tracks: list[Track] = []
        for index, name in enumerate(names):
            word = colour_of(name)
            if word is None:
                tracks.append(Track.missing((num_frames, height, width), 'out_of_palette'))
                continue
            rivals = [
                i for i, other in enumerate(names) if colour_of(other) == word and i != index
            ]
            first = None if firsts is None or not firsts[index].any() else firsts[index]
            others = _others(tracks, rivals, index)
            pixels = self._pixels(frames, lab, words == self._words.index(word), word)
            found = track(pixels, first, _TRACKING, taken=others)
            if rivals and first is None and found.status == 'ok':
                found = Track(masks=found.masks, status='ambiguous')
            tracks.append(found)
        return [
            self._complete(tracks, index, name, firsts, (frames, lab, words))
            for index, name in enumerate(names)
        ]

    def _complete(
        self,
        tracks: Sequence[Track],
        index: int,
        name: str,
        firsts: BoolArray | None,
        images: tuple[ByteArray, ByteArray, ByteArray],
    ) -> Track:
        """The track of an object with its part of another colour, where its noun has one."""
        word = part_of(name, colour_of(name))
        if word is None or not tracks[index].masks.any():
            return tracks[index]
        frames, lab, words = images
        pixels = self._pixels(frames, lab, words == self._words.index(word), word)
        others = [track.masks for i, track in enumerate(tracks) if i != index]
        first = None if firsts is None else firsts[index]
        return with_part(tracks[index], pixels, others, first, _TRACKING)

    def _pixels(self, frames: ByteArray, lab: ByteArray, gate: BoolArray, word: str) -> BoolArray:
        """(T, H, W) pixels of a colour, down to where the object makes up half of a pixel."""
        floor = _MIN_SATURATION * self._saturations[self._words.index(word)]
        inside = np.flatnonzero(gate)
        saturation = _saturation(_centred(lab.reshape(-1, 3)[inside]))
        num_core = len(gate) * max(1, _TRACKING.min_area(gate.shape) // 2)
        pixels = np.zeros(gate.shape, np.bool_)
        if np.count_nonzero(saturation > floor) > num_core:
            core = np.partition(saturation, -num_core)[-num_core]
            colour = np.median(frames.reshape(-1, 3)[inside[saturation > 0.8 * core]], axis=0)
            floor = max(floor, _edge(colour, frames, core))
        pixels.reshape(-1)[inside[saturation > floor]] = True
        return pixels


def _edge(colour: Floats, frames: ByteArray, core: float) -> float:
    """Saturation of a pixel that is half object, half background.

    A dark object's edge pixels look pale beside it, a light one's do not.
    """
    background = np.median(frames[:, ::4, ::4].reshape(-1, 3), axis=0)
    mixed = np.round((colour + background) / 2).astype(np.uint8)
    edge = float(_saturation(_lab(mixed[None, None]))[0, 0])
    return min(max(edge, _EDGE_RANGE[0] * core), _EDGE_RANGE[1] * core)


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
