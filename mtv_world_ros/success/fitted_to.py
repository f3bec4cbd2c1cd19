"""What a calibration was fitted to: foresight, robot and cameras; elsewhere it is none."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Self

import numpy as np
from pydantic import model_validator

from mtv_world_ros.config import ListOf, Metres, Number, Schema
from mtv_world_ros.data_types import CameraModel, FloatArray
from mtv_world_ros.geometry.robot.model import RobotModel

#: a calibrated arm differs from the nominal one by less [m]
ROBOT_SLACK_M = 0.03
#: beyond the cameras of the fit: metres, of a direction's unit vector, of the image's width
_CAMERA_SLACK = np.repeat([0.03, 0.05, 0.05], (3, 6, 1))


def _placement(camera: CameraModel) -> FloatArray:
    """(10,) position [m], direction, what is right in the image, focal length in widths."""
    pose = camera.T_mount_camera
    return np.array([*pose[:3, 3], *pose[:3, 2], *pose[:3, 0], camera.K[0, 0] / camera.width])


class CameraRange(Schema):
    """Within what the cameras of a view stood; each row as in `_placement`.

    Attributes:
        mount_link: link that carries them.
        low: (10,) smallest.
        high: (10,) largest.
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
        """Returns the range of one view's cameras, which one link carries."""
        rows = np.stack([_placement(camera) for camera in cameras])
        return cls(
            mount_link=cameras[0].mount_link,
            low=tuple(rows.min(0).tolist()),
            high=tuple(rows.max(0).tolist()),
        )

    def holds(self, camera: CameraModel) -> bool:
        """Whether a camera stands where those of the fit did, within a small distance."""
        row = _placement(camera)
        below, above = np.array(self.low) - _CAMERA_SLACK, np.array(self.high) + _CAMERA_SLACK
        is_inside = bool(np.all((row >= below) & (row <= above)))
        return camera.mount_link == self.mount_link and is_inside


class Setting(Schema):
    """Where estimates are made.

    Attributes:
        foresight: digest of the numbers of contact and of the arms' response; empty = none.
        robot: its name.
        tools: (A, 3) where its tools are with all joints at 0 [m].
    """

    foresight: str = ''
    robot: str
    tools: ListOf[ListOf[Metres]]

    @classmethod
    def of(cls, robot: RobotModel, foresight: str = '') -> Setting:
        """Returns that of a robot."""
        tools = robot.tool_poses(np.zeros((1, len(robot.joint_names))))[:, 0, :3, 3]
        return cls(foresight=foresight, robot=robot.name, tools=tuple(map(tuple, tools.tolist())))

    def is_same_robot(self, other: Setting) -> bool:
        """Whether tools are where the other's are, within what calibrating an arm changes."""
        mine, theirs = np.array(self.tools), np.array(other.tools)
        return (
            self.robot == other.robot
            and mine.shape == theirs.shape
            and bool(np.all(np.abs(mine - theirs) <= ROBOT_SLACK_M))
        )


class FittedTo(Setting):
    """Where the episodes of a calibration were imagined.

    Attributes:
        cameras: of every view.
    """

    cameras: Mapping[str, CameraRange]

    @classmethod
    def episodes(cls, setting: Setting, sets: Iterable[Sequence[CameraModel]]) -> FittedTo:
        """Returns that of episodes.

        Args:
            setting: of all of them.
            sets: cameras of each.
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
        """Returns how a setting differs; empty = it does not.

        Args:
            setting: where the estimate is made.
            cameras: that the estimate is made from.
            is_foreseen: the estimate rests on foreseen motions.
        """
        if not self.is_same_robot(setting):
            return f"fitted with another robot than this '{setting.robot}'"
        if is_foreseen and setting.foresight != self.foresight:
            return 'fitted with another foresight: other numbers of contact or of the arms'
        strange = [
            camera.view
            for camera in cameras
            if camera.view not in self.cameras or not self.cameras[camera.view].holds(camera)
        ]
        return f'fitted with other cameras of {", ".join(strange)}' if strange else ''
