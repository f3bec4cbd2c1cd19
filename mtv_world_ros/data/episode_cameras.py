"""Cameras that are written into recorded episodes: calibration.yaml, CameraInfo and /tf_static."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.cameras.calibration_file import load_calibration, save_calibration
from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.copying import copy_companions, copy_metadata, write_copies
from mtv_world_ros.data.bag.image_decoding import to_rgb
from mtv_world_ros.data.bag.metadata import LATCHED
from mtv_world_ros.data.bag.reader import BagMessage, BagReader
from mtv_world_ros.data.bag.writer import BagWriter
from mtv_world_ros.data.episode import (
    CALIBRATION_FILE,
    camera_info_topic,
    image_topic,
    METADATA_NAME,
    optical_frame,
    TF,
    TF_STATIC,
    UNKNOWN_CAMERAS,
)


def calibrated_views(path: Path) -> dict[str, CameraModel]:
    """Return the cameras of an episode's own calibration.yaml; empty if there is none.

    Raises:
        CalibrationError: the file is wrong.
    """
    file = path / CALIBRATION_FILE
    return load_calibration(file) if file.is_file() else {}


def is_imported(path: Path) -> bool:
    """Return whether an episode was written by this package, and is no recording of a user."""
    return path.is_dir() and 'outcome' in BagReader(path).custom_data


def views_without_info(path: Path, topics: Collection[str]) -> list[str]:
    """Return the calibrated views of an episode whose images have no CameraInfo.

    Args:
        path: folder of the episode.
        topics: topics that have messages in its bag.

    Raises:
        CalibrationError: its calibration.yaml is wrong.
    """
    return [
        view
        for view in calibrated_views(path)
        if _image_topic(view, topics) and camera_info_topic(view) not in topics
    ]


def write_cameras(
    path: Path, cameras: Mapping[str, CameraModel], known: Mapping[str, CameraModel] = {}
) -> bool:
    """Write cameras into an episode; cameras of other views and all messages are kept.

    The bag gets a CameraInfo with each image of the views, and their poses on /tf_static, in place
    of what it had; cameras that move in their link keep their poses of /tf. The folder is made
    anew and takes the name of the old one at the end, so that an interrupted call leaves the
    episode as it was. An episode that has these cameras already is left alone.

    Args:
        path: folder of an episode that this package wrote.
        cameras: cameras by view, for calibration.yaml and CameraInfo.
        known: cameras by view, for CameraInfo alone: calibration.yaml has them already. All are of
            the size of the recorded images.

    Returns:
        Whether the episode was changed.

    Raises:
        EpisodeError: it is no such folder, not all of it can be read, a camera is not of the size
            of its images, or the disk does not take the new one.
        CalibrationError: its calibration.yaml is wrong.
    """
    shown, filed = {**known, **cameras}, calibrated_views(path)
    content = _read(path, shown)
    if content.has_infos_of(shown) and all(
        view in filed and _is_same(camera, filed[view]) for view, camera in cameras.items()
    ):
        return False
    with BagWriter(path, overwrite=True) as writer:
        if TF_STATIC not in content.reader.declared():
            writer.declare(TF_STATIC, messages.TF_MESSAGE, LATCHED)
        for _ in write_copies(content.reader, writer, content.with_infos_of(shown)):
            pass
        copy_metadata(content.reader, writer)
        writer.set_metadata(METADATA_NAME, _without_unknown(content.reader, shown))
        copy_companions(path, writer.folder)
        if cameras:
            save_calibration(writer.folder / CALIBRATION_FILE, {**filed, **cameras})
    return True


@dataclass(slots=True)
class _Content:
    """Images and CameraInfos of some views in a bag.

    Attributes:
        reader: reader of the bag, after a whole pass.
        topics: topic of the images that are used, by view.
        num_images: number of images, by view.
        infos: serialised CameraInfos of each view without their headers, each value once.
        num_infos: number of CameraInfos, by view.
        frames: optical frame of the first image, by view.
        moving: frames that /tf moves.
        static: transforms of /tf_static by their child frame, the newest of each.
    """

    reader: BagReader
    topics: dict[str, str]
    num_images: dict[str, int] = field(default_factory=dict)
    infos: dict[str, set[bytes]] = field(default_factory=dict)
    num_infos: dict[str, int] = field(default_factory=dict)
    frames: dict[str, str] = field(default_factory=dict)
    moving: set[str] = field(default_factory=set)
    static: dict[str, Any] = field(default_factory=dict)

    def has_infos_of(self, cameras: Mapping[str, CameraModel]) -> bool:
        """Return whether the bag has CameraInfo and pose of these cameras, and no other ones."""
        has_infos = all(
            self.infos.get(view) == {_without_header(messages.make_camera_info(0, camera, ''))}
            and self.num_infos[view] == self.num_images[view]
            for view, camera in cameras.items()
        )
        wanted = self._transforms_of(cameras, 0)
        return has_infos and all(
            child in self.static and _same_transform(self.static[child], transform)
            for child, transform in wanted.items()
        )

    def add_transforms(self, message: BagMessage) -> None:
        """Take the transforms of a message of /tf or /tf_static."""
        transforms = messages.deserialize(message.msgtype, message.data).transforms
        found = {transform.child_frame_id: transform for transform in transforms}
        if message.topic == TF:
            self.moving |= found.keys()
        else:
            self.static |= found

    def _transforms_of(self, cameras: Mapping[str, CameraModel], stamp_ns: int) -> dict[str, Any]:
        """Return the transforms of the cameras that stand still, by their frames."""
        framed = {self.frames[view]: camera for view, camera in cameras.items()}
        return {
            frame: messages.make_transform(
                stamp_ns, camera.mount_link, frame, camera.T_mount_camera
            )
            for frame, camera in framed.items()
            if frame not in self.moving
        }

    def with_infos_of(self, cameras: Mapping[str, CameraModel]) -> Iterator[BagMessage]:
        """Yield the messages, each image of these cameras after its new CameraInfo.

        All static transforms come first, in one message: a latched topic keeps the last one alone.
        """
        images = {topic: cameras[view] for view, topic in self.topics.items()}
        old = {camera_info_topic(view) for view in cameras} | {TF_STATIC}
        is_first = True
        for message in self.reader.messages():
            if is_first:
                transforms = self.static | self._transforms_of(cameras, message.stamp_ns)
                static = messages.make(messages.TF_MESSAGE, transforms=list(transforms.values()))
                is_first = False
                if transforms:
                    yield message._replace(
                        topic=TF_STATIC,
                        msgtype=messages.TF_MESSAGE,
                        data=messages.serialize(messages.TF_MESSAGE, static),
                    )
            if message.topic in images:
                yield _info_of(message, images[message.topic])
            if message.topic not in old:
                yield message


def _read(path: Path, cameras: Mapping[str, CameraModel]) -> _Content:
    """Read a bag to its end.

    Raises:
        EpisodeError: a copy of it would lack something, or the cameras do not fit its images.
    """
    if not path.is_dir():
        raise EpisodeError(
            f"'{path}' is no folder of an episode, so that cameras cannot be written into it; "
            'import it: mtv-world import bag'
        )
    reader = BagReader(path)
    found = reader.topics()
    _check_whole(path, reader)
    topics = {view: _image_topic(view, found) for view in cameras}
    content = _Content(reader, {view: topic for view, topic in topics.items() if topic})
    missing = [view for view in cameras if view not in content.topics]
    if missing:
        raise EpisodeError(f"'{path}' has no images of view '{missing[0]}'")
    images = {topic: view for view, topic in content.topics.items()}
    infos = {camera_info_topic(view): view for view in cameras}
    for message in reader.messages({*images, *infos, TF, TF_STATIC}):
        if message.topic in (TF, TF_STATIC):
            content.add_transforms(message)
        elif message.topic in images:
            view = images[message.topic]
            if view not in content.num_images:
                _check_size(path, cameras[view], message)
                image = messages.deserialize(message.msgtype, message.data)
                content.frames[view] = image.header.frame_id or optical_frame(view)
            content.num_images[view] = content.num_images.get(view, 0) + 1
        else:
            view = infos[message.topic]
            info = messages.deserialize(messages.CAMERA_INFO, message.data)
            content.infos.setdefault(view, set()).add(_without_header(info))
            content.num_infos[view] = content.num_infos.get(view, 0) + 1
    return content


def _image_topic(view: str, topics: Collection[str]) -> str:
    """Return the topic of a view's images, raw ones where both are there.

    Empty = there is none.
    """
    raw = image_topic(view)
    return next((topic for topic in (raw, f'{raw}/compressed') if topic in topics), '')


def _check_whole(path: Path, reader: BagReader) -> None:
    """Raise EpisodeError if a copy of the bag would lack something of it."""
    if METADATA_NAME not in reader.metadata:
        raise EpisodeError(
            f"'{path}' is a recording of your own, not an imported episode: its bag stays as it "
            'is; for the node and ROS tools import it: mtv-world import bag'
        )
    problems = [reader.truncated] if reader.truncated else reader.problems
    if problems:
        raise EpisodeError(
            f"'{path}': a copy with cameras would lack a part of the recording: {problems[0]}; "
            'mtv-world recover makes a whole bag of what can be read'
        )


def _check_size(path: Path, camera: CameraModel, message: BagMessage) -> None:
    """Raise EpisodeError if an image is not of the camera's size."""
    height, width = to_rgb(messages.deserialize(message.msgtype, message.data)).shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise EpisodeError(
            f"'{path}', view '{camera.view}': the camera is for images of "
            f'{camera.width}x{camera.height}, the recorded ones are {width}x{height}'
        )


