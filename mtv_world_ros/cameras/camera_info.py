"""Intrinsics of a sensor_msgs/CameraInfo by its definition, for recordings and the live node.

By the comments of the message: K[0] = 0 says that the camera is not calibrated, P is the matrix
of rectified images, and K, P, width and height are of the full resolution.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mtv_world_ros.cameras.camera import with_camera_info
from mtv_world_ros.cameras.image_window import ImageWindow, window_of
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import CalibrationError

#: words of topic names of rectified images, as image_proc and drivers have them
_RECTIFIED = {'rect', 'rectified'}


def is_rectified(topic: str) -> bool:
    """Return True if the name of an image topic says that its images are rectified.

    The word is that of the topic (`image_rect_color`), or of a part before it (`left/rect/image`,
    `front_rect/image_raw`).
    """
    words = topic.lower().replace('_', '/').split('/')
    return not _RECTIFIED.isdisjoint(words)


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Intrinsics that a CameraInfo gives of a view's images.

    Attributes:
        width: width of the full resolution [px]; 0 = not given, then it is that of the images.
        height: height of the full resolution [px]; 0 = not given.
        matrix: the nine entries of K, or of rectified images those of P's left part [px].
        distortion_model: distortion model as in the message.
        distortion: coefficients of the distortion model.
        window: region of interest and binning.
    """

    width: int
    height: int
    matrix: tuple[float, ...]
    distortion_model: str
    distortion: tuple[float, ...]
    window: ImageWindow

    @property
    def K(self) -> FloatArray:
        """The camera matrix (3, 3) [px]."""
        return np.reshape(self.matrix, (3, 3))

    def sized(self, width: int, height: int) -> Intrinsics:
        """Return the intrinsics with the size of the images where the message gives none.

        Raises:
            CalibrationError: one of width and height is given, and is not the images'.
        """
        if self.width and self.height:
            return self
        if (self.width or width, self.height or height) != (width, height):
            raise CalibrationError(
                f'camera_info has a size of {self.width}x{self.height}, and the images are of '
                f'{width}x{height}; publish both or none'
            )
        given = (self.matrix, self.distortion_model, self.distortion, self.window)
        return Intrinsics(width, height, *given)

    def camera(self, posed: CameraModel) -> CameraModel:
        """Return a camera with these intrinsics and the pose of `posed`.

        Raises:
            CalibrationError: see `with_camera_info`.
        """
        return with_camera_info(
            posed,
            width=self.width,
            height=self.height,
            K=self.K,
            distortion_model=self.distortion_model,
            distortion=self.distortion,
        )

    def difference(self, other: Intrinsics) -> str:
        """Return the differences from another one, as text; empty = equal."""
        pairs = {
            'size': (f'{self.width}x{self.height}', f'{other.width}x{other.height}'),
            'K': (_numbers(self.matrix), _numbers(other.matrix)),
            'distortion_model': (self.distortion_model, other.distortion_model),
            'D': (_numbers(self.distortion), _numbers(other.distortion)),
            'window': (str(self.window), str(other.window)),
        }
        return ', '.join(f'{k} from {a} to {b}' for k, (a, b) in pairs.items() if a != b)


def read_camera_info(view: str, info: Any, *, is_rectified: bool = False) -> Intrinsics | None:
    """Return the intrinsics of a sensor_msgs/CameraInfo, of rclpy's or rosbags' class.

    Args:
        view: name of the view, for error texts.
        info: message sensor_msgs/CameraInfo.
        is_rectified: whether the images are; they have P's left part as K and no distortion.

    Returns:
        None where the camera is not calibrated, which is the same as no CameraInfo.

    Raises:
        CalibrationError: a number is NaN or infinite.
    """
    field, matrix = 'K', np.asarray(info.k, np.float64)
    model, distortion = info.distortion_model, np.asarray(info.d, np.float64)
    if is_rectified:
        projection = np.reshape(info.p, (3, 4))[:, :3].astype(np.float64).ravel()
        if projection.any() or distortion.any():  # else K is that of undistorted images
            field, matrix = 'P', projection
        model, distortion = 'none', np.zeros(0)
    for name, values in ((field, matrix), ('D', distortion)):
        if not np.isfinite(values).all():
            at = int(np.flatnonzero(~np.isfinite(values))[0])
            place = at + at // 3 if name == 'P' else at
            raise CalibrationError(
                f"camera_info of view '{view}': {name}[{place}] is {values[at]}; calibrate the "
                'camera again, or give its intrinsics in a calibration file'
            )
    if matrix[0] == 0:
        return None
    return Intrinsics(
        int(info.width),
        int(info.height),
        tuple(matrix.tolist()),
        model,
        tuple(distortion.tolist()),
        window_of(info),
    )


def _numbers(values: tuple[float, ...]) -> str:
    return '[' + ' '.join(f'{value:g}' for value in values) + ']'
