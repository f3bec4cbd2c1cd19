"""Mapping of columns (of a data set or a policy server's vectors) to the robot's joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator, PrivateAttr, ValidationInfo

from mtv_world_ros.core.config import expected, Number, Pair, Schema
from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import ConfigError, UnknownNameError
from mtv_world_ros.robot.model import RobotModel

#: factor to rad or m
UNITS = {'rad': 1.0, 'm': 1.0, 'deg': np.pi / 180, 'cm': 0.01, 'mm': 0.001}
Unit = Literal['rad', 'm', 'deg', 'cm', 'mm']
_LINEAR = {'unit', 'sign', 'offset'}


@dataclass(frozen=True, slots=True, kw_only=True)
class JointColumn:
    """One joint: `factor * column + offset` [rad or m]; the offset alone where column is None.

    Attributes:
        joint: name in the robot.
        column: name or number of the column in the dataset's feature.
        factor: factor from the dataset's unit, sign included.
        offset: [rad or m].
    """

    joint: str
    column: str | int | None
    factor: float = 1.0
    offset: float = 0.0


class ColumnEntry(Schema):
    """Source of a joint's values: a column with unit, sign and offset, or with a range."""

    column: Annotated[int | str | None, expected('a name or a number')] = Field(
        default=None, description='name or number of the column'
    )
    unit: Unit | None = Field(default=None, description="null = that of the joints' table")
    sign: float = Field(default=1, ge=-1, le=1, description='1 or -1')
    offset: Number = Field(default=0.0, description='added last [rad or m]')
    closed: Number | None = Field(default=None, description="a gripper's value in the dataset")
    open: Number | None = Field(default=None, description="a gripper's value in the dataset")
    from_: Pair | None = Field(default=None, alias='from', description='values in the dataset')
    to: Pair | None = Field(default=None, description='what `from` means [rad or m]')
    constant: Number | None = Field(default=None, description='instead of a column [rad or m]')

    @model_validator(mode='after')
    def _keys_go_together(self) -> Self:
        given = {name.rstrip('_') for name in self.model_fields_set}
        if 'constant' in given and len(given) > 1:
            raise ValueError(f"'constant' stands alone, got {sorted(given)}")
        if 'constant' not in given and self.column is None:
            raise ValueError("'column' is None, must be a name or a number")
        if abs(self.sign) != 1:
            raise ValueError(f"'sign' is {self.sign:g}, must be 1 or -1")
        given -= {'column', 'constant'}
        if not given <= _LINEAR and given not in ({'from', 'to'}, {'closed', 'open'}):
            raise ValueError(
                f"{sorted(given)} do not go together; give 'unit', 'sign', 'offset', or 'closed' "
                "and 'open', or 'from' and 'to'"
            )
        low, high = self.from_ or (self.closed, self.open)
        if low is not None and low == high:
            raise ValueError(f'both ends of the range are {low:g}')
        return self

    def of(self, joint: str, unit: Unit, robot: RobotModel) -> JointColumn:
        """Return the column of a joint of a robot with its factor; `unit` is the default unit."""
        if self.column is None:
            return JointColumn(joint=joint, column=None, offset=self.constant or 0.0)
        if self.from_ and self.to:
            (a, b), (c, d) = self.from_, self.to
        elif self.closed is not None and self.open is not None:
            tool = next((t for t in robot.tools if t.gripper_joint == joint), None)
            if tool is None:
                raise ValueError("'closed' and 'open' are for grippers; use 'from', 'to'")
            a, b, c, d = self.closed, self.open, tool.gripper_closed, tool.gripper_open
        else:
            factor = UNITS[self.unit or unit] * self.sign
            return JointColumn(joint=joint, column=self.column, factor=factor, offset=self.offset)
        factor = (d - c) / (b - a)
        return JointColumn(joint=joint, column=self.column, factor=factor, offset=c - factor * a)


def _entry(value: Any) -> Any:
    is_column = isinstance(value, str | int) and not isinstance(value, bool)
    return {'column': value} if is_column else value


JointEntries = dict[str, Annotated[ColumnEntry, BeforeValidator(_entry)]]


