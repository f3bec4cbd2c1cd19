"""How columns of a data set, or of a policy server's vectors, become the robot's joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mtv_world_ros.config import check_keys, number, numbers, word
from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import ConfigError, nearest
from mtv_world_ros.geometry.robot import RobotModel

#: factor to rad or m
UNITS = {'rad': 1.0, 'm': 1.0, 'deg': np.pi / 180, 'cm': 0.01, 'mm': 0.001}
_ROW_KEYS = ('column', 'unit', 'sign', 'offset', 'closed', 'open', 'from', 'to', 'constant')
_LINEAR = {'unit', 'sign', 'offset'}


@dataclass(frozen=True, slots=True, kw_only=True)
class JointColumn:
    """One joint: `factor * column + offset` [rad or m]; the offset alone where column is None.

    Attributes:
        joint: name in the robot.
        column: name or number of the column in the dataset's feature.
        factor: from the dataset's unit, sign included.
        offset: [rad or m].
    """

    joint: str
    column: str | int | None
    factor: float = 1.0
    offset: float = 0.0


def parse_joints(
    rows: Any, unit: str, robot: RobotModel, where: str, *, allow_missing: bool = False
) -> tuple[JointColumn, ...]:
    """Reads `joints`, one entry for each joint of the robot, unless some may be missing.

    An entry is a column (name or number), or keys: `column` with `unit`, `sign` and `offset`
    (added last, rad or m); or with `closed` and `open`, the gripper's values in the dataset; or
    with `from` and `to`, two values in the dataset and what they mean (rad or m); or `constant`
    alone. Without `joints` the columns have the joints' names.

    Raises:
        ConfigError: a joint is missing or unknown, or an entry is wrong.
    """
    if rows is None:
        rows = {joint: joint for joint in robot.joint_names}
    check_keys(rows, robot.joint_names, (), f'{where}: joints')
    missing = [joint for joint in robot.joint_names if joint not in rows]
    if missing and not allow_missing:
        raise ConfigError(
            f"{where}: joints {missing} of robot '{robot.name}' are missing; name their columns, "
            'or give `{constant: 0.0}` for one that the dataset does not have'
        )
    return tuple(
        _joint(joint, rows[joint], unit, robot, f"{where}: joint '{joint}'")
        for joint in robot.joint_names
        if joint in rows
    )


def _joint(joint: str, row: Any, unit: str, robot: RobotModel, where: str) -> JointColumn:
    if isinstance(row, str | int) and not isinstance(row, bool):
        row = {'column': row}
    row = check_keys(row, _ROW_KEYS, (), where)
    given = set(row) - {'column'}
    if 'constant' in row:
        if set(row) != {'constant'}:
            raise ConfigError(f"{where}: 'constant' stands alone, got {sorted(row)}")
        return JointColumn(joint=joint, column=None, offset=number(row, 'constant', 0.0, where))
    column = row.get('column')
    if isinstance(column, bool) or not isinstance(column, str | int):
        raise ConfigError(f"{where}: 'column' is {column!r}, must be a name or a number")
    if given <= _LINEAR:
        factor = UNITS[word({'unit': unit, **row}, 'unit', UNITS, where)]
        factor *= _sign(row, where)
        offset = number(row, 'offset', 0.0, where)
        return JointColumn(joint=joint, column=column, factor=factor, offset=offset)
    factor, offset = _range(joint, row, given, robot, where)
    return JointColumn(joint=joint, column=column, factor=factor, offset=offset)


def _sign(row: Mapping[str, Any], where: str) -> float:
    sign = number(row, 'sign', 1, where)
    if abs(sign) != 1:
        raise ConfigError(f"{where}: 'sign' is {sign:g}, must be 1 or -1")
    return sign


def _range(
    joint: str, row: Mapping[str, Any], given: set[str], robot: RobotModel, where: str
) -> tuple[float, float]:
    """Factor and offset that take two values of the dataset to two of the joint."""
    if given == {'from', 'to'}:
        (a, b), (c, d) = numbers(row, 'from', 2, where), numbers(row, 'to', 2, where)
    elif given == {'closed', 'open'}:
        tool = next((t for t in robot.tools if t.gripper_joint == joint), None)
        if tool is None:
            raise ConfigError(f"{where}: 'closed' and 'open' are for grippers; use 'from', 'to'")
        a, b = number(row, 'closed', 0.0, where), number(row, 'open', 1.0, where)
        c, d = tool.gripper_closed, tool.gripper_open
    else:
        raise ConfigError(
            f"{where}: {sorted(given)} do not go together; give 'unit', 'sign', 'offset', or "
            "'closed' and 'open', or 'from' and 'to'"
        )
    if a == b:
        raise ConfigError(f'{where}: both ends of the range are {a:g}')
    factor = (d - c) / (b - a)
    return factor, c - factor * a


def to_positions(
    values: FloatArray, names: Sequence[str], joints: Sequence[JointColumn], feature: str
) -> FloatArray:
    """Returns (T, J) positions [rad or m] of a feature's values (T, C).

    Args:
        values: as in the dataset.
        names: of the columns; empty where the dataset does not name them.
        joints: in the robot's order.
        feature: its name, for error texts.

    Raises:
        ConfigError: a column is not there.
    """
    positions = np.empty((len(values), len(joints)))
    for index, joint in enumerate(joints):
        column = 0.0
        if joint.column is not None:
            column = values[:, _column(joint, names, values.shape[1], feature)]
        positions[:, index] = joint.factor * column + joint.offset
    return positions


def to_columns(
    positions: Mapping[str, float], names: Sequence[str], joints: Sequence[JointColumn]
) -> FloatArray:
    """Returns (C,) values of positions by joint [rad or m]; the inverse of `to_positions`.

    Args:
        positions: by joint name.
        names: of the columns; empty where they have none, they are then as many as are used.
        joints: without constants.

    Raises:
        ConfigError: a column is not there, or nothing is put into one.
    """
    used = [joint for joint in joints if joint.column is not None]
    count = len(names) or 1 + max(
        (j.column for j in used if isinstance(j.column, int)), default=-1
    )
    values = np.full(count, np.nan)
    for joint in used:
        column = _column(joint, names, count, 'state')
        values[column] = (positions[joint.joint] - joint.offset) / joint.factor
    empty = np.flatnonzero(np.isnan(values))
    if len(empty):
        raise ConfigError(f'columns {empty.tolist()} of {count} get no joint; name one for each')
    return values


def _column(joint: JointColumn, names: Sequence[str], count: int, feature: str) -> int:
    column = joint.column
    if isinstance(column, int):
        if 0 <= column < count:
            return column
        raise ConfigError(
            f"joint '{joint.joint}': feature '{feature}' has no column {column}; it has {count}, "
            'counted from 0'
        )
    assert column is not None
    if column in names:
        return list(names).index(column)
    known = (
        f'its columns are {", ".join(names)}'
        if names
        else 'its columns have no names: give numbers'
    )
    raise ConfigError(
        f"joint '{joint.joint}': feature '{feature}' has no column '{column}'"
        f'{nearest(column, names)}; {known}'
    )
