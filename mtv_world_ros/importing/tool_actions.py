"""Actions that are tool poses, or differences: how a mapping names them, and their joints.

T rows, C columns, J joints, n joints of an arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Literal, Self

import numpy as np
import pinocchio as pin
from pydantic import Field, model_validator

from mtv_world_ros.config import expected, ListOf, Pair, Schema
from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import EpisodeError, nearest, TrajectoryError
from mtv_world_ros.geometry.arm_solver import ArmSolver
from mtv_world_ros.geometry.joint_columns import column_number, UNITS
from mtv_world_ros.geometry.robot import RobotModel, Tool
from mtv_world_ros.geometry.transforms import rotation

Column = Annotated[int | str, expected('a name or a number')]
#: share of the poses that may be out of reach before the episode fails
_MOST_OUT_OF_REACH = 0.5


class ToolPoses(Schema):
    """Columns that say where an arm's tool shall be."""

    position: ListOf[Column] = Field(description='columns of x, y, z')
    rotation: ListOf[Column] = Field(
        default=(), description='columns of the rotation; empty = the tool keeps its own'
    )
    rotation_is: Literal['rotation_vector', 'rpy', 'quaternion_xyzw', 'quaternion_wxyz'] = Field(
        default='rotation_vector',
        description='axis times angle; roll, pitch, yaw about fixed x, y, z; or a quaternion',
    )
    unit: Literal['m', 'cm', 'mm'] = Field(default='m', description='of the position')
    angle_unit: Literal['rad', 'deg'] = Field(default='rad', description='of the rotation')
    scale: Pair = Field(
        default=(1.0, 1.0), description='factors of position and rotation (of a controller)'
    )
    difference: Literal['', 'fixed', 'tool'] = Field(
        default='',
        description='empty = poses; else added to the measured pose of the row: along the axes '
        'of `frame` (fixed), or of the tool',
    )
    frame: str = Field(default='', description='link that poses are in; empty = the base link')
    link: str = Field(default='', description='whose pose it is; empty = the tool point')

    @model_validator(mode='after')
    def _has_all_columns(self) -> Self:
        if len(self.position) != 3:
            raise ValueError(f"'position' has {len(self.position)} columns, must be x, y, z")
        count = 4 if self.rotation_is.startswith('quaternion') else 3
        if self.rotation and len(self.rotation) != count:
            raise ValueError(
                f"'rotation' has {len(self.rotation)} columns, {self.rotation_is} has {count}"
            )
        return self

    def check(self, arm: str, robot: RobotModel) -> Tool:
        """Returns the tool, whose point is the one that the poses are of.

        Raises:
            ValueError: the robot has no such arm or link.
        """
        tools = {tool.arm: tool for tool in robot.tools}
        if arm not in tools:
            raise ValueError(
                f"tools: robot '{robot.name}' has no arm '{arm}'{nearest(arm, tools)}; it has "
                f'{", ".join(tools)}'
            )
        for link in filter(None, (self.frame, self.link)):
            if link not in robot.link_names:
                raise ValueError(
                    f"tools: robot '{robot.name}' has no link '{link}'"
                    f'{nearest(link, robot.link_names)}'
                )
        if not self.link:
            return tools[arm]
        return replace(tools[arm], link=self.link, T_link_tool=np.eye(4))

    def wanted(self, values: FloatArray, names: Sequence[str], feature: str) -> FloatArray:
        """(T, 4, 4) poses or differences of a feature's values (T, C).

        Raises:
            ConfigError: a column is not there.
            EpisodeError: a rotation is none.
        """
        poses = np.tile(np.eye(4), (len(values), 1, 1))

        def columns(chosen: Sequence[int | str]) -> FloatArray:
            count = values.shape[1]
            at = [column_number(c, names, count, feature, 'a tool pose') for c in chosen]
            return values[:, at]

        poses[:, :3, 3] = columns(self.position) * UNITS[self.unit] * self.scale[0]
        if self.rotation:
            try:
                poses[:, :3, :3] = [self._turn(row) for row in columns(self.rotation)]
            except ValueError as error:
                raise EpisodeError(f"feature '{feature}': {error}") from error
        return poses

    def _turn(self, row: FloatArray) -> FloatArray:
        """(3, 3)."""
        if self.rotation_is == 'quaternion_xyzw':
            return rotation(row)
        if self.rotation_is == 'quaternion_wxyz':
            return rotation(np.roll(row, -1))
        angles = row * UNITS[self.angle_unit] * self.scale[1]
        if self.rotation_is == 'rpy':
            return np.asarray(pin.rpy.rpyToMatrix(angles))
        return np.asarray(pin.exp3(angles))


def led_joints(tools: dict[str, ToolPoses], robot: RobotModel) -> set[str]:
    """Returns the joints whose positions follow from tool poses.

    Raises:
        ValueError: the robot has no such arm or link.
    """
    solvers = [ArmSolver(robot, poses.check(arm, robot)) for arm, poses in tools.items()]
    return {robot.joint_names[index] for solver in solvers for index in solver.indices}


def add_tool_poses(
    positions: FloatArray,
    measured: FloatArray,
    robot: RobotModel,
    arm: str,
    poses: ToolPoses,
    wanted: FloatArray,
) -> str:
    """Writes an arm's joints for poses of its tool into `positions` (T, J).

    Each solution is the one nearest to the row's measured joints. A pose out of reach is replaced
    by the measured positions of the row that follows.

    Args:
        positions: to be changed.
        measured: (T, J).
        robot: the robot.
        arm: whose tool it is.
        poses: what the poses mean.
        wanted: (T, 4, 4) as by `ToolPoses.wanted`.

    Returns:
        How many poses are out of reach, in words; empty where none is.

    Raises:
        EpisodeError: most of them are.
    """
    tool = poses.check(arm, robot)
    solver, lost = ArmSolver(robot, tool), 0
    goals = _goals(measured, robot, tool, poses, wanted)
    for k, goal in enumerate(goals):
        try:
            row = solver.solve(goal, measured[k, solver.indices])
        except TrajectoryError:
            row = measured[min(k + 1, len(measured) - 1), solver.indices]
            lost += 1
        positions[k, solver.indices] = row
    text = f"arm '{arm}': {lost} of {len(goals)} poses are out of reach"
    if lost > _MOST_OUT_OF_REACH * len(goals):
        raise EpisodeError(f'{text}: are frame, link, unit, scale and rotation_is right?')
    return f'{text}; the measured positions that follow stand in' if lost else ''


def _goals(
    measured: FloatArray, robot: RobotModel, tool: Tool, poses: ToolPoses, wanted: FloatArray
) -> FloatArray:
    """(T, 4, 4) of the tool in the base link."""
    frame = poses.frame or robot.base_link
    T_base_frame = robot.link_poses(frame, measured)
    now = np.linalg.inv(T_base_frame) @ robot.link_poses(tool.link, measured) @ tool.T_link_tool
    if poses.difference == 'tool':
        goals = now @ wanted
    elif poses.difference == 'fixed':
        goals = wanted @ now  # turns about the frame's axes ...
        goals[:, :3, 3] = now[:, :3, 3] + wanted[:, :3, 3]  # ... through the tool's own point
    else:
        goals = wanted.copy()
        if not poses.rotation:
            goals[:, :3, :3] = now[:, :3, :3]
    return T_base_frame @ goals
