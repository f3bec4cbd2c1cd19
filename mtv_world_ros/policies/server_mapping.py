"""What a policy server gets and gives: keys of images, state and prompt, columns of actions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from mtv_world_ros.config import check_keys, number, text, word
from mtv_world_ros.data_types import ByteArray, FloatArray, JointTrajectory, Observation
from mtv_world_ros.errors import ConfigError, PolicyError
from mtv_world_ros.geometry.joint_columns import (
    JointColumn,
    parse_joints,
    to_columns,
    to_positions,
    UNITS,
)
from mtv_world_ros.geometry.robot import RobotModel

LAYOUTS = ('hwc', 'chw')
FITS = ('pad', 'stretch')
#: a path of keys in nested mappings
Key = tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageInput:
    """One image of a request.

    Attributes:
        key: where it goes.
        view: the view it shows.
        width, height: size that the server wants [px]; 0 = as it is.
        layout: order of the axes.
        fit: `pad` keeps the aspect ratio and fills with black, `stretch` does not.
    """

    key: Key
    view: str
    width: int = 0
    height: int = 0
    layout: str = 'hwc'
    fit: str = 'pad'

    def image(self, observation: Observation) -> ByteArray:
        """The view as the server wants it.

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


@dataclass(frozen=True, slots=True, kw_only=True)
class StateInput:
    """One vector of measured positions.

    Attributes:
        key: where it goes.
        names: of its columns; empty where they have none.
        joints: which joint each column holds.
    """

    key: Key
    names: tuple[str, ...]
    joints: tuple[JointColumn, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionOutput:
    """What the server answers.

    Attributes:
        key: where the actions (T, C) are.
        names: of its columns; empty where they have none.
        joints: which joint each column moves.
        rate_hz: actions a second; action k is where the joints are (k + 1) / rate_hz later.
        relative: they count from the observed positions.
    """

    key: Key
    names: tuple[str, ...]
    joints: tuple[JointColumn, ...]
    rate_hz: float
    relative: bool = False

    def trajectory(self, actions: Any, observation: Observation) -> JointTrajectory:
        """The actions as commands.

        Raises:
            PolicyError: not a table of finite numbers, or a column is missing.
        """
        try:
            values = np.atleast_2d(np.asarray(actions, np.float64))
        except (TypeError, ValueError) as error:
            raise PolicyError(f'the actions are no table of numbers: {error}') from error
        if values.ndim != 2 or not values.size:
            raise PolicyError(f'the actions have shape {values.shape}; expected (time, column)')
        if not np.isfinite(values).all():
            row, column = np.argwhere(~np.isfinite(values))[0]
            raise PolicyError(f'action {row} has {values[row, column]} in column {column}')
        try:
            positions = to_positions(values, self.names, self.joints, '/'.join(self.key))
        except ConfigError as error:
            raise PolicyError(str(error)) from error
        if self.relative:
            moving = [joint.column is not None for joint in self.joints]
            positions[:, moving] += observation.positions[moving]
        return JointTrajectory(
            joint_names=tuple(joint.joint for joint in self.joints),
            times=np.arange(1, len(values) + 1) / self.rate_hz,
            positions=positions,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerMapping:
    """All of it.

    Attributes:
        images: of a request.
        states: of a request.
        prompt: where the instruction goes; empty = nowhere.
        actions: of an answer.
        joint_names: J names, in the robot's order.
    """

    images: tuple[ImageInput, ...]
    states: tuple[StateInput, ...]
    prompt: Key
    actions: ActionOutput
    joint_names: tuple[str, ...]

    def request(self, observation: Observation, instruction: str) -> dict[str, Any]:
        """The request as nested mappings of arrays and text."""
        request: dict[str, Any] = {}
        for image in self.images:
            _put(request, image.key, image.image(observation))
        for state in self.states:
            _put(request, state.key, self.columns(state, observation).astype(np.float32))
        if self.prompt:
            _put(request, self.prompt, instruction)
        return request

    def columns(self, state: StateInput, observation: Observation) -> FloatArray:
        """(C,) values of a state."""
        positions = dict(zip(self.joint_names, observation.positions.tolist(), strict=True))
        return to_columns(positions, state.names, state.joints)


MAPPING_KEYS = ('images', 'state', 'prompt', 'actions')


def read_mapping(values: Mapping[str, Any], robot: RobotModel, where: str) -> ServerMapping:
    """Reads the keys `MAPPING_KEYS` of a policy file.

    Raises:
        ConfigError: a key is unknown or missing, a value is wrong.
    """
    return ServerMapping(
        images=tuple(_image(row, f'{where}: images') for row in _rows(values, 'images', where)),
        states=tuple(
            _state(row, robot, f'{where}: state') for row in _rows(values, 'state', where)
        ),
        prompt=_key(values['prompt'], f'{where}: prompt') if values.get('prompt') else (),
        actions=_actions(values['actions'], robot, f'{where}: actions'),
        joint_names=robot.joint_names,
    )


def fitted(frame: ByteArray, width: int, height: int, fit: str = 'pad') -> ByteArray:
    """Returns the (H, W, 3) frame at another size, with black borders where it would be skewed."""
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
    """What stands under a path of keys.

    Raises:
        PolicyError: nothing does.
    """
    found = answer
    for part in key:
        if not isinstance(found, Mapping) or part not in found:
            has = sorted(map(str, found)) if isinstance(found, Mapping) else type(found).__name__
            raise PolicyError(f"the answer has nothing under '{'/'.join(key)}'; it has {has}")
        found = found[part]
    return found


def _put(request: dict[str, Any], key: Key, value: Any) -> None:
    for part in key[:-1]:
        request = request.setdefault(part, {})
    request[key[-1]] = value


def _rows(values: Mapping[str, Any], key: str, where: str) -> Sequence[Any]:
    rows = values.get(key) or []
    if not isinstance(rows, list):
        raise ConfigError(f"{where}: '{key}' is {rows!r}, must be a list of entries")
    return rows


def _key(value: Any, where: str) -> Key:
    """A text, or a list of texts for nested mappings."""
    parts = value if isinstance(value, list) else [value]
    if not parts or not all(isinstance(part, str) and part for part in parts):
        raise ConfigError(f"{where}: 'key' is {value!r}, must be a text or a list of texts")
    return tuple(parts)


def _image(row: Any, where: str) -> ImageInput:
    row = check_keys(row, ImageInput.__dataclass_fields__, ('key', 'view'), where)
    sizes = {key: int(number(row, key, 0, where)) for key in ('width', 'height')}
    if any(size < 0 for size in sizes.values()) or bool(sizes['width']) != bool(sizes['height']):
        raise ConfigError(f"{where}: give both 'width' and 'height' in pixels, got {sizes}")
    return ImageInput(
        key=_key(row['key'], where),
        view=text(row, 'view', '', where),
        layout=word(row, 'layout', LAYOUTS, where),
        fit=word(row, 'fit', FITS, where),
        **sizes,
    )


def _state(row: Any, robot: RobotModel, where: str) -> StateInput:
    row = check_keys(row, ('key', 'names', 'unit', 'joints'), ('key', 'joints'), where)
    unit = word(row, 'unit', UNITS, where)
    joints = parse_joints(row['joints'], unit, robot, where, allow_missing=True)
    state = StateInput(key=_key(row['key'], where), names=_names(row, where), joints=joints)
    try:
        to_columns(dict.fromkeys(robot.joint_names, 0.0), state.names, joints)
    except ConfigError as error:
        raise ConfigError(f'{where}: {error}') from error
    return state


def _actions(row: Any, robot: RobotModel, where: str) -> ActionOutput:
    known = ('key', 'names', 'unit', 'joints', 'rate_hz', 'relative')
    row = check_keys(row, known, ('joints', 'rate_hz'), where)
    rate = number(row, 'rate_hz', 0.0, where)
    if rate <= 0:
        raise ConfigError(f"{where}: 'rate_hz' is {rate:g}, must be positive")
    relative = row.get('relative', False)
    if not isinstance(relative, bool):
        raise ConfigError(f"{where}: 'relative' is {relative!r}, must be true or false")
    return ActionOutput(
        key=_key(row.get('key', 'actions'), where),
        names=_names(row, where),
        joints=parse_joints(row['joints'], word(row, 'unit', UNITS, where), robot, where),
        rate_hz=rate,
        relative=relative,
    )


def _names(row: Mapping[str, Any], where: str) -> tuple[str, ...]:
    names = row.get('names') or []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ConfigError(f"{where}: 'names' is {names!r}, must be a list of texts")
    return tuple(names)
