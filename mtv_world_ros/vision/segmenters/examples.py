"""Object masks from boxes that somebody drew in a few frames, without weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
import hashlib
from math import hypot
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from mtv_world_ros.core.bounded_input import require_regular
from mtv_world_ros.core.data_types import BoolArray, ByteArray, ObjectMasks
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import write_whole
from mtv_world_ros.vision.jaccard import jaccard
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter
from mtv_world_ros.vision.segmenters.segmenter import check_request, resize_masks
from mtv_world_ros.vision.segmenters.tracking import judge_tracks, track, TrackingConfig

#: left, top, right, bottom [px]
Box = tuple[float, float, float, float]

Floats = NDArray[np.floating]
#: bins of a histogram of CIELAB in 8 bits
_BINS = (16, 64, 64)
#: standard deviation of the smoothing of a histogram [bins]
_SPREAD = (0.7, 1.0, 1.0)
#: minimum fraction of the pixels of an object for a colour of the object
_MIN_COLOUR_SHARE = 2e-5
#: weight of the colours of the whole picture in the surroundings of an object that may move away
_ELSEWHERE = 0.03
#: minimum Jaccard index of a colour mask with the drawn masks for tracking by colour
_MIN_COLOUR_JACCARD = 0.5
#: minimum correlation with the picture of an example for a detection
_MIN_CORRELATION = 0.75
#: maximum change of the CIELAB values L, a, b (8 bits) of a resting object; shadows change L most
_MAX_RESTING_CHANGE = (40, 10, 10)
#: minimum share of the object's own colours in the first mask for tracking by colour
_MIN_COLOUR_FRACTION = 0.5
#: minimum unchanged share of the first mask; below it the object is hidden
_MIN_UNCHANGED_FRACTION = 0.25
#: maximum motion of an object between frames [fraction of the image's diagonal]
_MAX_MOTION = 0.05
#: margin around a mask that is cut out [fraction of the frame's width]
_MARGIN = 0.0125
#: smallest margin around a mask that is cut out [px]
_MIN_MARGIN_PX = 2
#: maximum area of a mask that is cut out [fraction of the frame]: larger masks have little shade
#: for their size, and take long
_MAX_CUT_FRACTION = 0.01
#: minimum Jaccard index of a cut-out mask with the colour mask for being the same object
_MIN_CUT_JACCARD = 0.5
#: maximum number of kept pixels of the surroundings in a frame
_KEPT = 4000
_TRACKING = TrackingConfig()


@dataclass(frozen=True, slots=True, kw_only=True)
class Example:
    """An object in one frame.

    Attributes:
        name: name of the object.
        frame: (h, w, 3) uint8 RGB, the object and what surrounds it.
        mask: (h, w) mask of the object.
        size: (2,) width and height of the whole frame [px].
    """

    name: str
    frame: ByteArray
    mask: BoolArray
    size: NDArray[np.int64]

    @staticmethod
    def in_box(name: str, frame: ByteArray, box: Box) -> Example:
        """Cut the object in a box out of its background, by GrabCut.

        Args:
            name: name of the object.
            frame: (H, W, 3) uint8 RGB.
            box: edges of the box around the object [px].
        """
        height, width = frame.shape[:2]
        left, top, right, bottom = (round(edge) for edge in box)
        wide, high = right - left, bottom - top
        x, y = max(0, left - wide), max(0, top - high)
        crop = np.ascontiguousarray(
            frame[y : min(height, bottom + high), x : min(width, right + wide)]
        )
        zoom = 4 if min(wide, high) < 40 else 2  # GrabCut's model of edges counts in pixels
        large = cv2.resize(crop, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_LINEAR)
        labels = np.zeros(large.shape[:2], np.uint8)
        inside = tuple(zoom * number for number in (left - x, top - y, wide, high))
        cv2.setRNGSeed(0)
        cv2.grabCut(
            large, labels, inside, np.zeros((1, 65)), np.zeros((1, 65)), 5, cv2.GC_INIT_WITH_RECT
        )
        mask = resize_masks(labels % 2 == 1, crop.shape[1], crop.shape[0])
        if not mask.any():  # nothing stands out: the box itself
            mask[top - y : bottom - y, left - x : right - x] = True
        return Example(name=name, frame=crop, mask=mask, size=np.array([width, height]))

    def patch(self, width: int, height: int) -> tuple[ByteArray, BoolArray]:
        """Return the object alone and its mask, for frames of another size."""
        rows, columns = np.nonzero(self.mask)
        around = np.s_[
            max(0, rows.min() - 2) : rows.max() + 3, max(0, columns.min() - 2) : columns.max() + 3
        ]
        picture, mask = self.frame[around], self.mask[around]
        scale = np.array([width, height]) / self.size
        wide, high = (max(3, round(n)) for n in scale * (picture.shape[1], picture.shape[0]))
        resized = cv2.resize(picture, (wide, high), interpolation=cv2.INTER_AREA)
        return np.asarray(resized, np.uint8), resize_masks(mask, wide, high)


@dataclass(frozen=True, kw_only=True)
class ObjectExamples:
    """Appearance of objects in example pictures.

    Attributes:
        examples: examples of all objects.
        elsewhere: (N, 3) uint8 RGB of what is no object, drawn from the frames evenly.
    """

    examples: tuple[Example, ...]
    elsewhere: ByteArray

    @staticmethod
    def of(frames: Sequence[tuple[ByteArray, Mapping[str, Box]]]) -> ObjectExamples:
        """Learn from frames (H, W, 3) uint8 RGB with a box by name of object."""
        found, around = [], []
        for frame, boxes in frames:
            outside = np.ones(frame.shape[:2], np.bool_)
            for name, box in boxes.items():
                found.append(Example.in_box(name, frame, box))
                left, top, right, bottom = (round(edge) for edge in box)
                outside[top:bottom, left:right] = False
            rest = frame[outside]
            around.append(rest[:: max(1, len(rest) // _KEPT)])
        return ObjectExamples(examples=tuple(found), elsewhere=np.concatenate(around))

    def checked(self) -> ObjectExamples:
        """Return itself.

        Raises:
            ValueError: shapes or kinds do not fit each other, or there is nothing.
        """
        pictures = [self.elsewhere[None], *(example.frame for example in self.examples)]
        if any(p.dtype != np.uint8 or p.ndim != 3 or p.shape[-1] != 3 for p in pictures):
            raise ValueError('pictures must be (height, width, 3) uint8')
        for one in self.examples:
            if one.mask.shape != one.frame.shape[:2] or not one.mask.any():
                raise ValueError(f"the mask of '{one.name}' is {one.mask.shape} or empty")
            if one.size.shape != (2,) or (one.size < 1).any():
                raise ValueError(f"the size of '{one.name}' is {one.size}")
        if not self.examples or not len(self.elsewhere):
            raise ValueError('it is empty')
        return self

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the objects."""
        return tuple(dict.fromkeys(example.name for example in self.examples))

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all examples; it identifies the masks made with them."""
        digest = hashlib.sha256(self.elsewhere.tobytes())
        for one in self.examples:
            shape = (*one.frame.shape, *one.size.tolist())
            digest.update(f'{one.name} {shape}'.encode())
            digest.update(one.frame.tobytes() + one.mask.astype(np.uint8).tobytes())
        return digest.hexdigest()

    def of_name(self, name: str) -> list[Example]:
        """Return the examples of one object."""
        return [example for example in self.examples if example.name == name]

    def save(self, path: Path) -> None:
        """Write the examples as a safetensors file."""
        tensors: dict[str, NDArray[np.generic]] = {'elsewhere': self.elsewhere}
        for number, example in enumerate(self.examples):
            tensors |= {f'{number}.frame': np.ascontiguousarray(example.frame),
                        f'{number}.mask': example.mask.astype(np.uint8),
                        f'{number}.size': example.size}  # fmt: skip
        names = {str(number): example.name for number, example in enumerate(self.examples)}
        write_whole(path, save(tensors, metadata=names))

    @staticmethod
    def load(path: Path) -> ObjectExamples:
        """Read a file that `save` wrote.

        Raises:
            ConfigError: there is no such file, or it is something else.
        """
        from safetensors import safe_open

        try:
            require_regular(path)
            tensors = load_file(path)
            with safe_open(path, 'numpy') as file:
                names: dict[str, str] = file.metadata() or {}
            examples = tuple(
                Example(
                    name=name,
                    frame=tensors[f'{number}.frame'],
                    mask=tensors[f'{number}.mask'] > 0,
                    size=tensors[f'{number}.size'],
                )
                for number, name in sorted(names.items(), key=lambda item: int(item[0]))
            )
            return ObjectExamples(examples=examples, elsewhere=tensors['elsewhere']).checked()
        except (SafetensorError, OSError, KeyError, ValueError) as error:
            raise ConfigError(
                f"segmenter: '{path}' has no examples of objects ({error}); import with "
                '--objects writes them'
            ) from error


def _bins(rgb: ByteArray) -> NDArray[np.intp]:
    """Return (...,) bin of each (..., 3) uint8 RGB."""
    lab = np.asarray(cv2.cvtColor(rgb.reshape(1, -1, 3), cv2.COLOR_RGB2LAB), np.intp)[0]
    lightness, a, b = (lab // [256 // count for count in _BINS]).T
    return ((lightness * _BINS[1] + a) * _BINS[2] + b).reshape(rgb.shape[:-1])


def _histogram(rgb: ByteArray) -> Floats:
    """Return (bins,) shares of the colours of (N, 3) uint8 RGB."""
    from scipy.ndimage import gaussian_filter

    counts = np.bincount(_bins(rgb), minlength=int(np.prod(_BINS))).astype(float)
    spread = gaussian_filter(counts.reshape(_BINS), _SPREAD).ravel()
    return spread / max(spread.sum(), 1e-9)


class _Look:
    """Colours of one object, and whether they tell it from everything else.

    Attributes:
        colours: (bins,) colour histogram of the object.
        wide: (bins,) bool, colours that are the object's anywhere in a frame.
        near: (bins,) bool, those that are the object's where it is known to be about.
        stands_out: whether `wide` finds it in its own examples.
    """

    def __init__(self, examples: Sequence[Example], elsewhere: Floats) -> None:
        inside = np.concatenate([example.frame[example.mask] for example in examples])
        around = np.concatenate([example.frame[~example.mask] for example in examples])
        self.examples = examples
        self.colours = _histogram(inside)
        area = np.mean([np.count_nonzero(e.mask) / e.size.prod() for e in examples])
        self.wide = self._where(elsewhere, float(area))
        surroundings = (1 - _ELSEWHERE) * _histogram(around) + _ELSEWHERE * elsewhere
        self.near = self._where(surroundings, len(inside) / (len(inside) + len(around)))
        found = [
            track(_opened(self.wide[_bins(e.frame)])[None], None, _WITHIN).masks[0]
            for e in examples
        ]
        own = [jaccard(m[None], e.mask[None])[0] for m, e in zip(found, examples, strict=True)]
        self.stands_out = bool(np.median(own) >= _MIN_COLOUR_JACCARD)

    def _where(self, others: Floats, share: float) -> BoolArray:
        """Return the colours more likely the object's, which has this share of the pixels."""
        likely = self.colours * share > others * (1 - share)
        return likely & (self.colours > _MIN_COLOUR_SHARE)


