"""Writes an episode as a rosbag2 MCAP folder."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from mtv_world_ros.cameras.calibration_file import save_calibration
from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray, JointTrajectory
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.images import encode_jpeg, encode_png
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.metadata import LATCHED
from mtv_world_ros.data.bag.writer import BagWriter
from mtv_world_ros.data.episode import (
    CALIBRATION_FILE,
    camera_info_topic,
    check_outcome,
    dump_info,
    EpisodeInfo,
    image_topic,
    INSTRUCTION,
    JOINT_STATES,
    JOINT_TRAJECTORY,
    mask_topic,
    METADATA_NAME,
    OBJECT_POSES,
    optical_frame,
    TF,
    TF_STATIC,
)


class EpisodeWriter(BagWriter):
    """Writer of an episode: frames, joint states, commands, masks and metadata.

    Log times equal the headers' stamps. Set `outcome` before the block ends.

    Args:
        path: folder to make.
        task: name of the task.
        instruction: text for the robot; `write_instruction` records it as a topic.
        robot: name of the robot.
        cameras: calibrated views, written to calibration.yaml in the folder; where CameraInfo is
            written, /tf_static gets the poses of those that stand still in their mount link.
        moving: views whose camera moves in its mount link, see `write_camera_pose`.
        seed: seed the episode is made from.
        objects: names of the objects; masks number them from 1.
        metadata: further text by key.
        jpeg_quality: 1 to 100.
        overwrite: replace an existing folder.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        task: str,
        instruction: str,
        robot: str,
        cameras: Sequence[CameraModel] = (),
        moving: Collection[str] = (),
        seed: int | None = None,
        objects: Sequence[str] = (),
        metadata: Mapping[str, str] | None = None,
        jpeg_quality: int = 90,
        overwrite: bool = False,
    ) -> None:
        super().__init__(path, overwrite=overwrite)
        self.task, self.instruction, self.robot = task, instruction, robot
        self.seed, self.objects = seed, tuple(objects)
        self.outcome = 'unknown'
        self.metadata: dict[str, str] = dict(metadata or {})
        self._jpeg_quality = jpeg_quality
        self._still = [camera for camera in cameras if camera.view not in moving]
        if cameras:
            by_view = {camera.view: camera for camera in cameras}
            try:
                save_calibration(self.folder / CALIBRATION_FILE, by_view)
            except BaseException:
                self.abort()  # no caller has this writer to close it
                raise

    def write_image(
        self, view: str, stamp_ns: int, rgb: ByteArray, *, compressed: bool = True
    ) -> None:
        """Record a frame, (H, W, 3) uint8 RGB, as JPEG or raw rgb8."""
        if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
            raise EpisodeError(
                f"view '{view}': frame is {rgb.shape} {rgb.dtype}, expected (H, W, 3) uint8"
            )
        frame = optical_frame(view)
        if compressed:
            data = encode_jpeg(rgb, self._jpeg_quality)
            topic, kind = f'{image_topic(view)}/compressed', messages.COMPRESSED_IMAGE
            message = messages.make_compressed(stamp_ns, frame, data)
        else:
            topic, kind = image_topic(view), messages.IMAGE
            message = messages.make_image(stamp_ns, frame, rgb)
        self.write_message(topic, kind, stamp_ns, message)

    def write_mask(self, view: str, stamp_ns: int, ids: ByteArray) -> None:
        """Record object masks, (H, W) uint8: 0 = none, i + 1 = objects[i]."""
        if ids.dtype != np.uint8 or ids.ndim != 2:
            raise EpisodeError(
                f"view '{view}': mask is {ids.shape} {ids.dtype}, expected (H, W) uint8"
            )
        message = messages.make_compressed(
            stamp_ns, optical_frame(view), encode_png(ids), messages.PNG_LABELS
        )
        self.write_message(mask_topic(view), messages.COMPRESSED_IMAGE, stamp_ns, message)

    def write_camera_info(self, view: str, stamp_ns: int, camera: CameraModel) -> None:
        """Record the view's intrinsics; the first ones with the poses of all still cameras."""
        if self._still:  # in one message, as a latched topic keeps the last one alone
            transforms = [
                messages.make_transform(
                    stamp_ns, still.mount_link, optical_frame(still.view), still.T_mount_camera
                )
                for still in self._still
            ]
            self._still = []
            self.declare(TF_STATIC, messages.TF_MESSAGE, LATCHED)
            static = messages.make(messages.TF_MESSAGE, transforms=transforms)
            self.write_message(TF_STATIC, messages.TF_MESSAGE, stamp_ns, static)
        message = messages.make_camera_info(stamp_ns, camera, optical_frame(view))
        self.write_message(camera_info_topic(view), messages.CAMERA_INFO, stamp_ns, message)

    def write_camera_pose(
        self, view: str, stamp_ns: int, mount_link: str, T_mount_camera: FloatArray
    ) -> None:
        """Record where a camera is that moves against the robot's links, (4, 4) [m]."""
        message = messages.make_tf(stamp_ns, mount_link, optical_frame(view), T_mount_camera)
        self.write_message(TF, messages.TF_MESSAGE, stamp_ns, message)

    def write_joint_states(
        self,
        stamp_ns: int,
        names: Sequence[str],
        positions: ArrayLike,
        velocities: ArrayLike | None = None,
    ) -> None:
        """Record measured positions (J,) [rad or m] and, if known, velocities (J,)."""
        message = messages.make_joint_state(stamp_ns, names, positions, velocities)
        self.write_message(JOINT_STATES, messages.JOINT_STATE, stamp_ns, message)

    def write_trajectory(self, stamp_ns: int, trajectory: JointTrajectory) -> None:
        """Record a commanded trajectory that starts at `stamp_ns`."""
        message = messages.make_joint_trajectory(stamp_ns, trajectory)
        self.write_message(JOINT_TRAJECTORY, messages.JOINT_TRAJECTORY, stamp_ns, message)

    def write_object_poses(self, stamp_ns: int, T_base_object: ArrayLike) -> None:
        """Record object poses (O, 4, 4) in the order of their names [m]."""
        message = messages.make_pose_array(stamp_ns, 'base_link', T_base_object)
        self.write_message(OBJECT_POSES, messages.POSE_ARRAY, stamp_ns, message)

    def write_instruction(self, stamp_ns: int, text: str | None = None) -> None:
        """Record the instruction (latched); by default the episode's own."""
        self.declare(INSTRUCTION, messages.STRING, LATCHED)
        message = messages.make(messages.STRING, data=self.instruction if text is None else text)
        self.write_message(INSTRUCTION, messages.STRING, stamp_ns, message)

    def close(self) -> None:
        """Finish the record; raise EpisodeError where `outcome` is not a known word."""
        try:
            self._describe()
        except BaseException:
            self.abort()
            raise
        super().close()

    def _describe(self) -> None:
        info = EpisodeInfo(
            path=self.path,
            task=self.task,
            outcome=check_outcome(self.outcome),
            seed=self.seed,
            objects=self.objects,
            instruction=self.instruction,
            robot=self.robot,
            metadata=self.metadata,
        )
        self.set_metadata(METADATA_NAME, dump_info(info))
