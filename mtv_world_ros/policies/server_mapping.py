"""Inputs and outputs of a policy server: keys of images, state and prompt, action columns."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import islice
from typing import Annotated, Any, ClassVar, Literal, Self

import cv2
import numpy as np
from pydantic import BeforeValidator, Field, model_validator, PrivateAttr

from mtv_world_ros.core.bounded_input import check_limit, LimitError
from mtv_world_ros.core.config import expected, ListOf, Schema
from mtv_world_ros.core.data_types import (
    BoolArray,
    ByteArray,
    FloatArray,
    JointTrajectory,
    Observation,
)
from mtv_world_ros.core.errors import ConfigError, PolicyError, UnknownNameError
from mtv_world_ros.core.shown_text import shown
from mtv_world_ros.robot.joint_columns import JointColumn, JointTable, to_columns, to_positions
from mtv_world_ros.robot.model import RobotModel

#: names in an answer that an error lists
_MOST_NAMES = 100
#: offset of a velocity below which 0 means rest; rounding of a range such as [-1, 1] [rad/s, m/s]
_ZERO = 1e-9


def _parts(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else (value,)


#: a path of keys in nested mappings; in a file a text, or a list of texts
Key = Annotated[
    tuple[Annotated[str, Field(min_length=1)], ...],
    BeforeValidator(_parts),
    Field(min_length=1),
    expected('a text or a list of texts'),
]


class ImageInput(Schema):
    """One image of a request."""

    key: Key = Field(description='key of the request that gets the image')
    view: str = Field(description='name of the view')
    width: int = Field(
        default=0, ge=0, le=16_384, description='width that the server wants [px]; 0 = unchanged'
    )
    height: int = Field(
        default=0, ge=0, le=16_384, description='height that the server wants [px]; 0 = unchanged'
    )
    layout: Literal['hwc', 'chw'] = Field(default='hwc', description='order of the axes')
    fit: Literal['pad', 'stretch'] = Field(
        default='pad', description='`pad` keeps the aspect ratio and fills with black'
    )

    @model_validator(mode='after')
    def _has_both_sizes(self) -> Self:
        if bool(self.width) != bool(self.height):
            sizes = {'width': self.width, 'height': self.height}
            raise ValueError(f"give both 'width' and 'height' in pixels, got {sizes}")
        return self

    def image(self, observation: Observation) -> ByteArray:
        """Return the view as the server wants it.

        Raises:
            ConfigError: there is no such view.
        """
        if self.view not in observation.views:
            raise ConfigError(
                f"image '{'/'.join(self.key)}' is of view '{self.view}', which the world model "
                f'does not have; it has {list(observation.views)}'
            )
        frame = observation.frames[observation.views.index(self.view)]
        if self.width and self.height:
            frame = fitted(frame, self.width, self.height, self.fit)
        return np.ascontiguousarray(frame.transpose(2, 0, 1) if self.layout == 'chw' else frame)


class StateInput(JointTable):
    """One vector of measured positions; joints that are not in it are left out."""

    allow_missing: ClassVar = True

    key: Key = Field(description='where it goes')
    names: ListOf[str] = Field(default=(), description='of its columns; empty = they have none')

    def _of(self, robot: RobotModel) -> tuple[JointColumn, ...]:
        columns = super()._of(robot)
        try:
            to_columns(dict.fromkeys(robot.joint_names, 0.0), self.names, columns)
        except ConfigError as error:
            raise ValueError(str(error)) from error
        return columns

    def values(self, observation: Observation) -> FloatArray:
        """Return (C,) columns of the observed positions."""
        positions = dict(zip(self._joint_names, observation.positions.tolist(), strict=True))
        return to_columns(positions, self.names, self.columns)


class ActionOutput(JointTable):
    """The server's actions."""

    key: Key = Field(default=('actions',), description='where the actions (T, C) are')
    names: ListOf[str] = Field(default=(), description='of its columns; empty = they have none')
    rate_hz: float = Field(
        gt=0,
        le=10_000,
        description='actions a second; action k is where the joints are (k + 1) / rate_hz later',
    )
    action: Literal['position', 'velocity'] = Field(
        default='position',
        description='meaning of the values: positions, or joint velocities [unit / s]',
    )
    positions: ListOf[str] | None = Field(
        default=None,
        description='with `action: velocity`: joints whose values are positions; null = grippers',
    )
    relative: bool = Field(default=False, description='positions count from the observed ones')
    clip: bool = Field(
        default=False,
        description="beyond a joint's limits (with `action: velocity`: speed limit) means at "
        "them, as in a robot's driver",
    )
    _limits: tuple[FloatArray, FloatArray, FloatArray] = PrivateAttr()
    _moves: BoolArray = PrivateAttr()

    @property
    def is_velocity(self) -> bool:
        """True if the values of joints are velocities."""
        return self.action == 'velocity'

    def _of(self, robot: RobotModel) -> tuple[JointColumn, ...]:
        columns = super()._of(robot)
        self._limits = robot.lower, robot.upper, robot.velocity_limits
        still = self._position_joints(robot)
        self._moves = np.array([c.column is not None and c.joint not in still for c in columns])
        offsets = [c.joint for c in columns if self.is_velocity and self._has_offset(c, still)]
        if offsets:
            raise ValueError(
                f"joint '{offsets[0]}': its values are velocities, and 0 must mean that it rests; "
                "leave 'offset' out, or list the joint under 'positions' if its values are "
                'positions'
            )
        return columns

    @staticmethod
    def _has_offset(column: JointColumn, still: Collection[str]) -> bool:
        is_velocity = column.column is not None and column.joint not in still
        return is_velocity and abs(column.offset) > _ZERO

    def _position_joints(self, robot: RobotModel) -> set[str]:
        """Return the joints whose values are positions with `action: velocity`."""
        if self.positions is None:
            return {tool.gripper_joint for tool in robot.tools if tool.gripper_joint}
        if not self.is_velocity:
            raise ValueError("'positions' is for 'action: velocity'; all values are positions")
        for joint in self.positions:
            if joint not in robot.joint_names:
                raise UnknownNameError(
                    'positions:', joint, robot.joint_names, is_not=' is not among'
                )
        return set(self.positions)

    @model_validator(mode='after')
    def _velocities_are_not_relative(self) -> Self:
        if self.relative and self.is_velocity:
            raise ValueError(
                "'relative' is for positions; with 'action: velocity' they always count from the "
                'observed ones'
            )
        return self

    def trajectory(self, actions: Any, observation: Observation) -> JointTrajectory:
        """Return the actions as commands.

        Velocities are summed up from the observed positions: position k is position k - 1 plus
        velocity k / `rate_hz`, kept within the joint's limits at each step.

        Raises:
            PolicyError: not a table of finite numbers, or a column is missing.
        """
        try:
            values = np.atleast_2d(np.asarray(actions, np.float64))
        except (TypeError, ValueError) as error:
            raise PolicyError(f'the actions are no table of numbers: {shown(error)}') from error
        if values.ndim == 3 and len(values) == 1:  # a batch of one answer
            values = values[0]
        if values.ndim != 2 or not values.size:
            raise PolicyError(f'the actions have shape {values.shape}; expected (time, column)')
        try:
            check_limit('trajectory_points', len(values), 'the answer')
        except LimitError as error:
            raise PolicyError(str(error)) from error
        if not np.isfinite(values).all():
            row, column = np.argwhere(~np.isfinite(values))[0]
            raise PolicyError(f'action {row} has {values[row, column]} in column {column}')
        try:
            positions = to_positions(values, self.names, self.columns, '/'.join(self.key))
        except ConfigError as error:
            raise PolicyError(str(error)) from error
        self._make_absolute(positions, observation.positions)
        if self.clip:
            positions = positions.clip(*self._limits[:2])
        return JointTrajectory(
            joint_names=tuple(joint.joint for joint in self.columns),
            times=np.arange(1, len(values) + 1) / self.rate_hz,
            positions=positions,
        )

    def _make_absolute(self, values: FloatArray, observed: FloatArray) -> None:
        """Replace values (T, J) that count from `observed` (J,) by positions."""
        if self.is_velocity:
            self._integrate(values, observed)
        elif self.relative:
            moving = [joint.column is not None for joint in self.columns]
            values[:, moving] += observed[moving]

    def _integrate(self, values: FloatArray, observed: FloatArray) -> None:
        """Replace velocities in `values` (T, J) by positions, from `observed` (J,) on."""
        lower, upper, fastest = (limit[self._moves] for limit in self._limits)
        reached = observed[self._moves]
        # a joint that rests beyond a limit may stay there or come back, and go no further
        lower, upper = np.minimum(lower, reached), np.maximum(upper, reached)
        for row in values:
            speeds = row[self._moves]
            if self.clip:
                speeds = speeds.clip(-fastest, fastest)
            reached = (reached + speeds / self.rate_hz).clip(lower, upper)
            row[self._moves] = reached


