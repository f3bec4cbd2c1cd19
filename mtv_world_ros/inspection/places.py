"""Places of a fixed camera in several recordings, from their backgrounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.core.data_types import ByteArray, FloatArray
from mtv_world_ros.data.episode import Track

#: number of frames whose median is the background
_NUM_FRAMES = 21
#: width to which a background is resized before it is matched [px]
_WIDTH_PX = 640
#: maximum number of features of a background
_MAX_FEATURES = 1500
#: minimum number of matches of two backgrounds that are comparable
_MIN_MATCHES = 12
#: inlier threshold of a match against the homography of all matches [px at the width above]
_INLIER_PX = 3.0
#: background shift above which two camera places differ [fraction of image width]
SAME_PLACE = 0.004


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraPlaces:
    """Places of one camera.

    Attributes:
        place: (R,) number of the place of each recording, from 0 in the order of recordings.
        apart: (R, R) median shift of the background between two recordings [share of the image
            width]; infinite where the backgrounds have nothing in common.
        matches: matches of two recordings, matched points (M, 2, 2) [share of the image width],
            from the middle of the image.
    """

    place: NDArray[np.int64]
    apart: FloatArray
    matches: dict[tuple[int, int], FloatArray]

    def near(self, within: float) -> list[int]:
        """Return the largest group of recordings within a shift of one recording, that one first.

        Args:
            within: maximum shift of the background [fraction of image width].
        """
        counts = (self.apart < within).sum(axis=1)
        medoid = int(counts.argmax())
        return [int(n) for n in np.argsort(self.apart[medoid]) if self.apart[medoid, n] < within]


def background(track: Track) -> ByteArray:
    """Return the median (H, W, 3) of a recording: the scene without moving objects."""
    count = len(track.stamps_ns)
    chosen = np.unique(np.linspace(0, count - 1, _NUM_FRAMES).astype(int))
    frames = np.stack([np.asarray(track.frames[int(n)]) for n in chosen])
    return np.median(frames, axis=0).astype(np.uint8)


def keeps_place(track: Track) -> bool:
    """Return True if both halves of a recording have the same background: the camera is still."""
    half = len(track.stamps_ns) // 2
    parts = (slice(0, half), slice(half, None))
    halves = [
        Track(track.stamps_ns[part], track.frames[part])  # type: ignore[arg-type]
        for part in parts
    ]
    return half > 1 and find_places([background(part) for part in halves]).place.max() == 0


def find_places(backgrounds: Sequence[ByteArray]) -> CameraPlaces:
    """Group recordings whose backgrounds lie at the same pixels.

    A moved camera shifts all of the background; a moved object only a part, which the homography
    of the rest leaves out.
    """
    sift = cv2.SIFT_create(_MAX_FEATURES, contrastThreshold=0.01)  # type: ignore[attr-defined]
    corners = [_corners(sift, image) for image in backgrounds]
    count = len(backgrounds)
    apart = np.full((count, count), np.inf)
    np.fill_diagonal(apart, 0)
    matches = {}
    for a in range(count):
        for b in range(a + 1, count):
            pairs = _matched(corners[a], corners[b])
            if len(pairs) >= _MIN_MATCHES:
                matches[a, b] = pairs
                shift = np.linalg.norm(pairs[:, 0] - pairs[:, 1], axis=1)
                apart[a, b] = apart[b, a] = float(np.median(shift))
    return CameraPlaces(place=_groups(apart < SAME_PLACE), apart=apart, matches=matches)


def turn_between(pairs: FloatArray, focal: float) -> FloatArray:
    """Return the rotation (3, 3) from rays of the first picture to rays of the second.

    Args:
        pairs: matched points (M, 2, 2), see `CameraPlaces`.
        focal: focal length [share of the image width].
    """
    rays = np.concatenate([pairs, np.full((*pairs.shape[:2], 1), focal)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    u, _, vt = np.linalg.svd(np.einsum('mi,mj->ij', rays[:, 1], rays[:, 0]))
    return np.asarray(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, np.float64)


def _corners(sift: cv2.Feature2D, image: ByteArray) -> tuple[FloatArray, NDArray[np.float32]]:
    """Return the places (N, 2) [share of the width, from the middle] and descriptors."""
    height, width = image.shape[:2]
    size = _WIDTH_PX, round(height * _WIDTH_PX / width)
    grey = cv2.cvtColor(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), cv2.COLOR_RGB2GRAY)
    found, described = sift.detectAndCompute(grey, None)
    if described is None:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    points = np.array([point.pt for point in found], np.float64)
    return (points - (np.array(size) - 1) / 2) / _WIDTH_PX, np.asarray(described, np.float32)


def _matched(
    a: tuple[FloatArray, NDArray[np.float32]], b: tuple[FloatArray, NDArray[np.float32]]
) -> FloatArray:
    """Return (M, 2, 2) points of both backgrounds that move together."""
    none = np.zeros((0, 2, 2))
    if min(len(a[0]), len(b[0])) < _MIN_MATCHES:
        return none
    found = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(a[1], b[1])
    if len(found) < _MIN_MATCHES:
        return none
    pairs = np.array([[a[0][m.queryIdx], b[0][m.trainIdx]] for m in found])
    H, inside = cv2.findHomography(
        pairs[:, 0] * _WIDTH_PX, pairs[:, 1] * _WIDTH_PX, cv2.RANSAC, _INLIER_PX
    )
    return none if H is None else pairs[inside.ravel() > 0]


def _groups(same: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return (R,) numbers of the connected groups."""
    place = np.full(len(same), -1)
    for first in range(len(same)):
        if place[first] >= 0:
            continue
        number, waiting = place.max() + 1, [first]
        while waiting:
            at = waiting.pop()
            if place[at] < 0:
                place[at] = number
                waiting += np.flatnonzero(same[at]).tolist()
    return place.astype(np.int64)
