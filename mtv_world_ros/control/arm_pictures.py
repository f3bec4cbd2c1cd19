"""The arms as the start frame shows them, moved with their links to where they will be.

V views, T frames, J joints, H W pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.cameras.silhouettes import project_part
from mtv_world_ros.control.control import SeenFrame
from mtv_world_ros.core.data_types import BoolArray, ByteArray, CameraModel, FloatArray
from mtv_world_ros.robot.shape import LinkShape

#: RGB of a robot that the start frame does not show
_GREY = 128
#: points further than this many image sizes from its middle say nothing of a link's motion
_FARTHEST = 4.0
#: of the silhouettes whose pixels are moved
_FRINGE = np.ones((3, 3), np.uint8)
#: a real frame that shows more of a link than this share of what an imagined frame shows of it
#: gives its pixels
_SHARP_SHARE = 0.4
#: least number of points that an affine map is fitted to
_LEAST_POINTS = 3
#: fractional bits of pixel positions
_SHIFT = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class _Source:
    """A frame of one view that shows the robot.

    Attributes:
        frame: (H, W, 3) uint8 RGB.
        seen: (H, W) 1 + the number of the link that is seen in each pixel, 0 = none.
        pixels: (N, 2) pixels of the points of each of P parts.
    """

    frame: ByteArray
    seen: NDArray[np.uint8]
    pixels: Sequence[FloatArray]

    def shows(self, link: int) -> int:
        """Return the number of pixels that show a link."""
        return int(np.count_nonzero(self.seen == link + 1))


def arm_pictures(
    parts: Sequence[LinkShape],
    motion: Motion,
    start_frame: ByteArray,
    seen_frame: SeenFrame | None = None,
) -> ByteArray | None:
    """Return the robot alone, (V, T, H, W, 4) uint8 RGB and cover; None without parts.

    The silhouette of each link has the start frame's pixels of that link, moved by the affine map
    that fits its projected points best; where these were hidden or outside the image it has their
    mean colour, or that of the whole robot. Near parts cover far ones, by the depths of their
    centres.

    Args:
        parts: convex parts of the robot's links.
        motion: T states of the robot with the parts' links, row 0 at the start frame; V cameras
            at the frames' size.
        start_frame: (V, H, W, 3) uint8 RGB.
        seen_frame: a real frame of the rollout whose start frame is imagined: a link that it shows
            well has its pixels, which stay sharp from chunk to chunk.
    """
    if not parts:
        return None
    links = list(dict.fromkeys(part.link for part in parts))
    numbers = np.array([links.index(part.link) for part in parts])
    poses, cameras = motion.links, motion.cameras
    size = (len(motion.positions), cameras[0].height, cameras[0].width, 4)
    shown = np.zeros((len(cameras), *size), np.uint8)
    for view, (pictures, camera, T_base_camera, frame) in enumerate(
        zip(shown, cameras, motion.camera_poses, start_frame, strict=True)
    ):
        pixels = [project_part(part, poses[part.link], camera, T_base_camera) for part in parts]
        depths = _depths(parts, poses, camera, T_base_camera)
        seen = _seen_links(pixels, depths, numbers, camera)
        now = _Source(frame=frame, seen=seen[0], pixels=[points[0] for points in pixels])
        real = None if seen_frame is None else _real_source(parts, numbers, seen_frame, view)
        whole = _mean_colour(frame, now.seen > 0, np.full(3, _GREY))
        for number in range(len(links)):
            mine = np.flatnonzero(numbers == number).tolist()
            source = now
            if real is not None and real.shows(number) > _SHARP_SHARE * now.shows(number):
                source = real
            _draw_link(
                pictures,
                seen == number + 1,
                np.concatenate([pixels[at] for at in mine], axis=1),
                source.frame,
                source.seen == number + 1,
                np.concatenate([source.pixels[at] for at in mine]),
                whole,
            )
    return shown


def _real_source(
    parts: Sequence[LinkShape], numbers: NDArray[np.int_], seen_frame: SeenFrame, view: int
) -> _Source:
    """Return the robot as a real frame shows it in one view."""
    motion = seen_frame.motion
    camera, T_base_camera = motion.cameras[view], motion.camera_poses[view]
    pixels = [project_part(p, motion.links[p.link], camera, T_base_camera) for p in parts]
    depths = _depths(parts, motion.links, camera, T_base_camera)
    return _Source(
        frame=seen_frame.frames[view],
        seen=_seen_links(pixels, depths, numbers, camera)[0],
        pixels=[points[0] for points in pixels],
    )


def _depths(
    parts: Sequence[LinkShape],
    poses: Mapping[str, FloatArray],
    camera: CameraModel,
    T_base_camera: FloatArray,
) -> FloatArray:
    """Return the depths (P, T) of the parts' centres [m]."""
    middles = [np.append(part.points.mean(axis=0), 1.0) for part in parts]
    centres = [poses[p.link][:, :3] @ middle for p, middle in zip(parts, middles, strict=True)]
    return project(camera, T_base_camera, np.stack(centres))[1]


