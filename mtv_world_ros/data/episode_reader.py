"""Reads a recorded episode: images, joint states, commands, masks, calibration, outcome."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.images import (
    check_compressed,
    check_raw,
    compressed_to_ids,
    compressed_to_rgb,
    raw_to_rgb,
)
from mtv_world_ros.data.bag.reader import BagReader, iter_messages
from mtv_world_ros.data.episode import (
    CALIBRATION_FILE,
    Episode,
    EpisodeInfo,
    METADATA_NAME,
    ObjectPoses,
    parse_info,
    Track,
)
from mtv_world_ros.data.episode_topics import EpisodeTopics, find_topics, ViewTopics
from mtv_world_ros.data.tracks import in_order, LazyFrames, merge_joint_states
from mtv_world_ros.data_types import ByteArray, CameraModel
from mtv_world_ros.errors import CalibrationError, EpisodeError, MtvWorldError
from mtv_world_ros.geometry.calibration_file import load_calibration
from mtv_world_ros.geometry.camera import scaled, with_camera_info

__all__ = ['iter_messages', 'list_episodes', 'read_episode', 'read_info']

Stamped = list[tuple[int, Any]]


def read_episode(
    path: Path | str,
    *,
    views: Sequence[str] | None = None,
    calibration: Path | str | None = None,
    with_cameras: bool = True,
    with_masks: bool = True,
    topics: Mapping[str, str] | None = None,
) -> Episode:
    """Reads an episode; frames are decoded later, when asked for.

    Times are the headers' stamps, or the log time where a header has none. Messages that are
    damaged are left out, and every oddity is a line in the result's `warnings`.

    Args:
        path: rosbag2 folder, also one that was cut off, or .mcap file.
        views: views to read; None = all.
        calibration: camera calibration; None = calibration.yaml in the folder.
        with_cameras: whether the cameras are needed.
        with_masks: whether to read object masks where there are any.
        topics: topics that are not named as this package names them, by view or by
            `joint_states`, `joint_trajectory`, `instruction`, e.g.
            `{'low': '/camera_low/color/image_raw'}`.

    Raises:
        EpisodeError: no bag, a view is missing, or none of its images can be used.
        CalibrationError: a view's calibration is missing or does not fit its CameraInfo.
    """
    return _EpisodeReader(Path(path), views, topics or {}, with_masks).read(
        calibration, with_cameras
    )


def read_info(path: Path | str) -> EpisodeInfo:
    """What an episode shows, without reading its images where metadata.yaml says it.

    Raises:
        EpisodeError: no bag, or its metadata cannot be used.
    """
    reader = BagReader(path)
    if 'outcome' in reader.custom_data:
        return _info(reader, [])
    texts = [
        (message.stamp_ns, messages.deserialize(messages.STRING, message.data).data)
        for message in reader.messages({'/instruction'})
    ]
    return _info(reader, texts)


def list_episodes(folder: Path | str) -> list[Path]:
    """Episode folders anywhere in a folder, by path; unfinished (hidden) ones are left out."""
    found = Path(folder).rglob('metadata.yaml')
    return sorted(file.parent for file in found if not file.parent.name.startswith('.'))


class _EpisodeReader:
    def __init__(
        self,
        path: Path,
        views: Sequence[str] | None,
        named: Mapping[str, str],
        with_masks: bool,
    ) -> None:
        self.path = path
        self.bag = BagReader(path)
        self.warnings: list[str] = []
        found = self.bag.topics()
        try:
            self.topics: EpisodeTopics = find_topics(path, found, views, named)
        except EpisodeError as error:
            if self.bag.truncated:
                raise EpisodeError(f'{error}; {self.bag.truncated}') from error
            raise
        self.with_masks = with_masks
        self.received: dict[str, Stamped] = {}
        self.refused: dict[str, list[str]] = {}

    def read(self, calibration: Path | str | None, with_cameras: bool) -> Episode:
        self._receive()
        topics = self.topics
        images = {view: self._images(view, names) for view, names in topics.views.items()}
        masks = {view: self._masks(names) for view, names in topics.views.items()}
        instructions = [(s, m.data) for s, m in self._take(topics.instruction, messages.STRING)]
        states = self._take(topics.joint_states, messages.JOINT_STATE)
        episode_info = _info(self.bag, instructions)
        return Episode(
            info=episode_info,
            views=tuple(topics.views),
            cameras=self._cameras(calibration, images) if with_cameras else {},
            images=images,
            joint_states=merge_joint_states(topics.joint_states, states, self.warnings),
            trajectories=self._trajectories(),
            masks={view: track for view, track in masks.items() if track} or None,
            instructions=instructions,
            object_poses=self._object_poses(len(episode_info.objects)),
            truncated=bool(self.bag.truncated),
            warnings=self._all_warnings(),
        )

    def _receive(self) -> None:
        for message in self.bag.messages(self.topics.names(with_masks=self.with_masks)):
            try:
                parsed = messages.deserialize(message.msgtype, message.data)
            except EpisodeError as error:
                self._refuse(message.topic, error)
                continue
            stamp = messages.header_stamp(parsed) if hasattr(parsed, 'header') else 0
            entry = (stamp or message.stamp_ns, (message.msgtype, parsed))
            self.received.setdefault(message.topic, []).append(entry)
            if not stamp and hasattr(parsed, 'header'):
                self._warn_once(f"'{message.topic}': headers without stamp; log times are used")

    def _images(self, view: str, names: ViewTopics) -> Track:
        track = self._track(names.image, _check_image, _to_rgb)
        if track is None:
            reasons = self.refused.get(names.image) or ['it holds no messages']
            raise EpisodeError(f"'{self.path}', view '{view}': '{names.image}': {reasons[0]}")
        return track

    def _masks(self, names: ViewTopics) -> Track | None:
        return self._track(names.mask, _check_image, _to_ids) if self.with_masks else None

    def _track(
        self, topic: str, check: Callable[[Any], None], decode: Callable[[Any], ByteArray]
    ) -> Track | None:
        good: Stamped = []
        for stamp, (_, message) in self.received.get(topic, []):
            try:
                check(message)
                good.append((stamp, message))
            except MtvWorldError as error:
                self._refuse(topic, error)
        if not good:
            return None
        ordered = in_order(topic, good, self.warnings)
        stamps = np.array([stamp for stamp, _ in ordered], np.int64)
        return Track(stamps, LazyFrames(topic, [message for _, message in ordered], decode))

    def _take(self, topic: str, msgtype: str) -> Stamped:
        """Messages of a topic, as recorded; those of another type are refused."""
        taken: Stamped = []
        for stamp, (kind, message) in self.received.get(topic, []):
            if kind == msgtype:
                taken.append((stamp, message))
            else:
                self._refuse(topic, EpisodeError(f'it holds {kind}, expected {msgtype}'))
        return taken

    def _trajectories(self) -> Stamped:
        topic = self.topics.joint_trajectory
        good: Stamped = []
        for stamp, message in self._take(topic, messages.JOINT_TRAJECTORY):
            try:
                good.append((stamp, messages.parse_joint_trajectory(message)))
            except MtvWorldError as error:
                self._refuse(topic, error)
        return in_order(topic, good, self.warnings)

    def _object_poses(self, num_objects: int) -> ObjectPoses | None:
        topic = self.topics.object_poses
        good: Stamped = []
        for stamp, message in self._take(topic, messages.POSE_ARRAY):
            if len(message.poses) == num_objects:
                good.append((stamp, messages.parse_pose_array(message)))
            else:
                self._refuse(
                    topic,
                    EpisodeError(f'{len(message.poses)} poses for {num_objects} objects'),
                )
        ordered = in_order(topic, good, self.warnings)
        if not ordered:
            return None
        stamps = np.array([stamp for stamp, _ in ordered], np.int64)
        return ObjectPoses(stamps, np.stack([poses for _, poses in ordered]))

    def _cameras(
        self, calibration: Path | str | None, images: Mapping[str, Track]
    ) -> dict[str, CameraModel]:
        folder = self.path if self.path.is_dir() else self.path.parent
        file = Path(calibration) if calibration else folder / CALIBRATION_FILE
        if not file.is_file():
            raise CalibrationError(
                f"'{file}' is not there: an episode needs the cameras' poses; put a "
                f'{CALIBRATION_FILE} into its folder or name one in `calibration`'
            )
        known = load_calibration(file)
        cameras = {}
        for view, names in self.topics.views.items():
            if view not in known:
                raise CalibrationError(
                    f"'{file}' has no view '{view}'; it has {', '.join(known) or 'none'}"
                )
            camera = self._with_intrinsics(known[view], names.camera_info)
            height, width = images[view].frames[0].shape[:2]
            cameras[view] = scaled(camera, width, height)
        return cameras

    def _with_intrinsics(self, camera: CameraModel, topic: str) -> CameraModel:
        infos = [message for _, message in self._take(topic, messages.CAMERA_INFO)]
        if not infos:
            return camera
        first = _intrinsics(infos[0])
        for index, info in enumerate(infos):
            if _intrinsics(info) != first:
                raise CalibrationError(
                    f"'{self.path}': '{topic}' changes at message {index}, from {first} to "
                    f'{_intrinsics(info)}; cut the episode there'
                )
        width, height, k, model, distortion = first
        return with_camera_info(
            camera,
            width=width,
            height=height,
            K=np.reshape(k, (3, 3)),
            distortion_model=model,
            distortion=distortion,
        )

    def _refuse(self, topic: str, error: MtvWorldError) -> None:
        self.refused.setdefault(topic, []).append(str(error))

    def _warn_once(self, text: str) -> None:
        if text not in self.warnings:
            self.warnings.append(text)

    def _all_warnings(self) -> tuple[str, ...]:
        cut = [self.bag.truncated] if self.bag.truncated else []
        refused = [
            f"'{topic}': {len(reasons)} messages were left out, the first: {reasons[0]}"
            for topic, reasons in self.refused.items()
        ]
        return (*cut, *self.bag.problems, *self.warnings, *refused)


def _info(bag: BagReader, instructions: Sequence[tuple[int, str]]) -> EpisodeInfo:
    values = {**bag.custom_data, **bag.metadata.get(METADATA_NAME, {})}
    return parse_info(bag.path, values, default_instruction=next((t for _, t in instructions), ''))


def _intrinsics(info: Any) -> tuple[int, int, tuple[float, ...], str, tuple[float, ...]]:
    k, d = tuple(info.k.tolist()), tuple(info.d.tolist())
    return info.width, info.height, k, info.distortion_model, d


def _is_raw(message: Any) -> bool:
    return hasattr(message, 'encoding')


def _layout(message: Any) -> dict[str, Any]:
    return {key: getattr(message, key) for key in ('encoding', 'height', 'width', 'step')}


def _check_image(message: Any) -> None:
    if _is_raw(message):
        check_raw(**_layout(message), num_bytes=len(message.data))
    else:
        check_compressed(message.format, message.data)


def _to_rgb(message: Any) -> ByteArray:
    if _is_raw(message):
        return raw_to_rgb(message.data, **_layout(message))
    return compressed_to_rgb(message.format, message.data)


def _to_ids(message: Any) -> ByteArray:
    return compressed_to_ids(message.format, message.data)
