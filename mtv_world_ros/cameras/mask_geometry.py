"""Positions and sizes of objects in space, from their masks in views; counting of reversals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mtv_world_ros.cameras.camera import project, triangulate, unproject
from mtv_world_ros.core.data_types import BoolArray, CameraModel, FloatArray

#: error of the centroid of a small mask [px]
CENTROID_NOISE_PX = 0.3
#: smallest height of an object that masks show, as of a plate seen from above [m]
MIN_HEIGHT_M = 0.005
#: ridge on the lean that no view determines, as a squared share of a view that shows it fully
_RIDGE = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Location:
    """A triangulated centroid.

    Attributes:
        point: (3,) point in the base frame [m].
        residual_px: distance of the views' rays where they pass each other, in pixels.
        sigma_m: position error that the centroid's error and the stated error of the cameras, or
            the larger residual, cause [m].
        pixel_m: mean width of a pixel at the point [m].
    """

    point: FloatArray
    residual_px: float
    sigma_m: float
    pixel_m: float = float('nan')


def centroids(masks: BoolArray) -> FloatArray:
    """Return the (..., 2) mean x, y of masks (..., H, W) [px], NaN where empty."""
    centres = np.full((*masks.shape[:-2], 2), np.nan)
    for index in np.ndindex(masks.shape[:-2]):
        left, top, width, height = cv2.boundingRect(masks[index].view(np.uint8))
        inside = masks[index][top : top + height, left : left + width]
        if inside.size:
            by_row, by_column = inside.sum(1), inside.sum(0)
            x = by_column @ np.arange(left, left + width)
            y = by_row @ np.arange(top, top + height)
            centres[index] = np.array([x, y]) / by_row.sum()
    return centres


def locate(
    cameras: Sequence[CameraModel], T_base_camera: Sequence[FloatArray], pixels: FloatArray
) -> Location | None:
    """Triangulate one point from (V, 2) pixels; views with NaN are ignored.

    Returns None if fewer than two views see the point; NaN if all see it along one ray.
    """
    seen = [view for view in range(len(cameras)) if np.isfinite(pixels[view]).all()]
    if len(seen) < 2:
        return None
    used = [cameras[view] for view in seen]
    poses = [T_base_camera[view] for view in seen]
    point, residual = triangulate(used, poses, pixels[seen])
    # rays that meet show errors across one plane alone: the stated error counts all the same
    noise = [
        max(residual, float(np.hypot(CENTROID_NOISE_PX, camera.error_px or 0.0)))
        for camera in used
    ]
    metres = [
        _depth(pose, point) / camera.K[0, 0] for camera, pose in zip(used, poses, strict=True)
    ]
    return Location(
        point=point,
        residual_px=residual,
        sigma_m=float(np.mean(np.multiply(noise, metres))),
        pixel_m=float(np.mean(metres)),
    )


def locate_all(
    cameras: Sequence[CameraModel], T_base_camera: Sequence[FloatArray], pixels: FloatArray
) -> FloatArray:
    """Return the (O, 3) points of (V, O, 2) pixels [m]; NaN if fewer than two views see one."""
    found = [locate(cameras, T_base_camera, pixels[:, item]) for item in range(pixels.shape[1])]
    points = [np.full(3, np.nan) if one is None else one.point for one in found]
    return np.array(points).reshape(-1, 3)


def block_size(
    cameras: Sequence[CameraModel],
    T_base_camera: Sequence[FloatArray],
    areas: FloatArray,
    point: FloatArray,
) -> float:
    """Return the edge of an upright cube from its (V,) mask areas [px]; the median of the views.

    A cube seen at elevation e shows edge^2 * (sin e + 4/pi * cos e), averaged over its yaw.
    """
    sizes = []
    for camera, pose, area in zip(cameras, T_base_camera, areas, strict=True):
        if not area > 0:
            continue
        ray = pose[:3, 3] - point
        up = abs(ray[2]) / np.linalg.norm(ray)
        shown = up + 4 / np.pi * np.sqrt(1 - up**2)
        pixels_per_metre2 = camera.K[0, 0] * camera.K[1, 1] / _depth(pose, point) ** 2
        sizes.append(np.sqrt(area / pixels_per_metre2 / shown))
    return float(np.median(sizes)) if sizes else float('nan')


def upright_extents(
    cameras: Sequence[CameraModel],
    T_base_camera: Sequence[FloatArray],
    masks: BoolArray,
    point: FloatArray,
) -> tuple[float, float]:
    """Return the mean width and the height of an upright object [m]; NaN if no view shows it.

    A view at elevation e shows an extent of `height * cos e + depth * sin e` along the image's
    vertical. The depth along the line of sight is taken to be the mean width of the views.

    Args:
        cameras: cameras of the V views.
        T_base_camera: pose of each camera, (4, 4) [m].
        masks: masks of the object in each view, (V, H, W); empty = not seen.
        point: (3,) centre of the object [m].
    """
    shown = []
    for camera, pose, mask in zip(cameras, T_base_camera, masks, strict=True):
        if not mask.any():
            continue
        wide, high = _largest_box(mask)
        depth, ray = _depth(pose, point), pose[:3, 3] - point
        sine = abs(ray[2]) / np.linalg.norm(ray)
        shown.append((wide * depth / camera.K[0, 0], high * depth / camera.K[1, 1], sine))
    if not shown:
        return float('nan'), float('nan')
    widths, heights, sines = np.array(shown).T
    width = float(widths.mean())
    cosines = np.sqrt(1 - sines**2)  # a view from above shows no height
    height = cosines @ (heights - width * sines) / max(float(cosines @ cosines), 1e-6)
    return width, max(float(height), MIN_HEIGHT_M)


def _largest_box(mask: BoolArray) -> tuple[int, int]:
    """Return the width and height of the box around the largest connected part of a mask [px]."""
    stats = np.asarray(cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=8)[2])
    largest = stats[1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))]
    return int(largest[cv2.CC_STAT_WIDTH]), int(largest[cv2.CC_STAT_HEIGHT])


def axis_lean(
    cameras: Sequence[CameraModel], T_base_camera: Sequence[FloatArray], masks: Sequence[BoolArray]
) -> FloatArray:
    """Return the horizontal part (2,) of the unit vector along an object's long axis, upwards.

    A mask's long axis and the camera span a plane that the axis lies in. Its lean is the least one
    that fits the planes of all views; a round mask determines none.

    Args:
        cameras: cameras of the V views.
        T_base_camera: pose of each camera, (4, 4) [m].
        masks: masks of the object in each view, (H, W), not empty.
    """
    planes = np.array([_plane(*view) for view in zip(cameras, T_base_camera, masks, strict=True)])
    level, up = planes[:, :2], planes[:, 2]
    slope = np.linalg.solve(level.T @ level + _RIDGE * np.eye(2), -level.T @ up)
    return np.asarray(slope / np.hypot(1.0, np.linalg.norm(slope)))


def _plane(camera: CameraModel, T_base_camera: FloatArray, mask: BoolArray) -> FloatArray:
    """Return the normal (3,) of the plane through the camera and the long axis.

    Longer for long masks.
    """
    moments = cv2.moments(mask.view(np.uint8), binaryImage=True)
    centre = np.array([moments['m10'], moments['m01']]) / moments['m00']
    wide, slanted = moments['mu20'] - moments['mu02'], 2 * moments['mu11']
    angle = 0.5 * np.arctan2(slanted, wide)
    # two pixels of the axis as rays, which lenses do not bend
    ends = centre + np.outer([-2.0, 2.0], [np.cos(angle), np.sin(angle)])
    normal = np.cross(*(unproject(camera, ends) @ T_base_camera[:3, :3].T))
    length = np.hypot(wide, slanted) / max(moments['mu20'] + moments['mu02'], 1e-9)
    return np.asarray(normal / np.linalg.norm(normal) * length)


def moved_mask(
    mask: BoolArray,
    camera: CameraModel,
    T_base_camera: FloatArray,
    start: FloatArray,
    goal: FloatArray,
) -> BoolArray:
    """Return the (H, W) mask of an object after it moved from `start` to `goal` [m].

    The mask is shifted by the projected displacement and scaled by the ratio of depths.
    """
    pixels, depth = project(camera, T_base_camera, np.stack([start, goal]))
    if not np.isfinite(pixels).all():
        return np.zeros_like(mask)
    zoom = depth[0] / depth[1]
    shift = pixels[1] - zoom * pixels[0]
    affine = np.array([[zoom, 0, shift[0]], [0, zoom, shift[1]]], np.float64)
    moved = cv2.warpAffine(
        mask.astype(np.float32), affine, mask.shape[::-1], flags=cv2.INTER_LINEAR
    )
    return np.asarray(moved >= 0.5)


def _depth(T_base_camera: FloatArray, point: FloatArray) -> float:
    """Return the distance along the optical axis [m]."""
    return float(T_base_camera[:3, 2] @ (point - T_base_camera[:3, 3]))


def widest_swing(leans: FloatArray) -> FloatArray:
    """Return (T,) the leans (T, 2) along the direction in which they differ most."""
    return np.asarray(leans @ np.linalg.svd(leans - leans.mean(0))[2][0])


def count_reversals(angles: FloatArray, swing: float) -> FloatArray:
    """Return the cumulative number (T,) of reversals of an angle, each by more than `swing`.

    Args:
        angles: (T,) angles without jumps of whole turns [rad].
        swing: smaller turns are noise [rad].
    """
    counts, count, heading = np.zeros(len(angles)), 0, 0
    extreme = angles[0] if len(angles) else 0.0
    for k, angle in enumerate(angles):
        if heading == 0:
            if abs(angle - extreme) > swing:
                heading, extreme = int(np.sign(angle - extreme)), angle
        elif heading * (angle - extreme) > 0:
            extreme = angle
        elif heading * (extreme - angle) > swing:
            count, heading, extreme = count + 1, -heading, angle
        counts[k] = count
    return counts
