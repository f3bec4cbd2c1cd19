"""Intrinsics of the images that a driver sends: region of interest, binning, resizing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import CalibrationError

#: sizes that were rounded differ from exact ones by less [px]
_ROUNDING_PX = 1.0
#: largest offset of a principal point from the middle of its own image [fraction of its size]
MAX_CENTRE_OFFSET = 0.12
#: offset from the middle beyond which a principal point is of another image [fraction of its size]
MIN_FOREIGN_OFFSET = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageWindow:
    """Region of interest and binning of a CameraInfo.

    Attributes:
        x, y: left and top edge of the region of interest, in full resolution [px].
        width, height: size of the region in full resolution [px]; 0 = the whole image.
        binning_x, binning_y: pixels that are combined into one; 0 and 1 = none.
    """

    x: int = 0
    y: int = 0
    width: int = 0
    height: int = 0
    binning_x: int = 0
    binning_y: int = 0

    @property
    def binning(self) -> tuple[int, int]:
        """Pixels that are combined into one, at least 1 each."""
        return max(self.binning_x, 1), max(self.binning_y, 1)

    def of(self, width: int, height: int) -> tuple[int, int]:
        """Return width and height of the images that this window of a size gives [px]."""
        whole = (self.width or width, self.height or height)
        return whole[0] // self.binning[0], whole[1] // self.binning[1]

    def __str__(self) -> str:
        roi = f'roi {self.width}x{self.height} at ({self.x}, {self.y})' if self.width else 'no roi'
        return f'{roi}, binning {self.binning[0]}x{self.binning[1]}'


WHOLE = ImageWindow()


def window_of(info: Any) -> ImageWindow:
    """Return the window of a sensor_msgs/CameraInfo, whichever library made the object."""
    roi = info.roi
    return ImageWindow(
        x=int(roi.x_offset),
        y=int(roi.y_offset),
        width=int(roi.width),
        height=int(roi.height),
        binning_x=int(info.binning_x),
        binning_y=int(info.binning_y),
    )


def windowed_camera(
    camera: CameraModel, width: int, height: int, window: ImageWindow = WHOLE
) -> tuple[CameraModel, str]:
    """Return the calibrated camera for images of a size [px], and the assumptions made.

    See `windowed_pixels`.

    Raises:
        CalibrationError: images of this size are not explained.
    """
    to_image, note = windowed_pixels(camera, width, height, window)
    if np.array_equal(to_image, np.eye(3)):
        return camera, note
    return replace(camera, width=width, height=height, K=to_image @ camera.K), note


def windowed_pixels(
    camera: CameraModel, width: int, height: int, window: ImageWindow = WHOLE
) -> tuple[FloatArray, str]:
    """Return the map (3, 3) from calibrated pixels to those of images of a size, and a note.

    The note says what the camera's description leaves open and how it is taken; empty = nothing.

    By the words of sensor_msgs/CameraInfo: K, P, width and height are of the full resolution,
    `roi` is a part of it in unbinned pixels, and binned images have floor(size / binning) pixels.
    What these do not explain is taken as resized if it has the same aspect, and said.

    Raises:
        CalibrationError: the window is not within the calibrated image, K is of another image than
            width and height say, or the images are of neither size nor aspect of the window.
    """
    _check_window(camera, window)
    size, full, sent = (
        (width, height),
        (camera.width, camera.height),
        window.of(camera.width, camera.height),
    )
    apart = np.abs(np.subtract(size, sent)).max()
    if size == sent or apart <= _ROUNDING_PX and max(window.binning) > 1:
        _check_K(camera, window, size)
        return _shift(window) if window != WHOLE else np.eye(3), ''
    if size == full:
        note = (
            f"view '{camera.view}': its camera_info has {window}, that is images of "
            f'{sent[0]}x{sent[1]}; they are of {width}x{height}, the whole size: taken as whole '
            'images, which its K is for'
        )
        return np.eye(3), note
    if not _has_aspect(size, sent) or window != WHOLE and size > sent:
        is_turned = _has_aspect((height, width), sent)
        turned = (
            ' They seem to be turned by 90 degrees: switch that off in the driver, or calibrate '
            'the turned images.'
        )
        raise CalibrationError(
            f"view '{camera.view}' has images of {width}x{height}, but a camera_info or "
            f'calibration for {full[0]}x{full[1]} with {window}, that is images of '
            f'{sent[0]}x{sent[1]}; no resizing keeps that aspect.{turned if is_turned else ""} '
            'Where they are a part of the image, say which in roi of camera_info; else publish '
            'the camera_info of these images'
        )
    scale = np.array([width / sent[0], height / sent[1]])
    resized = np.diag([*scale, 1.0])
    resized[:2, 2] = (scale - 1) / 2
    note = (
        f"view '{camera.view}': images of {width}x{height}, camera_info or calibration for "
        f'{sent[0]}x{sent[1]}: taken as resized, focal lengths times {scale[0]:.4g}'
    )
    return resized @ _shift(window), note


def _shift(window: ImageWindow) -> FloatArray:
    """Cut the region out and bins it; pixel centres are at integers."""
    moved = np.eye(3)
    for axis, (start, binning) in enumerate(
        zip((window.x, window.y), window.binning, strict=True)
    ):
        moved[axis, axis] = 1 / binning
        moved[axis, 2] = (0.5 - start) / binning - 0.5
    return moved


def _has_aspect(size: tuple[int, int], sent: tuple[int, int]) -> bool:
    """Return whether two sizes differ by one factor and rounding."""
    error = abs(size[0] * sent[1] - size[1] * sent[0])
    return error <= _ROUNDING_PX * max(*sent, *size)


def _check_window(camera: CameraModel, window: ImageWindow) -> None:
    end = (window.x + window.width, window.y + window.height)
    if (
        end[0] > camera.width
        or end[1] > camera.height
        or bool(window.width) != bool(window.height)
    ):
        raise CalibrationError(
            f"camera_info of view '{camera.view}' contradicts itself: {window} in an image of "
            f'{camera.width}x{camera.height}; width, height and K must be those of the full '
            'resolution, which roi is a part of'
        )


def _check_K(camera: CameraModel, window: ImageWindow, size: tuple[int, int]) -> None:
    """Refuse a K that is of the window already, by where its principal point is."""
    centre = camera.K[:2, 2]
    sent, full = np.array(size), np.array([camera.width, camera.height])
    near = np.abs(centre - (sent - 1) / 2) <= MAX_CENTRE_OFFSET * sent
    off = np.abs(centre - (full - 1) / 2) > MIN_FOREIGN_OFFSET * full
    if window != WHOLE and tuple(sent) != tuple(full) and near.all() and off.all():
        raise CalibrationError(
            f"camera_info of view '{camera.view}' contradicts itself: cx, cy = "
            f'{centre.round(1).tolist()} is the middle of images of {size[0]}x{size[1]}, so K '
            f'seems to be theirs already, but width and height are {full[0]}x{full[1]} with '
            f'{window}; either K must be of the full resolution, or width and height those of the '
            'images, and roi and binning 0'
        )
