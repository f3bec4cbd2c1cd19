"""Intrinsics of a recording's views by CameraInfo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mtv_world_ros.cameras.camera_info import Intrinsics, is_rectified, read_camera_info
from mtv_world_ros.cameras.image_window import ImageWindow, WHOLE, windowed_camera
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import (
    CalibrationError,
)
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.recorded_streams import RecordedStreams

#: intrinsics that differ by less of the focal length are the same
_SAME_K = 0.005


class ViewIntrinsics:
    """Intrinsics of the views of a recording, as their CameraInfo has them.

    Args:
        streams: messages of the recording.
    """

    def __init__(self, streams: RecordedStreams) -> None:
        self.streams, self.path, self.topics = streams, streams.path, streams.topics
        self._infos: dict[str, list[tuple[Any, Intrinsics]]] = {}

    def of(self, view: str) -> list[tuple[Any, Intrinsics]]:
        """Return the CameraInfos of a view that are calibrated, with their intrinsics.

        Raises:
            CalibrationError: a number in one is NaN or infinite.
        """
        if view not in self._infos:
            rectified = is_rectified(self.topics.views[view].image)
            taken = self.streams.take(self.streams.camera_info(view), messages.CAMERA_INFO)
            read = [(m, read_camera_info(view, m, is_rectified=rectified)) for _, m in taken]
            self._infos[view] = [(m, found) for m, found in read if found is not None]
            if read and not self._infos[view]:
                self.streams.warn_once(
                    f"view '{view}': '{self.streams.camera_info(view)}' is not calibrated "
                    f'({"P" if rectified else "K"}[0] = 0), which is the same as no CameraInfo'
                )
        return self._infos[view]

    def at_images(
        self, camera: CameraModel, size: tuple[int, int], *, is_given: bool
    ) -> CameraModel:
        """Return camera for images of a size, by CameraInfo where a file has not given others."""
        view, first, informed = camera.view, None, camera
        try:
            infos = self.of(view)
            first = infos[0][1].sized(*size) if infos else None
            informed = first.camera(camera) if first else camera
        except CalibrationError as error:
            if not is_given:
                raise
            self.streams.warn_once(f"{error}: the calibration file's intrinsics are used")
            first, infos = None, []
        self._check_changes(view, infos, size)
        if first is None:
            return self._windowed(camera, size)
        seen = self._windowed(informed, size, first.window)
        if not is_given:
            return seen
        is_full = (camera.width, camera.height) == (first.width, first.height)
        given = self._windowed(camera, size, first.window if is_full else WHOLE)
        apart = np.abs(given.K - seen.K)[:2] / seen.K[0, 0]
        bends = given.distortion.any() and not _same_distortion(given, seen)
        if apart.max() < _SAME_K and bends:
            self.streams.warn_once(
                f"view '{view}': the calibration file has distortion {_listed_numbers(given)}, "
                f"CameraInfo {_listed_numbers(seen)}; the file's is used"
            )
            return given
        if apart.max() < _SAME_K:
            return seen
        self.streams.warn_once(
            f"view '{view}': the calibration file has fx, fy, cx, cy = {_four(given.K)} px, "
            f"CameraInfo {_four(seen.K)} px; the file's are used"
        )
        return given

    def _check_changes(
        self, view: str, infos: Sequence[tuple[Any, Intrinsics]], size: tuple[int, int]
    ) -> None:
        """Refuse intrinsics that change, and say where the size of the images stands in."""
        for index, (_, found) in enumerate(infos):
            first = infos[0][1]
            if found != first:
                raise CalibrationError(
                    f"'{self.path}': '{self.streams.camera_info(view)}' changes at message "
                    f'{index}, {first.difference(found)}; cut the episode there'
                )
            if not (first.width and first.height):
                self.streams.warn_once(
                    f"view '{view}': its CameraInfo has no size ({first.width}x{first.height}): "
                    f'taken as that of the images, {size[0]}x{size[1]}'
                )

    def _windowed(
        self, camera: CameraModel, size: tuple[int, int], window: ImageWindow = WHOLE
    ) -> CameraModel:
        sized, note = windowed_camera(camera, *size, window)
        if note:
            self.streams.warn_once(note)
        return sized


def _same_distortion(one: CameraModel, other: CameraModel) -> bool:
    """Return whether two cameras bend rays alike; coefficients that are not there are zero."""
    size = max(len(one.distortion), len(other.distortion))
    padded = [np.pad(c.distortion, (0, size - len(c.distortion))) for c in (one, other)]
    models = {'plumb_bob' if c.distortion_model == 'none' else c.distortion_model
              for c in (one, other)}  # fmt: skip
    return len(models) == 1 and bool(np.allclose(*padded, atol=1e-6))


def _listed_numbers(camera: CameraModel) -> str:
    return f'{camera.distortion_model} {[round(float(v), 5) for v in camera.distortion]}'


def _four(K: FloatArray) -> str:
    return ', '.join(f'{v:.1f}' for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
