"""Foresight, robot and cameras of the episodes that a calibration was fitted to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Self

import numpy as np
from pydantic import model_validator

from mtv_world_ros.core.config import ListOf, Metres, Number, Schema
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.robot.model import RobotModel

#: largest distance between the tools of a calibrated and of the nominal arm [m]
ROBOT_SLACK_M = 0.03
#: tolerances around the cameras of the fit: position [m], axes (unit vectors), focal length
#: [image widths]
_CAMERA_SLACK = np.repeat([0.03, 0.05, 0.05], (3, 6, 1))


def _placement(camera: CameraModel) -> FloatArray:
    """Return (10,) position [m], optical axis, x axis, focal length [image widths]."""
    pose = camera.T_mount_camera
    return np.array([*pose[:3, 3], *pose[:3, 2], *pose[:3, 0], camera.K[0, 0] / camera.width])


class CameraRange(Schema):
    """Range of camera poses and intrinsics of one view, in the quantities of `_placement`.

    Attributes:
        mount_link: link that carries the cameras.
        low: (10,) smallest values.
        high: (10,) largest values.
    """

    mount_link: str
    low: ListOf[Number]
    high: ListOf[Number]

    @model_validator(mode='after')
    def _are_whole(self) -> Self:
        if {len(self.low), len(self.high)} != {len(_CAMERA_SLACK)}:
            raise ValueError(f'low and high of a camera have {len(_CAMERA_SLACK)} numbers each')
        return self

    @classmethod
    def of(cls, cameras: Sequence[CameraModel]) -> CameraRange:
        """Return the range of cameras of one view on one link."""
        rows = np.stack([_placement(camera) for camera in cameras])
        return cls(
            mount_link=cameras[0].mount_link,
            low=tuple(rows.min(0).tolist()),
            high=tuple(rows.max(0).tolist()),
        )

    def holds(self, camera: CameraModel) -> bool:
        """Return True if a camera is within the range, up to the tolerances."""
        row = _placement(camera)
        below, above = np.array(self.low) - _CAMERA_SLACK, np.array(self.high) + _CAMERA_SLACK
        is_inside = bool(np.all((row >= below) & (row <= above)))
        return camera.mount_link == self.mount_link and is_inside


class Setting(Schema):
    """Robot and foresight of a success estimate.

    Attributes:
        foresight: digest of the contact settings and the arms' response; empty = none.
        robot: name of the robot.
        tools: (A, 3) positions of its tools with all joints at 0 [m].
    """

    foresight: str = ''
    robot: str
    tools: ListOf[ListOf[Metres]]

    @classmethod
    def of(cls, robot: RobotModel, foresight: str = '') -> Setting:
        """Return the setting of a robot."""
        tools = robot.tool_poses(np.zeros((1, len(robot.joint_names))))[:, 0, :3, 3]
        return cls(foresight=foresight, robot=robot.name, tools=tuple(map(tuple, tools.tolist())))

    def is_same_robot(self, other: Setting) -> bool:
        """Return True if the tools of both settings agree, up to changes by a calibration."""
        mine, theirs = np.array(self.tools), np.array(other.tools)
        return (
            self.robot == other.robot
            and mine.shape == theirs.shape
            and bool(np.all(np.abs(mine - theirs) <= ROBOT_SLACK_M))
        )


class FittedTo(Setting):
    """Setting and cameras of the episodes of a calibration.

    Attributes:
        cameras: range of the cameras by view.
    """

    cameras: Mapping[str, CameraRange]

    @classmethod
    def episodes(cls, setting: Setting, sets: Iterable[Sequence[CameraModel]]) -> FittedTo:
        """Return the robot, foresight and cameras that episodes were made with.

        Args:
            setting: setting of all episodes.
            sets: cameras of each episode.
        """
        views: dict[str, list[CameraModel]] = {}
        for cameras in sets:
            for camera in cameras:
                views.setdefault(camera.view, []).append(camera)
        ranges = {view: CameraRange.of(cameras) for view, cameras in views.items()}
        return cls(**setting.model_dump(), cameras=ranges)

    def objection(
        self, setting: Setting, cameras: Sequence[CameraModel], *, is_foreseen: bool
    ) -> str:
        """Return how a setting differs; empty = it does not.

        Args:
            setting: setting of the estimate.
            cameras: cameras that the estimate is made from.
            is_foreseen: the estimate rests on foreseen motions.
        """
        if not self.is_same_robot(setting):
            return f"fitted with another robot than this '{setting.robot}'"
        if is_foreseen and setting.foresight != self.foresight:
            return 'fitted with another foresight: other numbers of contact or of the arms'
        others = [
            camera.view
            for camera in cameras
            if camera.view not in self.cameras or not self.cameras[camera.view].holds(camera)
        ]
        return f'fitted with other cameras of {", ".join(others)}' if others else ''