class ServerMapping(Schema):
    """Inputs and outputs of a server: part of a policy file."""

    images: ListOf[ImageInput] = Field(default=(), description='images of a request')
    state: ListOf[StateInput] = Field(default=(), description='vectors of measured positions')
    actions: ActionOutput = Field(description='actions of an answer')


def fitted(frame: ByteArray, width: int, height: int, fit: str = 'pad') -> ByteArray:
    """Return the (H, W, 3) frame at another size, with black borders where it would be skewed."""
    scale_x, scale_y = width / frame.shape[1], height / frame.shape[0]
    if fit == 'pad':
        scale_x = scale_y = min(scale_x, scale_y)
    size = (max(1, int(frame.shape[1] * scale_x)), max(1, int(frame.shape[0] * scale_y)))
    method = cv2.INTER_AREA if scale_x < 1 and scale_y < 1 else cv2.INTER_LINEAR
    resized = cv2.resize(frame, size, interpolation=method)
    left, top = (width - size[0]) // 2, (height - size[1]) // 2
    whole = np.zeros((height, width, 3), np.uint8)
    whole[top : top + size[1], left : left + size[0]] = resized
    return whole


def find(answer: Any, key: Key) -> Any:
    """Return the value under a path of keys.

    Raises:
        PolicyError: nothing does.
    """
    found = answer
    for part in key:
        if not isinstance(found, Mapping) or part not in found:
            names = islice(map(str, found), _MOST_NAMES) if isinstance(found, Mapping) else ()
            has = sorted(names) if isinstance(found, Mapping) else type(found).__name__
            raise PolicyError(
                f"the answer has nothing under '{'/'.join(key)}'; it has {shown(has)}"
            )
        found = found[part]
    return found
