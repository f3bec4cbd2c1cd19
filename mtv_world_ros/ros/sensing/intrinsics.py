"""CameraInfo of every view: the first one holds until a reset, a change is refused."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import fields

import numpy as np
from sensor_msgs.msg import CameraInfo

from mtv_world_ros.data_types import CameraModel
from mtv_world_ros.ros.messages.images import camera_from_info
from mtv_world_ros.ros.messages.rejection import Reason, Rejection

_COMPARED = ('width', 'height', 'distortion_model', 'k', 'd', 'p')


class Intrinsics:
    """The cameras as their CameraInfo describes them.

    Args:
        cameras: calibrated cameras of the V views; their poses are used.
    """

    def __init__(self, cameras: Sequence[CameraModel]) -> None:
        self._calibrated = {camera.view: camera for camera in cameras}
        self._infos: dict[str, CameraInfo] = {}
        self._cameras: dict[str, CameraModel] = {}
        self._changed: dict[str, tuple[CameraInfo, str]] = {}

    def add(self, view: str, message: CameraInfo) -> None:
        """Stores the first info of a view and watches the later ones.

        Raises:
            Rejection: it is not calibrated, or it just changed.
        """
        if view not in self._infos:
            self._take(view, message)
            return
        differences = _differences(self._infos[view], message)
        if not differences:
            self._changed.pop(view, None)
            return
        is_news = view not in self._changed
        text = f"camera_info of view '{view}' changed: {differences}; call ~/reset to accept it"
        self._changed[view] = (message, text)
        if is_news:
            raise Rejection(Reason.CAMERA_INFO_CHANGED, text)

    def accept(self, cameras: Sequence[CameraModel]) -> None:
        """Takes changed infos as the valid ones from now on.

        Args:
            cameras: calibrated cameras of the views. Where they are others than before, the
                infos belong to those: the next ones are awaited.

        Raises:
            Rejection: a new one is not calibrated.
        """
        if not _are_equal(self._calibrated.values(), cameras):
            self._calibrated = {camera.view: camera for camera in cameras}
            for stored in (self._infos, self._cameras, self._changed):
                stored.clear()
        for view, (message, _) in list(self._changed.items()):
            self._take(view, message)
            del self._changed[view]

    def camera(self, view: str, *, width: int, height: int) -> CameraModel:
        """The view's camera, for images of this size.

        Raises:
            Rejection: its info is missing, changed, or for another size.
        """
        if view not in self._cameras:
            raise Rejection(
                Reason.CAMERA_INFO_MISSING,
                f"no camera_info of view '{view}' was received; publish it beside the images",
            )
        if view in self._changed:
            raise Rejection(Reason.CAMERA_INFO_CHANGED, self._changed[view][1])
        camera = self._cameras[view]
        if (camera.width, camera.height) != (width, height):
            raise Rejection(
                Reason.CAMERA_INFO_INVALID,
                f"view '{view}' has images of {width}x{height} but a camera_info for "
                f'{camera.width}x{camera.height}; publish the camera_info of these images',
            )
        return camera

    def info(self, view: str, frame_id: str) -> CameraInfo:
        """The view's info, with the image's frame where the image names one."""
        info = self._infos[view]
        if frame_id in ('', info.header.frame_id):
            return info
        named = CameraInfo(**{name: getattr(info, name) for name in _FIELDS})
        named.header = type(info.header)(stamp=info.header.stamp, frame_id=frame_id)
        return named

    def _take(self, view: str, message: CameraInfo) -> None:
        self._cameras[view] = camera_from_info(self._calibrated[view], message)
        self._infos[view] = message


def _are_equal(before: Iterable[CameraModel], now: Iterable[CameraModel]) -> bool:
    def key(camera: CameraModel) -> tuple[object, ...]:
        values = (getattr(camera, field.name) for field in fields(camera))
        return tuple(v.tolist() if isinstance(v, np.ndarray) else v for v in values)

    return list(map(key, before)) == list(map(key, now))


_FIELDS = tuple(CameraInfo.get_fields_and_field_types())


def _differences(first: CameraInfo, later: CameraInfo) -> str:
    """What sets two infos of one camera apart; empty if nothing."""
    said = []
    for field in _COMPARED:
        before, now = getattr(first, field), getattr(later, field)
        if not np.array_equal(before, now):
            said.append(f'{field} from {_short(before)} to {_short(now)}')
    return ', '.join(said)


def _short(value: object) -> str:
    if isinstance(value, (str, int)):
        return str(value)
    return '[' + ' '.join(f'{x:g}' for x in value) + ']'  # type: ignore[attr-defined]