#: an object may fill the frame of an example
_WITHIN = TrackingConfig(max_area_share=1.0)


def _opened(pixels: BoolArray) -> BoolArray:
    """Return (H, W) without what is one pixel thin, and gaps of as much filled."""
    square = np.ones((2, 2), np.uint8)
    # MORPH_OPEN has one anchor for both steps, and so moves what it opens by a pixel
    opened = cv2.dilate(
        cv2.erode(pixels.astype(np.uint8), square, anchor=(0, 0)), square, anchor=(1, 1)
    )
    return np.asarray(cv2.morphologyEx(opened, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))) > 0


class ExampleSegmenter:
    """Finds objects that look like examples; names without examples by their colour words.

    Where no mask is given, an object that stands out is found by its colours, any other by an
    example's picture. From a mask on, it is where the mask was as long as the picture stays the
    same there, and else where its colours are, near where it was last.

    Args:
        examples: examples of the objects.
    """

    def __init__(self, examples: ObjectExamples) -> None:
        self.name = f'examples {examples.digest[:8]}'
        elsewhere = _histogram(examples.elsewhere)
        self._looks = {name: _Look(examples.of_name(name), elsewhere) for name in examples.names}
        self._words = ColourSegmenter()

    @property
    def stands_out(self) -> dict[str, bool]:
        """By name, whether an object is found by its colours alone."""
        return {name: look.stands_out for name, look in self._looks.items()}

    def segment(
        self,
        frames: ByteArray,
        names: tuple[str, ...],
        first_masks: BoolArray | None = None,
        first_frames: ByteArray | None = None,
    ) -> ObjectMasks:
        """See `Segmenter.segment`; masks without frames are those of `frames[:, 0]`."""
        check_request(frames, names, first_masks, first_frames)
        worded = self._words.segment(
            frames, tuple('' if n in self._looks else n for n in names), first_masks, first_frames
        )
        masks, status = np.array(worded.masks), [list(row) for row in worded.status]
        known = [i for i, name in enumerate(names) if name in self._looks]
        if not frames.shape[1]:
            return ObjectMasks(
                names=names, masks=masks, status=(('absent',) * len(names),) * len(frames)
            )
        # what stands out lies before what does not, where both might be
        known.sort(key=lambda i: not self._looks[names[i]].stands_out)
        for v, view in enumerate(frames):
            start = view[0] if first_frames is None else first_frames[v]
            taken = np.zeros(view.shape[:3], np.bool_)
            for i in known:
                first = None if first_masks is None else first_masks[v, i]
                rivals = [self._looks[names[j]] for j in known if j != i]
                found = _Follower(self._looks[names[i]], rivals).follow(view, taken, first, start)
                masks[v, i], status[v][i] = found
                taken |= found[0]
        return ObjectMasks(names=names, masks=masks, status=tuple(map(tuple, status)))


