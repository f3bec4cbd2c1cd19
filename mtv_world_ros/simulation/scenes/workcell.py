"""Workcells: where a robot's arms rest and reach in the simulator, and what looks at them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field

from mtv_world_ros.core.config import Length, ListOf, Point, read_yaml, Schema, validated
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.core.files import bundled_names, share_path, WORKCELL_YAML
from mtv_world_ros.robot.arm_solver import ArmSolver
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.simulation.scenes.cameras import (
    AnyCameraSpec,
    camera_model,
    CameraSpec,
    WristCameraSpec,
)

#: width and height of the images of the cameras of a workcell, unless a scene draws others [px]
NOMINAL_SIZE = (384, 288)
#: a joint position; farther away is a wrong unit [rad or m]
_Joint = Annotated[float, Field(ge=-1000, le=1000)]


class ArmEntry(Schema):
    """One arm at rest."""

    home_tool: Point = Field(description='x, y, z of the tool at rest, where it points down [m]')
    home_joints: ListOf[_Joint] = Field(
        description="positions of the arm's joints near that pose, without the gripper's [rad or "
        'm]; a search for the pose starts there'
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacementConfig:
    """Limits of a feasible scene.

    Attributes:
        clearance: smallest gap between the outlines of two objects, room for a finger [m].
        reach: largest distance of a tool from its arm's base, seen from above, at the table [m].
        reach_above: largest such distance where the tool is higher, over or in an object [m].
        max_x: largest distance of a goal from the middle line of the table (x = 0), so that all
            views show it [m].
    """

    __pydantic_config__ = ConfigDict(extra='forbid')

    clearance: Length
    reach: Length
    reach_above: Length
    max_x: Length


class WorkcellFile(Schema):
    """A workcell file: where a robot's arms rest and reach in the simulator, and its cameras."""

    arms: Mapping[str, ArmEntry] = Field(
        description="arms at rest, by the robot's names and in its order"
    )
    finger_width_m: Length = Field(
        description="width of a finger tip across the fingers' travel [m]"
    )
    finger_thickness_m: Length = Field(
        description="thickness of a finger tip along the fingers' travel [m]"
    )
    placement: PlacementConfig = Field(description='limits of a feasible scene')
    cameras: ListOf[CameraSpec | WristCameraSpec] = Field(
        description='cameras before an episode moves them a little, in the order of the views'
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Workcell:
    """A robot's place in the simulator.

    Attributes:
        base_link: frame of all poses: x right, y away from the robot, z up from the table.
        bases: arm -> (x, y) of its first joint [m].
        home_tools: arm -> (3,) position of its tool at rest, pointing down [m].
        home_joints: arm -> joint positions near that pose, without the gripper [rad].
        finger_width_m: width of a finger tip, across the fingers' travel [m].
        finger_thickness_m: thickness of a finger tip, along the fingers' travel [m].
        placement: limits of its scenes.
        cameras: nominal cameras, in the order of the views.
        table_m: height of the table [m].
        object_size: factor of the objects' sizes.
    """

    base_link: str
    bases: dict[str, tuple[float, float]]
    home_tools: dict[str, FloatArray]
    home_joints: dict[str, FloatArray]
    finger_width_m: float
    finger_thickness_m: float
    placement: PlacementConfig
    cameras: tuple[AnyCameraSpec, ...]
    table_m: float = 0.0
    object_size: float = 1.0

    def arm_at(self, x: float) -> str:
        """Return the arm that handles an object at `x`: the one whose base is nearest."""
        # of two that are equally near the last one: the right arm handles what is in the middle
        return min(reversed(self.bases), key=lambda arm: abs(x - self.bases[arm][0]))


@lru_cache(maxsize=8)
def nominal_cameras(robot: RobotModel) -> dict[str, CameraModel]:
    """Return the cameras of a robot's workcell by view, as its `cameras.yaml` has them.

    Raises:
        SimulatorError: there is no workcell for this robot, or it is for other arms or joints.
        ConfigError: its file has unknown, missing or wrong values.
    """
    width, height = NOMINAL_SIZE
    return {
        spec.view: camera_model(spec, width, height, robot.base_link)
        for spec in workcell_of(robot).cameras
    }


def workcell_of(robot: RobotModel) -> Workcell:
    """Return the workcell of a robot: `workcell.yaml` in its folder, else in `config/robots/NAME`.

    Raises:
        SimulatorError: there is none for this robot, or it is for other arms or joints.
        ConfigError: its file has unknown, missing or wrong values.
    """
    folder = share_path('config', 'robots')
    path = folder / robot.name / WORKCELL_YAML
    if robot.file is not None and (robot.file.parent / WORKCELL_YAML).is_file():
        path = robot.file.parent / WORKCELL_YAML
    if not path.is_file():
        known = ', '.join(bundled_names('robots', WORKCELL_YAML))
        raise SimulatorError(
            f"robot '{robot.name}' has no workcell in the simulator; there are some for {known}; "
            f'one of your own stands in {WORKCELL_YAML} in the folder of its robot.yaml'
        )
    file = validated(WorkcellFile, read_yaml(path, 'workcell file', 'robot'), str(path))
    arms = [tool.arm for tool in robot.tools]
    if list(file.arms) != arms:
        raise SimulatorError(f"'{path}' has arms {list(file.arms)}, the robot has {arms}")
    for tool in robot.tools:
        names = [robot.joint_names[index] for index in ArmSolver(robot, tool).indices]
        count = len(file.arms[tool.arm].home_joints)
        if count != len(names):
            raise SimulatorError(
                f'{path}: arms.{tool.arm}.home_joints has {count} numbers; the arm has '
                f'{len(names)} joints without the gripper: {", ".join(names)}'
            )
    points = robot.kinematics(np.zeros((1, len(robot.joint_names)))).arm_points
    return Workcell(
        base_link=robot.base_link,
        bases={arm: _plane(chain[0, 0]) for arm, chain in zip(arms, points, strict=True)},
        home_tools={arm: np.asarray(entry.home_tool) for arm, entry in file.arms.items()},
        home_joints={
            arm: np.asarray(entry.home_joints, dtype=float) for arm, entry in file.arms.items()
        },
        finger_width_m=file.finger_width_m,
        finger_thickness_m=file.finger_thickness_m,
        placement=file.placement,
        cameras=file.cameras,
    )


def _plane(point: FloatArray) -> tuple[float, float]:
    return (float(point[0]), float(point[1]))
