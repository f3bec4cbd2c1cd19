"""Pictures that a task names: of the task done, or of the region where something belongs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import ValidationInfo

from mtv_world_ros.config import wrong
from mtv_world_ros.data_types import BoolArray, ByteArray, CameraModel, ObjectMasks
from mtv_world_ros.errors import CannotTell
from mtv_world_ros.vision.segmenters.segmenter import resize_masks, Segmenter

#: sides of a picture and of its view may differ in ratio by this share
_MAX_STRETCH = 0.01
#: pixels of a region's picture from this grey on belong to it
_WHITE = 128
#: object masks found in pictures that are kept
_MAX_KEPT = 64


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A file's picture, taken by the calibrated camera of its view, at any size.

    Attributes:
        path: the file.
        pixels: (H, W, 3) uint8 RGB.
    """

    path: Path
    pixels: ByteArray

    def check_shape(self, camera: CameraModel) -> None:
        """Refuses a picture that cannot be of the camera.

        Raises:
            CannotTell: its sides have another ratio.
        """
        height, width = self.pixels.shape[:2]
        if abs(width * camera.height / (height * camera.width) - 1) > _MAX_STRETCH:
            raise CannotTell(
                f"picture '{self.path}' is {width}x{height}, view '{camera.view}' "
                f'{camera.width}x{camera.height}: the ratio of their sides must be the same'
            )

    def region(self, camera: CameraModel) -> BoolArray:
        """Returns the (H, W) white part, at the camera's size.

        Raises:
            CannotTell: the picture cannot be of the camera.
        """
        self.check_shape(camera)
        return resize_masks(self.pixels.mean(-1) >= _WHITE, camera.width, camera.height)


def load_pictures(data: Any, info: ValidationInfo) -> Any:
    """Validator: reads the picture files of a mapping from views to names.

    The context's `folder` is what names are relative to; without it, `data` are pictures already.

    Raises:
        ValueError: the value is no mapping of views to files, or a file is no picture.
    """
    if not info.context:
        return data
    if not isinstance(data, Mapping) or not data:
        raise wrong('picture files by view, {low: FILE}', '; expected')
    found = {}
    for view, name in data.items():
        path = info.context['folder'] / str(name)
        if not path.is_file():
            raise ValueError(f"picture '{path}' of view '{view}' does not exist")
        pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)
        if pixels is None:
            raise ValueError(f"'{path}' of view '{view}' is no picture; use PNG or JPEG")
        found[str(view)] = Picture(path, np.asarray(pixels[..., ::-1], np.uint8))
    return found


def load_regions(data: Any, info: ValidationInfo) -> Any:
    """Validator: reads pictures whose white part is a region.

    Raises:
        ValueError: as `load_pictures`, or a region is empty.
    """
    found = load_pictures(data, info)
    for view, picture in found.items():
        if not (picture.pixels.mean(-1) >= _WHITE).any():
            raise ValueError(
                f"'{picture.path}' of view '{view}' is black all over; paint the region white"
            )
    return found


class PictureMasks:
    """Finds objects in pictures, and caches the masks.

    Args:
        segmenter: finds them; None = there is nothing to find them with.
    """

    def __init__(self, segmenter: Segmenter | None) -> None:
        self._segmenter = segmenter
        self._found: dict[Any, ObjectMasks] = {}

    def masks(
        self,
        pictures: Mapping[str, Picture],
        names: tuple[str, ...],
        item: int,
        cameras: Sequence[CameraModel],
    ) -> BoolArray:
        """Returns the (V, H, W) masks of object `item`; empty in views without a picture.

        Args:
            pictures: by view.
            names: of all objects; the segmenter distinguishes objects of the same kind by them.
            item: index of the one.
            cameras: of the V views.

        Raises:
            CannotTell: a picture cannot be of its view, or does not show the object plainly.
        """
        shown = [camera for camera in cameras if camera.view in pictures]
        found = self._segmented(pictures, names, shown)
        masks = np.zeros((len(cameras), cameras[0].height, cameras[0].width), np.bool_)
        for row, camera in enumerate(shown):
            if (status := found.status[row][item]) != 'ok':
                raise CannotTell(
                    f"'{names[item]}' cannot be told in picture '{pictures[camera.view].path}' "
                    f'({status})'
                )
            masks[cameras.index(camera)] = found.masks[row, item, 0]
        return masks

    def _segmented(
        self,
        pictures: Mapping[str, Picture],
        names: tuple[str, ...],
        cameras: Sequence[CameraModel],
    ) -> ObjectMasks:
        if self._segmenter is None:
            raise CannotTell('there is no segmenter to find objects in pictures with')
        for camera in cameras:
            pictures[camera.view].check_shape(camera)
        key = (
            names,
            tuple((pictures[c.view].path, c.view, c.width, c.height) for c in cameras),
        )
        if key not in self._found:
            frames = [
                cv2.resize(
                    pictures[camera.view].pixels,
                    (camera.width, camera.height),
                    interpolation=cv2.INTER_AREA,
                )
                for camera in cameras
            ]
            if len(self._found) >= _MAX_KEPT:
                self._found.clear()
            self._found[key] = self._segmenter.segment(
                np.asarray(frames, np.uint8)[:, None], names
            )
        return self._found[key]