class JointTable(Schema):
    """Column of each joint of the robot; validated with `robot` in the context.

    An entry is a column (name or number) or a `ColumnEntry`. Without `joints` the columns have
    the joints' names.
    """

    allow_missing: ClassVar[bool] = False

    unit: Unit = Field(default='rad', description='unit of joints without one of their own')
    joints: JointEntries | None = Field(
        description='column of each joint: its name or number, or a mapping; null = columns have '
        'the names of the joints'
    )
    _columns: tuple[JointColumn, ...] = PrivateAttr(default=())
    _joint_names: tuple[str, ...] = PrivateAttr(default=())

    @property
    def columns(self) -> tuple[JointColumn, ...]:
        """One a joint, in the robot's order."""
        return self._columns

    @model_validator(mode='after')
    def _fits_the_robot(self, info: ValidationInfo) -> Self:
        robot: RobotModel | None = info.context and info.context.get('robot')
        if robot is not None:  # else the robot's own error is reported
            self._columns, self._joint_names = self._of(robot), robot.joint_names
        return self

    def _needed(self, robot: RobotModel) -> Sequence[str]:
        """Return the joints that must have a column."""
        return () if self.allow_missing else robot.joint_names

    def _of(self, robot: RobotModel) -> tuple[JointColumn, ...]:
        known, needed = robot.joint_names, self._needed(robot)
        entries = self.joints
        if entries is None:
            entries = {joint: ColumnEntry(column=joint) for joint in needed or known}
        for joint in entries:
            if joint not in known:
                raise UnknownNameError('joints: unknown key', joint, known, listed='; known are')
        missing = [joint for joint in needed if joint not in entries]
        if missing:
            raise ValueError(
                f"joints {missing} of robot '{robot.name}' are missing; name their columns, or "
                'give `{constant: 0.0}` for one that the dataset does not have'
            )
        return tuple(entries[j].of(j, self.unit, robot) for j in known if j in entries)


def to_positions(
    values: FloatArray, names: Sequence[str], joints: Sequence[JointColumn], feature: str
) -> FloatArray:
    """Return (T, J) positions [rad or m] of a feature's values (T, C).

    Args:
        values: joint values in the dataset's units.
        names: names of the columns; empty where the dataset does not name them.
        joints: joints in the robot's order.
        feature: name of the feature, for error texts.

    Raises:
        ConfigError: a column is not there.
    """
    positions = np.empty((len(values), len(joints)))
    for index, joint in enumerate(joints):
        column = 0.0
        if joint.column is not None:
            at = column_number(
                joint.column, names, values.shape[1], feature, f"joint '{joint.joint}'"
            )
            column = values[:, at]
        positions[:, index] = joint.factor * column + joint.offset
    return positions


def to_columns(
    positions: Mapping[str, float], names: Sequence[str], joints: Sequence[JointColumn]
) -> FloatArray:
    """Return (C,) values of positions by joint [rad or m]; the inverse of `to_positions`.

    Args:
        positions: positions by joint name.
        names: names of the columns; if empty, there are as many columns as joints use.
        joints: joints without constants.

    Raises:
        ConfigError: a column does not exist, or no joint fills it.
    """
    used = [joint for joint in joints if joint.column is not None]
    count = len(names) or 1 + max(
        (j.column for j in used if isinstance(j.column, int)), default=-1
    )
    values = {}
    for joint in used:
        assert joint.column is not None
        column = column_number(joint.column, names, count, 'state', f"joint '{joint.joint}'")
        values[column] = (positions[joint.joint] - joint.offset) / joint.factor
    empty = [column for column in range(min(count, 2 * len(used) + 1)) if column not in values]
    if empty:
        raise ConfigError(f'columns {empty} of {count} get no joint; name one for each')
    return np.array([values[column] for column in range(count)], float)


def column_number(
    column: str | int, names: Sequence[str], count: int, feature: str, what: str
) -> int:
    """Return the index of a feature's column, given its name or number.

    Raises:
        ConfigError: the column is missing; names what needs it.
    """
    if isinstance(column, int):
        if 0 <= column < count:
            return column
        raise ConfigError(
            f"{what}: feature '{feature}' has no column {column}; it has {count}, counted from 0"
        )
    if column in names:
        return list(names).index(column)
    if not names:
        raise ConfigError(
            f"{what}: feature '{feature}' has no column '{column}'; its columns have no names: "
            'give numbers'
        )
    raise ConfigError.unknown(
        f"{what}: feature '{feature}' has no column", column, names, listed='; its columns are'
    )
