"""Poses of a robot, its tools and the cameras along joint positions, computed once for all uses.

V views, N states, J joints, A arms, L links.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from mtv_world_ros.cameras.camera import check_mount, project
from mtv_world_ros.core.data_types import BoolArray, CameraModel, FloatArray, freeze_array
from mtv_world_ros.core.errors import CalibrationError, RobotError
from mtv_world_ros.robot.model import RobotModel


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Poses of links, tools and cameras in the base frame, and gripper openings, at N states.

    `Motion.of` computes them in one pass of forward kinematics.

    Attributes:
        robot: the robot that moves.
        cameras: calibrated cameras of the V views.
        positions: (N, J) joint positions [rad or m].
        links: (N, 4, 4) T_base_link of each link that was asked for, by its name [m].
        arm_points: (P, N, 3) origins of the joints and the tool centre point of each arm [m].
        tools: (A, N, 4, 4) T_base_tool of the tool centre points [m].
        camera_poses: (V, N, 4, 4) T_base_camera [m].
        openings: (A, N) gripper openings, 0 closed to 1 open; 1 where there is no gripper.
    """

    robot: RobotModel
    cameras: tuple[CameraModel, ...]
    positions: FloatArray
    links: Mapping[str, FloatArray]
    arm_points: tuple[FloatArray, ...]
    tools: FloatArray
    camera_poses: FloatArray
    openings: FloatArray

    def __post_init__(self) -> None:
        num_arms, num_joints = len(self.robot.tools), len(self.robot.joint_names)
        object.__setattr__(self, 'cameras', tuple(self.cameras))
        freeze_array(self, 'positions', (None, num_joints), np.float64, RobotError)
        num = len(self.positions)
        freeze_array(self, 'tools', (num_arms, num, 4, 4), np.float64, RobotError)
        freeze_array(self, 'openings', (num_arms, num), np.float64, RobotError)
        shape = (len(self.cameras), num, 4, 4)
        freeze_array(self, 'camera_poses', shape, np.float64, CalibrationError)
        object.__setattr__(self, 'links', MappingProxyType(dict(self.links)))

    @classmethod
    def of(
        cls,
        robot: RobotModel,
        cameras: Iterable[CameraModel],
        positions: FloatArray,
        links: Iterable[str] = (),
    ) -> Motion:
        """Return the motion of a robot and its cameras along positions (N, J) [rad or m].

        Args:
            robot: robot whose kinematics are used.
            cameras: calibrated cameras of the V views, fixed or carried by a link.
            positions: (N, J) [rad or m].
            links: names of further links whose poses are wanted, e.g. to draw them.

        Raises:
            CalibrationError: a joint that is not among the robot's carries a camera.
            RobotError: there is no such link, or the positions have another shape.
        """
        cameras = tuple(cameras)
        for camera in cameras:
            check_mount(camera, robot)
        mounts = [camera.mount_link for camera in cameras if camera.mount_link != robot.base_link]
        poses = robot.kinematics(positions, tuple(dict.fromkeys([*mounts, *links])))
        carried = [
            np.repeat(camera.T_mount_camera[None], len(positions), axis=0)
            if camera.mount_link == robot.base_link
            else poses.links[camera.mount_link] @ camera.T_mount_camera
            for camera in cameras
        ]
        return cls(
            robot=robot,
            cameras=cameras,
            positions=positions,
            links=poses.links,
            arm_points=poses.arm_points,
            tools=poses.tools,
            camera_poses=np.stack(carried) if carried else np.empty((0, len(positions), 4, 4)),
            openings=robot.gripper_openings(positions),
        )

    @property
    def tool_points(self) -> FloatArray:
        """(A, N, 3) tool centre points in the base frame [m]."""
        return self.tools[..., :3, 3]

    def first(self, num_states: int) -> Motion:
        """Return the motion through the first states."""
        return self._part(slice(0, num_states))

    def after_first(self) -> Motion:
        """Return the motion through all states but the first."""
        return self._part(slice(1, None))

    def last(self) -> Motion:
        """Return the last state."""
        return self._part(slice(-1, None))

    def _part(self, kept: slice) -> Motion:
        return replace(
            self,
            positions=self.positions[kept],
            links={name: poses[kept] for name, poses in self.links.items()},
            arm_points=tuple(points[:, kept] for points in self.arm_points),
            tools=self.tools[:, kept],
            camera_poses=self.camera_poses[:, kept],
            openings=self.openings[:, kept],
        )

    def tools_in_view(self) -> FloatArray:
        """Return (V,) the fraction of the states in which each view shows a tool of any arm.

        Raises:
            CalibrationError: a tool is not in the image, but would be in its inner half without
                the lens' distortion, which no lens does: the distortion is wrong.
        """
        shown = [self._shows_tool(view) for view in range(len(self.cameras))]
        return np.array([seen.any(axis=0).mean() for seen in shown])

    def _shows_tool(self, view: int) -> BoolArray:
        """Return (A, N) whether the tool is in the image."""
        camera = self.cameras[view]
        seen = self._is_within(camera, view, 0.0)
        pinhole = replace(camera, distortion_model='none', distortion=np.zeros(0))
        if (self._is_within(pinhole, view, 0.25) & ~seen).any():
            raise CalibrationError(
                f"the tool should be in the middle of view '{camera.view}', but its distortion "
                f'{camera.distortion.tolist()} moves it out of the image; calibrate the lens again'
            )
        return seen

    def _is_within(self, camera: CameraModel, view: int, margin: float) -> BoolArray:
        """(A, N) whether the tool is in the image, a margin from its edges [fraction of size]."""
        size = np.array([camera.width, camera.height])
        pixels, _ = project(camera, self.camera_poses[view], self.tool_points)
        with np.errstate(invalid='ignore'):  # NaN: not in front of the camera
            inside = np.abs(pixels - (size - 1) / 2) <= (0.5 - margin) * size
        return np.asarray(inside.all(axis=-1))