def _seen_links(
    pixels: Sequence[FloatArray],
    depths: FloatArray,
    numbers: NDArray[np.int_],
    camera: CameraModel,
) -> NDArray[np.uint8]:
    """Return (T, H, W) 1 + the number of the link that is seen in each pixel, 0 = none.

    Args:
        pixels: pixels of each of P parts (T, N, 2), whose convex hull is its silhouette.
        depths: (P, T) depths of the parts [m].
        numbers: (P,) numbers of their links.
        camera: the view.
    """
    images = np.zeros((depths.shape[1], camera.height, camera.width), np.uint8)
    limits = 10 * _FARTHEST * np.array([camera.width, camera.height])
    for frame, image in enumerate(images):
        for at in np.argsort(-depths[:, frame], kind='stable'):
            outline = pixels[at][frame]
            if depths[at, frame] > 0 and np.isfinite(outline).all():
                fixed = np.rint(outline.clip(-limits, limits) * 2**_SHIFT).astype(np.int32)
                colour = int(numbers[at]) + 1
                cv2.fillConvexPoly(image, cv2.convexHull(fixed), colour, shift=_SHIFT)
    return images


def _draw_link(
    pictures: ByteArray,
    seen: BoolArray,
    points: FloatArray,
    source_frame: ByteArray,
    was_seen: BoolArray,
    was_at: FloatArray,
    hidden: NDArray[np.int_],
) -> None:
    """Draw a link into pictures (T, H, W, 4) where it is seen (T, H, W).

    Args:
        pictures: (T, H, W, 4) uint8 pictures that are drawn upon.
        seen: (T, H, W) pixels in which the link is not hidden.
        points: (T, N, 2) pixels of points on it, NaN behind the camera.
        source_frame: (H, W, 3) uint8 RGB frame that its pixels are taken from.
        was_seen: (H, W) pixels of the source frame that show the link.
        was_at: (N, 2) pixels of the points in that frame.
        hidden: (3,) colour of the link where the source frame shows nothing of it.
    """
    colour = (*_mean_colour(source_frame, was_seen, hidden), 255)
    size = np.array(seen.shape[:0:-1])
    with np.errstate(invalid='ignore'):  # NaN
        near: BoolArray = np.asarray((np.abs(points - size / 2) < _FARTHEST * size).all(axis=-1))
        was_near = (np.abs(was_at - size / 2) < _FARTHEST * size).all(axis=-1)
    # a pixel more than the silhouette, so that no seams show
    was = np.asarray(cv2.dilate(was_seen.astype(np.uint8), _FRINGE), np.uint8)
    for picture, now, ends, known in zip(pictures, seen, points, near, strict=True):
        left, top, width, height = cv2.boundingRect(now.astype(np.uint8))
        box = np.s_[top : top + height, left : left + width]
        picture[box][now[box]] = colour
        common = known & was_near
        if width and common.sum() >= _LEAST_POINTS:
            affine = _affine(ends[common] - (left, top), was_at[common])
            moved = _warped(source_frame, affine, (width, height), cv2.INTER_LINEAR)
            shown = now[box] & (_warped(was, affine, (width, height), cv2.INTER_NEAREST) > 0)
            picture[box][shown, :3] = moved[shown]


def _mean_colour(
    frame: ByteArray, where: BoolArray, otherwise: NDArray[np.int_]
) -> NDArray[np.int_]:
    return np.rint(frame[where].mean(axis=0)).astype(int) if where.any() else otherwise


def _affine(points: FloatArray, others: FloatArray) -> FloatArray:
    """Return (2, 3) the affine map that takes points (N, 2) to others best."""
    whole = np.column_stack([points, np.ones(len(points))])
    return np.asarray(np.linalg.lstsq(whole, others, rcond=None)[0].T, np.float64)


def _warped(image: ByteArray, affine: FloatArray, size: tuple[int, int], how: int) -> ByteArray:
    """Return the image at the pixels to which an affine map takes those of (width, height)."""
    flags = how | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(image, affine, size, flags=flags), np.uint8)
