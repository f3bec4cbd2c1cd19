"""Glowing trails of points: Gaussian stamps that fade with age.

N points, H W pixels. A box is (top, bottom, left, right), bottom and right excluded.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.core.data_types import FloatArray

#: a stamp ends where its Gaussian falls below one grey level: exp(-3.4^2 / 2) < 1 / 255
REACH_SIGMAS = 3.4
#: a point is dropped once it is this much fainter than when new (below one grey level)
FAINTEST = 1 / 512
#: pixels are limited to this before they become integers; far outside any image [px]
_FAR_PX = 1e6

GlowArray = NDArray[np.float32]
Box = tuple[int, int, int, int]
NO_BOX: Box = (0, 0, 0, 0)


def is_empty(box: Box) -> bool:
    """Return True if the box contains no pixel."""
    return box[0] >= box[1] or box[2] >= box[3]


def union(a: Box, b: Box) -> Box:
    """Return the smallest box that contains both; an empty box is ignored."""
    if is_empty(a):
        return b
    if is_empty(b):
        return a
    return min(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), max(a[3], b[3])


def intersection(a: Box, b: Box) -> Box:
    """Return the box that both contain; without overlap an empty one."""
    return max(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), min(a[3], b[3])


def region(image: np.ndarray, box: Box) -> np.ndarray:
    """Return the view of an (H, W, ...) array inside a box."""
    return image[box[0] : box[1], box[2] : box[3]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Stamps:
    """N round Gaussians, sub-pixel exact, clipped to the image.

    Attributes:
        boxes: N boxes inside the image; empty if not in sight.
        across: (N, S) profile along x; column j is the pixel `origins[n][0] + j`.
        down: (N, S) profile along y; column j is the pixel `origins[n][1] + j`.
        origins: N pixels (x, y) where the profiles begin, may lie outside the image.
    """

    boxes: list[Box]
    across: GlowArray
    down: GlowArray
    origins: list[tuple[int, int]]

    def glows(
        self, numbers: NDArray[np.intp], brightness: FloatArray
    ) -> Iterator[tuple[Box, GlowArray]]:
        """Yield box and (h, w) glow inside it of stamps, each with its brightness."""
        dimmed = self.down[numbers] * brightness.astype(np.float32)[:, None]
        for n, down in zip(numbers.tolist(), dimmed, strict=True):
            box = top, bottom, left, right = self.boxes[n]
            x, y = self.origins[n]
            across = self.across[n, left - x : right - x]
            yield box, np.multiply.outer(down[top - y : bottom - y], across)


def make_stamps(pixels: FloatArray, sigmas: FloatArray, width: int, height: int) -> Stamps:
    """Return the stamps of (N, 2) pixels with (N,) standard deviations [px].

    Points with NaN pixels (behind the camera) get an empty box. A stamp whose centre is outside
    the image keeps the part that is inside.
    """
    seen = np.isfinite(pixels[:, 0] + pixels[:, 1])
    centres = np.where(seen[:, None], pixels, 0.0).clip(-_FAR_PX, _FAR_PX)
    sigmas = np.where(seen, sigmas, 1.0)
    reach = REACH_SIGMAS * sigmas[:, None]
    first = np.ceil(centres - reach).astype(np.int64)
    after = np.floor(centres + reach).astype(np.int64) + 1
    size = int((after - first).max(initial=0))
    steps = first[:, :, None] + np.arange(size) - centres[:, :, None]
    profiles = np.exp(-0.5 * (steps / sigmas[:, None, None]) ** 2).astype(np.float32)
    left, top = first.clip(0, (width, height)).T
    right, bottom = after.clip(0, (width, height)).T
    bottom = np.where(seen, bottom, top)
    return Stamps(
        boxes=list(zip(*(edge.tolist() for edge in (top, bottom, left, right)), strict=True)),
        across=profiles[:, 0],
        down=profiles[:, 1],
        origins=[(x, y) for x, y in first.tolist()],
    )


class Trail:
    """The fading trail of one arm on an (H, W) float image, 1 = full brightness.

    Each pixel holds its brightest point: how bright it is says how long ago the arm was there,
    whatever the frame rate, and an arm at rest does not burn in. Everything outside `box` is 0.
    """

    def __init__(self, width: int, height: int, half_life_s: float) -> None:
        self.image: GlowArray = np.zeros((height, width), np.float32)
        self.box = NO_BOX
        self._half_life_s = half_life_s

    def fade(self, seconds: float) -> None:
        """Let time pass."""
        region(self.image, self.box)[...] *= np.float32(0.5 ** (seconds / self._half_life_s))

    def clear(self) -> None:
        """Forget all points."""
        region(self.image, self.box)[...] = 0
        self.box = NO_BOX

    def brightness(self, ages_s: FloatArray) -> FloatArray:
        """Return how bright points of (N,) ages are; 0 where that is below one grey level."""
        brightness = 0.5 ** (ages_s / self._half_life_s)
        return np.where(brightness >= FAINTEST, brightness, 0.0)

    def add(self, glows: Iterable[tuple[Box, GlowArray]]) -> None:
        """Add points; each is a box of the image with its glow (h, w)."""
        for box, glow in glows:
            if not is_empty(box):
                part = region(self.image, box)
                cv2.max(part, glow, part)
                self.box = union(self.box, box)
