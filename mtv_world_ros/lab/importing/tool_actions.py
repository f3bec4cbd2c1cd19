"""Columns of a data set that are tool poses or differences of them.

T rows, C columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, Self

import numpy as np
import pinocchio as pin
from pydantic import Field, model_validator

from mtv_world_ros.config import expected, ListOf
from mtv_world_ros.data.tool_targets import ToolTargets
from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import EpisodeError
from mtv_world_ros.geometry.robot.joint_columns import column_number, UNITS
from mtv_world_ros.geometry.transforms import rotation

Column = Annotated[int | str, expected('a name or a number')]


class ToolPoses(ToolTargets):
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

    @property
    def has_rotation(self) -> bool:
        """Whether columns say how the tool turns."""
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
