"""Columns of a data set that are tool poses, and the joints for measured ones.

T rows, C columns, J joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, Self

import numpy as np
import pinocchio as pin
from pydantic import Field, model_validator

from mtv_world_ros.core.config import expected, ListOf
from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import EpisodeError, TrajectoryError
from mtv_world_ros.core.transforms import rotation
from mtv_world_ros.data.tool_targets import ToolTargets
from mtv_world_ros.robot.arm_solver import ArmSolver
from mtv_world_ros.robot.joint_columns import column_number, UNITS
from mtv_world_ros.robot.model import RobotModel, Tool

Column = Annotated[int | str, expected('a name or a number')]

#: number of postures from which the inverse kinematics of the first pose starts
_NUM_STARTS = 24
#: maximum fraction of the poses that may be out of reach
_MAX_LOST_FRACTION = 0.2
_HINT = 'are frame, link, unit and rotation_is right?'


class ToolPoses(ToolTargets):
    """Columns of a target pose of an arm's tool."""

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

    @property
    def has_rotation(self) -> bool:
        """True if columns give the rotation of the tool."""
        return bool(self.rotation)

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

    def wanted(self, values: FloatArray, names: Sequence[str], feature: str) -> FloatArray:
        """Return (T, 4, 4) poses or differences of a feature's values (T, C).

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
        """Return (3, 3)."""
        if self.rotation_is == 'quaternion_xyzw':
            return rotation(row)
        if self.rotation_is == 'quaternion_wxyz':
            return rotation(np.roll(row, -1))
        angles = row * UNITS[self.angle_unit] * self.scale[1]
        if self.rotation_is == 'rpy':
            return np.asarray(pin.rpy.rpyToMatrix(angles))
        return np.asarray(pin.exp3(angles))


def joints_of_poses(
    positions: FloatArray,
    robot: RobotModel,
    arm: str,
    poses: ToolPoses,
    wanted: FloatArray,
) -> str:
    """Write an arm's joints for measured poses (T, 4, 4) of its tool into `positions` (T, J).

    Of the solutions of the first pose, the one nearest to the middle of the limits is taken;
    each later one is the nearest to the one before. An arm of more than six joints has more
    freedom than a pose tells: its elbow is where the least motion brings it, not where it was.

    Returns:
        What is left of the poses, in words.

    Raises:
        EpisodeError: poses are differences, or too many are out of reach.
    """
    if poses.difference:
        raise EpisodeError(f"arm '{arm}': measured poses are no differences; 'difference' is set")
    tool = poses.check(arm, robot)
    solver = ArmSolver(robot, tool)
    T_base_frame = robot.link_poses(poses.frame or robot.base_link, positions)
    goals = T_base_frame @ wanted
    row, lost = _first(solver, robot, goals[0]), 0
    if row is None:
        raise EpisodeError(f"arm '{arm}': its first pose is out of reach: {_HINT}")
    for k, goal in enumerate(goals):
        try:
            row = solver.solve(goal, row)
        except TrajectoryError:
            lost += 1
        positions[k, solver.indices] = row
    if lost > _MAX_LOST_FRACTION * len(goals):
        raise EpisodeError(f"arm '{arm}': {lost} of {len(goals)} poses are out of reach: {_HINT}")
    mm, degrees = _left(positions, robot, tool, goals)
    free = ''
    if len(solver.indices) > 6:
        free = '; its elbow is a guess: a pose does not tell it'
    return (
        f"arm '{arm}': joints by inverse kinematics, {lost} of {len(goals)} poses out of reach, "
        f'{np.median(mm):.2f} mm and {np.median(degrees):.2f} degrees left in the median, '
        f'{mm.max():.1f} mm and {degrees.max():.1f} degrees at most{free}'
    )


def _first(solver: ArmSolver, robot: RobotModel, goal: FloatArray) -> FloatArray | None:
    """Return the solution nearest to the middle of the limits; None where there is none."""
    lower = np.maximum(robot.lower[solver.indices], -np.pi)
    upper = np.minimum(robot.upper[solver.indices], np.pi)
    middle, generator = (lower + upper) / 2, np.random.default_rng(0)
    starts = [middle, *generator.uniform(lower, upper, (_NUM_STARTS, len(middle)))]
    solutions = []
    for start in starts:
        try:
            found = solver.solve(goal, start)
        except TrajectoryError:
            continue
        solutions.append(found)
    return min(solutions, key=lambda row: float(np.abs(row - middle).sum()), default=None)


def _left(
    positions: FloatArray, robot: RobotModel, tool: Tool, goals: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return (T,) distances of the solved poses from the measured ones [mm, degrees]."""
    reached = robot.link_poses(tool.link, positions) @ tool.T_link_tool
    apart = np.linalg.inv(reached) @ goals
    cosine = (np.trace(apart[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    mm = 1000 * np.linalg.norm(apart[:, :3, 3], axis=1)
    return mm, np.degrees(np.arccos(np.clip(cosine, -1, 1)))