def _info_of(image: BagMessage, camera: CameraModel) -> BagMessage:
    """Return the CameraInfo of a camera with stamp and frame of an image."""
    parsed = messages.deserialize(image.msgtype, image.data)
    frame = parsed.header.frame_id or optical_frame(camera.view)
    info = messages.make_camera_info(messages.header_stamp(parsed), camera, frame)
    return image._replace(
        topic=camera_info_topic(camera.view),
        msgtype=messages.CAMERA_INFO,
        data=messages.serialize(messages.CAMERA_INFO, info),
    )


def _same_transform(one: Any, other: Any) -> bool:
    """Return whether two transforms have equal frames and values; stamps do not count."""
    return one.header.frame_id == other.header.frame_id and one.transform == other.transform


def _without_header(info: Any) -> bytes:
    """Return the serialised CameraInfo, its stamp and frame left out."""
    plain = replace(info, header=messages.make_header(0, ''))
    return messages.serialize(messages.CAMERA_INFO, plain)


def _is_same(one: CameraModel, other: CameraModel) -> bool:
    """Return whether two cameras are equal in all values."""
    return all(
        np.array_equal(getattr(one, row.name), getattr(other, row.name)) for row in fields(one)
    )


def _without_unknown(reader: BagReader, cameras: Mapping[str, CameraModel]) -> dict[str, str]:
    """Return the episode's metadata, in which these cameras are not marked as unknown any more."""
    values = dict(reader.metadata[METADATA_NAME])
    marked = [name for name in values.pop(UNKNOWN_CAMERAS, '').split(', ') if name]
    remaining = [name for name in marked if name not in cameras]
    return values | ({UNKNOWN_CAMERAS: ', '.join(remaining)} if remaining else {})
