"""The mapping file: what of a dataset is which view, joint and camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import hashlib
from pathlib import Path
from typing import Any

from mtv_world_ros.config import check_keys, number, read_yaml, text, word
from mtv_world_ros.data.episode import check_outcome
from mtv_world_ros.errors import ConfigError
from mtv_world_ros.files import share_path
from mtv_world_ros.geometry.joint_columns import JointColumn, parse_joints, UNITS
from mtv_world_ros.geometry.robot import RobotModel
from mtv_world_ros.geometry.robot_file import load_robot
from mtv_world_ros.importing.camera_parameters import CameraSource, parse_camera

_KEYS = ('robot', 'views', 'state', 'action', 'task', 'instruction', 'outcome',
         'outcome_feature', 'objects', 'chunk_s', 'limit_tolerance', 'jpeg_quality')  # fmt: skip
_STREAM_KEYS = ('feature', 'unit', 'joints')
_FROM_STATE = 'state'


@dataclass(frozen=True, slots=True, kw_only=True)
class Stream:
    """Joint values of a feature.

    Attributes:
        feature: name in the dataset.
        joints: in the robot's order.
    """

    feature: str
    joints: tuple[JointColumn, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionStream(Stream):
    """Joint values that are commanded.

    Attributes:
        delay_frames: an action is reached this many frames after the one it stands beside.
    """

    delay_frames: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetMapping:
    """A mapping file, checked.

    Attributes:
        robot: the robot.
        views: where each view's images and calibration are from.
        state: measured joint positions.
        action: commanded ones; None = the measured ones of the frames that follow.
        task: name of the task; empty = none.
        instruction: what the robot is told; empty = the dataset's text.
        outcome: of every episode, unless `outcome_feature` says it.
        outcome_feature: feature that is true in a frame of an episode that succeeds, or empty.
        objects: names of the objects.
        chunk_s: length of a joint trajectory message [s].
        limit_tolerance: positions further outside the limits fail the episode [rad or m].
        jpeg_quality: 1 to 100.
        key: changes with everything that decides about the result.
    """

    robot: RobotModel
    views: Mapping[str, CameraSource]
    state: Stream
    action: ActionStream | None
    task: str
    instruction: str
    outcome: str
    outcome_feature: str
    objects: tuple[str, ...]
    chunk_s: float
    limit_tolerance: float
    jpeg_quality: int
    key: str


def load_mapping(path: Path) -> DatasetMapping:
    """Reads a mapping file; `config/datasets/example.yaml` describes its keys.

    Raises:
        ConfigError: the file is missing, not YAML, or has unknown, missing or wrong values.
        RobotError, CalibrationError: what it names cannot be used.
    """
    where = str(path)
    values = read_yaml(path, 'mapping file', '--mapping')
    check_keys(values, _KEYS, ('robot', 'views', 'state', 'action'), where)
    robot_file = _robot_file(text(values, 'robot', '', where), path)
    robot = load_robot(robot_file)
    views = check_keys(values['views'], values['views'] or (), (), f'{where}: views')
    if not views:
        raise ConfigError(f"{where}: 'views' is empty; name at least one")
    sources = {
        str(view): parse_camera(str(view), row, path.parent, f"{where}: view '{view}'")
        for view, row in views.items()
    }
    return DatasetMapping(
        robot=robot,
        views=sources,
        state=_state(values['state'], robot, f'{where}: state'),
        action=_action(values['action'], robot, f'{where}: action'),
        task=text(values, 'task', '', where),
        instruction=text(values, 'instruction', '', where),
        outcome=check_outcome(text(values, 'outcome', 'unknown', where)),
        outcome_feature=text(values, 'outcome_feature', '', where),
        objects=_objects(values, where),
        chunk_s=_positive(values, 'chunk_s', 3.2, where),
        limit_tolerance=_positive(values, 'limit_tolerance', 0.05, where),
        jpeg_quality=int(_positive(values, 'jpeg_quality', 90, where)),
        key=_key([path, robot_file, *(s.calibration_file for s in sources.values())]),
    )


def _robot_file(name: str, path: Path) -> Path:
    if Path(name).suffix in ('.yaml', '.yml'):
        return path.parent / name
    return share_path('config', 'robots', f'{name}.yaml')


def _state(row: Any, robot: RobotModel, where: str) -> Stream:
    check_keys(row, _STREAM_KEYS, ('feature',), where)
    unit = word(row, 'unit', UNITS, where)
    joints = parse_joints(row.get('joints'), unit, robot, where)
    return Stream(feature=text(row, 'feature', '', where), joints=joints)


def _action(row: Any, robot: RobotModel, where: str) -> ActionStream | None:
    if row == _FROM_STATE:
        return None
    check_keys(row, (*_STREAM_KEYS, 'delay_frames'), ('feature',), where)
    stream = _state({k: row[k] for k in row if k != 'delay_frames'}, robot, where)
    delay = number(row, 'delay_frames', 1.0, where)
    if delay < 0:
        raise ConfigError(f"{where}: 'delay_frames' is {delay:g}, must not be negative")
    return ActionStream(feature=stream.feature, joints=stream.joints, delay_frames=delay)


def _objects(values: Mapping[str, Any], where: str) -> tuple[str, ...]:
    names = values.get('objects', [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ConfigError(f"{where}: 'objects' is {names!r}, must be a list of names")
    return tuple(names)


def _positive(values: Mapping[str, Any], key: str, default: float, where: str) -> float:
    value = number(values, key, default, where)
    if value <= 0:
        raise ConfigError(f"{where}: '{key}' is {value:g}, must be positive")
    return value


def _key(files: list[Path | None]) -> str:
    digest = hashlib.sha256()
    for file in files:
        if file is not None:
            digest.update(file.read_bytes())
    return digest.hexdigest()[:16]
