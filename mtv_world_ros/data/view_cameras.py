"""Cameras of a recorded episode: calibration files, TF and CameraInfo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.cameras.camera import unknown_camera
from mtv_world_ros.cameras.foreign_calibrations import (
    ForeignCalibration,
    FramePose,
    Lens,
    read_foreign,
)
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import (
    CalibrationError,
)
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.episode import (
    CALIBRATION_FILE,
    optical_frame,
    OtherDirection,
    Track,
)
from mtv_world_ros.data.recorded_streams import RecordedStreams, TF_TOPICS
from mtv_world_ros.data.transform_tree import Mount, pose_track, read_tree, TransformTree
from mtv_world_ros.data.view_intrinsics import ViewIntrinsics
from mtv_world_ros.robot.model import RobotModel


class ViewCameras:
    """Cameras of the views of a recording.

    Args:
        streams: messages of the recording.
        robot: robot whose links may carry cameras with poses from TF; None = any frame may.

    Attributes:
        tracks: (T, 4, 4) poses of cameras that move against their link, by view.
        unknown: what is not known of a camera, by view.
        unknown_because: why, by view.
        other_directions: cameras with the given poses turned round, by view.
        is_calibrated: whether the cameras are those of a given file.
    """

    def __init__(self, streams: RecordedStreams, robot: RobotModel | None) -> None:
        self.streams, self.robot = streams, robot
        self.intrinsics = ViewIntrinsics(streams)
        self.path, self.topics, self.mapping = streams.path, streams.topics, streams.mapping
        self.tracks: dict[str, FloatArray] = {}
        self.unknown: dict[str, str] = {}
        self.unknown_because: dict[str, str] = {}
        self.other_directions: dict[str, OtherDirection] = {}
        self.is_calibrated = False
        self._given_tf: list[Any] = []

    def read(
        self,
        calibration: Path | str | None,
        images: Mapping[str, Track],
        unknown_mount: str,
    ) -> dict[str, CameraModel]:
        """Return the cameras by view.

        Args:
            calibration: file of poses and intrinsics; None = calibration.yaml in the folder, or
                else TF and CameraInfo.
            images: images by view.
            unknown_mount: link that carries cameras of unknown pose; empty = they are an error.

        Raises:
            CalibrationError: a view's calibration is missing or does not fit its CameraInfo.
        """
        if calibration:
            topics = {view: names.image for view, names in self.topics.views.items()}
            foreign = read_foreign(Path(calibration), topics)
            if foreign is not None:
                return self._foreign_cameras(foreign, images, unknown_mount)
        folder = self.path if self.path.is_dir() else self.path.parent
        file = Path(calibration) if calibration else folder / CALIBRATION_FILE
        tree = None
        if not file.is_file():
            tree = self._tree()
            if calibration or not (tree.frames or unknown_mount):
                raise CalibrationError(
                    f"'{file}' is not there: an episode needs the cameras' poses; put a "
                    f'{CALIBRATION_FILE} into its folder or name one in `calibration` (the bag '
                    f'has no /tf_static either); {_estimate(self.path, next(iter(images)))}'
                )
        self.is_calibrated = bool(calibration)
        known = load_calibration(file) if tree is None else {}
        cameras = {}
        for view in self.topics.views:
            if tree is not None:
                known[view] = self._from_tree(tree, view, unknown_mount, images[view])
            elif view not in known and unknown_mount:
                known[view] = self._placeholder(view, unknown_mount, images[view])
            elif view not in known:
                raise CalibrationError(
                    f"'{file}' has no view '{view}'; it has {', '.join(known) or 'none'}; "
                    f'{_estimate(self.path, view)}'
                )
            elif not calibration:
                known[view] = self._moving(known[view], images[view])
            is_given = tree is None and view not in self.unknown
            height, width = images[view].frames[0].shape[:2]
            cameras[view] = self.intrinsics.at_images(
                known[view], (width, height), is_given=is_given
            )
        return cameras

    def _moving(self, camera: CameraModel, track: Track) -> CameraModel:
        """Return camera of an episode, with the poses that /tf has of its frame in its mount."""
        frame = optical_frame(camera.view)
        moving, static = self._tf()
        if not read_tree(moving, static=static).moves_in(camera.mount_link, frame):
            return camera
        stamps = track.stamps_ns
        found = pose_track(moving, frame, {camera.mount_link}, stamps, static=static)
        self.tracks[camera.view] = found.T_link_frame
        return replace(camera, T_mount_camera=found.T_link_frame[0])

    def _foreign_cameras(
        self, foreign: ForeignCalibration, images: Mapping[str, Track], unknown_mount: str
    ) -> dict[str, CameraModel]:
        """Return cameras by calibrations of other programs; TF and CameraInfo have the rest."""
        self.streams.warnings += foreign.notes
        frames = {view: self._frame_of(view) for view in self.topics.views}
        chain = [
            messages.make_tf(1, frames[one.before], frames[one.view], one.T_before_view)
            for one in foreign.chain
        ]
        self._given_tf = [*map(_as_tf, foreign.poses), *chain]
        tree = self._tree()
        self._name_unused_poses(tree, foreign, frames)
        cameras = {}
        for view in self.topics.views:
            lens = foreign.lenses.get(view)
            camera = self._from_tree(tree, view, unknown_mount, images[view], lens)
            height, width = images[view].frames[0].shape[:2]
            is_given = lens is not None
            cameras[view] = self.intrinsics.at_images(camera, (width, height), is_given=is_given)
        own = self._given_tf
        self._given_tf = [*(_as_tf(one.turned_round) for one in foreign.poses), *chain]
        other = read_tree(*self._tree_of_tf())
        self._given_tf = own
        for view in set(cameras) - set(self.unknown) - set(self.tracks):
            mount = self._mount_in(other, frames[view])
            camera = cameras[view]
            if mount is None or np.allclose(mount.T_link_frame, camera.T_mount_camera):
                continue
            self.other_directions[view] = OtherDirection(
                camera=replace(camera, mount_link=mount.link, T_mount_camera=mount.T_link_frame),
                source=', '.join(f"'{one.parent}' -> '{one.child}'" for one in foreign.poses),
            )
        return cameras

    def _tree_of_tf(self) -> tuple[list[Any], str, list[Any]]:
        moving, static = self._tf()
        return moving, self.mapping.tf_prefix, static

    def _mount_in(self, tree: TransformTree, frame: str) -> Mount | None:
        """Return the link that carries a frame in a tree; None = it has none, or it moves."""
        links = () if self.robot is None else self.robot.posed_links
        try:
            if tree.unknown_because(frame, links) is not None or tree.is_moving(frame, links):
                return None
            return tree.mount(frame, links)
        except CalibrationError:
            return None

    def _frame_of(self, view: str) -> str:
        """Return the optical frame of a view: the mapping's, the CameraInfo's or the images'."""
        row, infos = self.mapping.views.get(view), self.intrinsics.of(view)
        given = (row.frame if row else '') or (infos[0][0].header.frame_id if infos else '')
        return (
            given or self.streams.received[self.topics.views[view].image][0][1][1].header.frame_id
        )

    def _name_unused_poses(
        self, tree: TransformTree, foreign: ForeignCalibration, frames: Mapping[str, str]
    ) -> None:
        """Name poses of frames that are of no view and carry none."""
        for one in foreign.poses:
            if not any(tree.hangs_from(frame, one.child) for frame in frames.values()):
                listed = ', '.join(f'{view} {frame}' for view, frame in frames.items())
                self.streams.warn_once(
                    f"'{one.file}': frame '{one.child}' carries no view; views have the frames "
                    f"{listed}: name it as 'frame' of the view in the mapping (--topics)"
                )

    def _tf(self) -> tuple[list[Any], list[Any]]:
        """Return the messages of /tf and of /tf_static, then those of given calibrations."""
        moving, static = (
            [message for _, message in self.streams.take(topic, messages.TF_MESSAGE)]
            for topic in TF_TOPICS
        )
        return moving, [*static, *self._given_tf]

    def _tree(self) -> TransformTree:
        moving, static = self._tf()
        tree = read_tree(moving, self.mapping.tf_prefix, static)
        self.streams.warnings += tree.problems
        return tree

    def _from_tree(
        self,
        tree: TransformTree,
        view: str,
        unknown_mount: str,
        images: Track,
        lens: Lens | None = None,
    ) -> CameraModel:
        """Return the camera's pose by TF; without lens its intrinsics come from CameraInfo."""
        infos = self.intrinsics.of(view)
        if not infos and lens is None and unknown_mount:
            return self._placeholder(view, unknown_mount, images)
        if not infos and lens is None:
            raise CalibrationError(
                f"'{self.path}', view '{view}': '{self.streams.camera_info(view)}' has no "
                'CameraInfo that is calibrated (K[0] is not 0), which intrinsics come from where '
                'there is no calibration file; '
                f'{_estimate(self.path, view)}'
            )
        of_images = self.streams.received[self.topics.views[view].image][0][1][1].header.frame_id
        of_info = infos[0][0].header.frame_id if infos else ''
        if of_images and of_info and of_images != of_info:
            self.streams.warn_once(
                f"view '{view}': its images are of frame '{of_images}', its CameraInfo of "
                f"'{of_info}', which is used"
            )
        row = self.mapping.views.get(view)
        frame = (row.frame if row else '') or of_info or of_images
        links = () if self.robot is None else self.robot.posed_links
        if unknown_mount and (why := tree.unknown_because(frame, links)) is not None:
            mount = Mount(unknown_mount, np.eye(4), None)
            self.unknown[view] = 'pose'
            self.unknown_because |= {view: why} if why else {}
        elif tree.is_moving(frame, links):
            moving, static = self._tf()
            prefix = self.mapping.tf_prefix
            found = pose_track(moving, frame, links, images.stamps_ns, prefix, static)
            mount = Mount(found.link, found.T_link_frame[0], None)
            self.tracks[view] = found.T_link_frame
            self.streams.warn_once(
                f"view '{view}': its camera moves against every link of the robot; its poses in "
                f"'{found.link}' are those of /tf at each image"
            )
        else:
            mount = tree.mount(frame, links)
        if lens is not None:
            return lens.camera(view, mount.link, mount.T_link_frame)
        return CameraModel(
            view=view,
            width=1,
            height=1,
            K=np.eye(3),
            mount_link=mount.link,
            T_mount_camera=mount.T_link_frame,
        )

    def _placeholder(self, view: str, mount: str, images: Track) -> CameraModel:
        """Return a placeholder for a camera of unknown pose, and store what is unknown."""
        self.unknown[view] = 'pose' if self.intrinsics.of(view) else 'pose and intrinsics'
        height, width = images.frames[0].shape[:2]
        return unknown_camera(view, width, height, mount)


def _as_tf(given: FramePose) -> Any:
    """Return a given pose as TFMessage."""
    return messages.make_tf(1, given.parent, given.child, given.T_parent_child)


def _estimate(path: Path, view: str) -> str:
    """Return the advice for a camera of unknown pose: the command that estimates it."""
    return f'estimate it from the recording: mtv-world fit camera {path} --view {view} --no-guess'