class _Follower:
    """Follows one object through the frames of a view.

    Args:
        look: look of the object.
        rivals: the looks of the others that are looked for.
    """

    def __init__(self, look: _Look, rivals: Sequence[_Look]) -> None:
        self.look = look
        own = np.ones(look.near.shape, np.bool_)
        for rival in rivals:
            own &= look.colours >= rival.colours
        self.wide, self.near = look.wide & own, look.near & own

    def follow(
        self, frames: ByteArray, taken: BoolArray, first: BoolArray | None, start: ByteArray
    ) -> tuple[BoolArray, str]:
        """Return masks (T, H, W) and a status.

        Args:
            frames: (T, H, W, 3) uint8 RGB.
            taken: (T, H, W) pixels of other objects.
            first: (H, W) mask in `start`; None or empty = not known.
            start: (H, W, 3) uint8 RGB.
        """
        masks = np.zeros(frames.shape[:3], np.bool_)
        begun = 0
        if first is None or not first.any():
            first, status = None, 'absent'
            for begun, frame in enumerate(frames):
                found, status = self._find(frame, taken[begun])
                if found.any():
                    masks[begun], first, start = found, found, frame
                    begun += 1
                    break
            if first is None or status != 'ok':
                return masks, status
        self._continue(frames[begun:], taken[begun:], first, start, masks[begun:])
        return masks, judge_tracks(masks, first, _TRACKING) if masks.any() else 'lost'

    def _find(self, frame: ByteArray, taken: BoolArray) -> tuple[BoolArray, str]:
        """Return the mask (H, W) in a frame without a previous mask, and a status."""
        if self.look.stands_out:
            pixels = _opened(self.wide[_bins(frame)] & ~taken)
            found = track(pixels[None], None, _TRACKING)
            return self._grown(frame, taken, found.masks[0]), found.status
        best, mask = 0.0, np.zeros(frame.shape[:2], np.bool_)
        for example in self.look.examples:
            picture, shape = example.patch(frame.shape[1], frame.shape[0])
            if picture.shape[0] > frame.shape[0] or picture.shape[1] > frame.shape[1]:
                continue
            scores = cv2.matchTemplate(frame, picture, cv2.TM_CCOEFF_NORMED)
            _, score, _, (x, y) = cv2.minMaxLoc(scores)
            if score > max(best, _MIN_CORRELATION):
                best, mask = score, np.zeros_like(mask)
                mask[y : y + shape.shape[0], x : x + shape.shape[1]] = shape
        return mask & ~taken, 'ok' if best else 'absent'

    def _grown(self, frame: ByteArray, taken: BoolArray, seed: BoolArray) -> BoolArray:
        """Return (H, W) a mask with the sides in the shade, which have no colour of its own.

        First those colours about it are added that are the object's where it is known to be, then
        it is cut out of a box around both, as examples are.
        """
        if not seed.any():
            return seed
        coloured = self.near[_bins(frame)] & ~taken & _around(seed, 0)
        grown = track(_opened(coloured | seed)[None], seed, _TRACKING).masks[0]
        if not grown.any():
            return seed
        if np.count_nonzero(grown) > _MAX_CUT_FRACTION * grown.size:
            return grown
        cut = cut_out(frame, _box_around(grown)) & ~taken
        return cut if jaccard(cut[None], grown[None])[0] >= _MIN_CUT_JACCARD else grown

    def _continue(
        self,
        frames: ByteArray,
        taken: BoolArray,
        first: BoolArray,
        start: ByteArray,
        masks: BoolArray,
    ) -> None:
        """Fill masks (T, H, W) of the frames after `start`."""
        lab = _lab(start)
        area = np.count_nonzero(first)
        by_colour = np.count_nonzero(first & self.near[_bins(start)]) > _MIN_COLOUR_FRACTION * area
        last, gap = first, 0
        for frame, others, mask in zip(frames, taken, masks, strict=True):
            found = first & (np.abs(_lab(frame) - lab) <= _MAX_RESTING_CHANGE).all(-1) & ~others
            if by_colour:
                coloured = self.near[_bins(frame)] & ~others
                pixels = _opened((coloured | found) & _around(last, gap))
                found = track(pixels[None], last, _TRACKING).masks[0]
            elif np.count_nonzero(found) < _MIN_UNCHANGED_FRACTION * area:
                found[...] = False
            gap = 0 if found.any() else gap + 1
            if not gap:
                mask[...], last = found, found


def cut_out(frame: ByteArray, box: Box) -> BoolArray:
    """Return the mask (H, W) of the object in a box, see `Example.in_box`."""
    found = Example.in_box('', frame, box)
    left, top, right, bottom = (round(edge) for edge in box)
    x, y = max(0, left - (right - left)), max(0, top - (bottom - top))
    mask = np.zeros(frame.shape[:2], np.bool_)
    mask[y : y + found.mask.shape[0], x : x + found.mask.shape[1]] = found.mask
    return mask


def _box_around(mask: BoolArray) -> Box:
    """Return the box of a mask (H, W), a little wider on all sides, within the frame."""
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    rows, columns = mask.shape
    margin = max(_MIN_MARGIN_PX, round(_MARGIN * columns))
    return (
        max(0, left - margin),
        max(0, top - margin),
        min(columns, left + width + margin),
        min(rows, top + height + margin),
    )


def _lab(frame: ByteArray) -> NDArray[np.int16]:
    return np.asarray(cv2.cvtColor(frame, cv2.COLOR_RGB2LAB), np.int16)


def _around(mask: BoolArray, gap: int) -> BoolArray:
    """Return (H, W) where an object may be that was last seen in a mask, `gap` + 1 frames ago."""
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    reach = round(_MAX_MOTION * hypot(*mask.shape) * (1 + gap))
    window = np.zeros_like(mask)
    window[
        max(0, top - reach) : top + height + reach, max(0, left - reach) : left + width + reach
    ] = True
    return window
