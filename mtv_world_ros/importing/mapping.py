"""The mapping file: which features of a dataset are which view, joint and camera."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
import hashlib
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationInfo,
)

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.core.bounded_input import require_regular
from mtv_world_ros.core.config import ListOf, read_yaml, validated, wrong
from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import ConfigError, UnknownNameError
from mtv_world_ros.core.files import bundled
from mtv_world_ros.data.bag_mapping import Written
from mtv_world_ros.data.episode import check_outcome
from mtv_world_ros.data.tool_targets import add_tool_poses, tool_joints
from mtv_world_ros.importing.camera_parameters import CameraSource
from mtv_world_ros.importing.lerobot import LeRobotDataset
from mtv_world_ros.importing.tool_poses import ToolPoses
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.joint_columns import JointColumn, JointEntries, JointTable, to_positions
from mtv_world_ros.robot.model import RobotModel

#: names of features, or of what several features begin with, in data sets of LeRobot's layout
_STATES = ('observation.state', 'observation.states', 'state', 'states')
_ACTIONS = ('action', 'actions')


class Stream(JointTable):
    """Joint values of a feature, or of several whose columns follow each other."""

    feature: str | Annotated[ListOf[str], Field(min_length=1)] = Field(
        description='name in the dataset, or a list of names'
    )
    joints: JointEntries | None = Field(
        default=None, description='column of each joint; null = columns have their names'
    )

    @property
    def features(self) -> tuple[str, ...]:
        """Names in the dataset, in the order of their columns."""
        return (self.feature,) if isinstance(self.feature, str) else self.feature

    @property
    def label(self) -> str:
        """Names in the dataset, for errors."""
        return ', '.join(self.features)

    def used_columns(self) -> tuple[int | str, ...]:
        """Return the columns that joints are made of, by name or number."""
        return tuple(joint.column for joint in self.columns if joint.column is not None)


class ActionStream(Stream):
    """Stream of commands: joint values, their differences, or poses of tools."""

    delay_frames: float = Field(
        default=1.0,
        ge=0,
        le=1000,
        description='an action is reached this many frames after the one it stands beside',
    )
    differences: ListOf[str] = Field(
        default=(), description='joints whose values are added to the measured ones of their row'
    )
    tools: dict[str, ToolPoses] = Field(
        default_factory=dict, description='poses of the tools of arms, in place of their joints'
    )

    def used_columns(self) -> tuple[int | str, ...]:
        """Return the columns that joints and poses are made of, by name or number."""
        poses = [(*poses.position, *poses.rotation) for poses in self.tools.values()]
        return tuple(chain(super().used_columns(), *poses))

    def _needed(self, robot: RobotModel) -> Sequence[str]:
        led = tool_joints(self.tools, robot)
        both = sorted(led & set(self.joints or ()))
        if both:
            raise ValueError(f'joints {both} follow from the poses of `tools`; give one of both')
        for joint in self.differences:
            if joint in led or joint not in robot.joint_names:
                known = [name for name in robot.joint_names if name not in led]
                raise UnknownNameError('differences:', joint, known, is_not=' is not among')
        return [joint for joint in robot.joint_names if joint not in led]

    def columns_among(self, names: Sequence[str], state: Stream | None) -> tuple[JointColumn, ...]:
        """Return one column a joint; by default the columns of the state.

        Args:
            names: names of the columns; those that are named like the robot's joints go first.
            state: stream of the measured joints; None = the own columns alone.
        """
        own = self.columns
        is_open = not (self.joints or self.tools or self.differences)
        if state is None or not is_open or 'unit' in self.model_fields_set:
            return own
        return own if {column.column for column in own} <= set(names) else state.columns

    def commanded(
        self,
        values: FloatArray,
        names: Sequence[str],
        measured: FloatArray,
        robot: RobotModel,
        state: Stream | None = None,
    ) -> tuple[FloatArray, tuple[str, ...]]:
        """Return commanded positions (T, J) from a feature's values (T, C), and notes on them.

        Args:
            values: values in the dataset's units.
            names: names of the columns; empty where the dataset does not name them.
            measured: (T, J) positions of the same rows.
            robot: robot whose order of joints and tools are used.
            state: stream of the measured joints, for commands without `joints`.

        Raises:
            ConfigError: a column is not there.
            EpisodeError: most poses of a tool are out of reach.
        """
        positions = measured.copy()
        columns = self.columns_among(names, state)
        at = [robot.joint_names.index(column.joint) for column in columns]
        positions[:, at] = to_positions(values, names, columns, self.label)
        added = [robot.joint_names.index(joint) for joint in self.differences]
        positions[:, added] += measured[:, added]
        odd = [
            add_tool_poses(
                positions, measured, robot, arm, poses, poses.wanted(values, names, self.label)
            )
            for arm, poses in self.tools.items()
        ]
        return positions, tuple(filter(None, odd))


def load_mapped_robot(name: Any, info: ValidationInfo[dict[str, Any]]) -> RobotModel:
    """Load the robot that a mapping names, and store its file in the validation context."""
    if not isinstance(name, str):
        raise wrong("the name of a bundled robot, or a robot's YAML")
    file = _robot_path(name, info.context['folder'])
    info.context.update(robot_file=file, robot=load_robot(file))
    return info.context['robot']


def _robot_path(name: str, folder: Path) -> Path:
    """Return a robot's YAML, in `folder` unless it is a bundled one."""
    is_path = Path(name).suffix in ('.yaml', '.yml')
    return folder / name if is_path else bundled('robots', name, 'robot')


def _not_from_state(value: Any) -> Any:
    return None if value == 'state' else value


def _named(views: dict[str, CameraSource]) -> dict[str, CameraSource]:
    if not views:
        raise ValueError("'views' is empty; name at least one")
    return {view: source.model_copy(update={'view': view}) for view, source in views.items()}


class DatasetMapping(Written):
    """A mapping file."""

    basic: ClassVar = ('robot', 'views', 'state', 'action')

    model_config = ConfigDict(arbitrary_types_allowed=True)

    robot: Annotated[RobotModel, BeforeValidator(load_mapped_robot)] = Field(
        description="name of a bundled robot, or a robot's YAML"
    )
    views: Annotated[dict[str, CameraSource], AfterValidator(_named)] = Field(
        description="where each view's images and calibration are from"
    )
    state: Stream = Field(description='measured joint positions')
    action: Annotated[ActionStream | None, BeforeValidator(_not_from_state)] = Field(
        description='commands; `state` = the measured positions of the frames that follow'
    )
    instruction: str = Field(
        default='', description="what the robot is told; empty = the dataset's text"
    )
    outcome: Annotated[str, AfterValidator(check_outcome)] = Field(
        default='unknown', description='of every episode, unless `outcome_feature` says it'
    )
    outcome_feature: str = Field(
        default='', description='feature that is true in a frame of an episode that succeeds'
    )
    jpeg_quality: int = Field(
        default=90, ge=1, le=100, description='quality of the JPEG images that are written'
    )
    _key: str = PrivateAttr(default='')
    _robot_file: Path = PrivateAttr(default=Path())

    @property
    def robot_file(self) -> Path:
        """The robot's YAML."""
        return self._robot_file

    @property
    def key(self) -> str:
        """Changes with everything that decides about the result."""
        return self._key


def load_mapping(path: Path) -> DatasetMapping:
    """Read a mapping file; `config/datasets/example.yaml` describes its keys.

    Raises:
        ConfigError: the file is missing, not YAML, or has unknown, missing or wrong values.
        RobotError, CalibrationError: a file that the mapping names cannot be used.
    """
    values = read_yaml(path, 'mapping file', '--mapping')
    context: dict[str, Any] = {'folder': path.parent}
    mapping = validated(DatasetMapping, values, str(path), context=context)
    calibrations = [source.calibration for source in mapping.views.values()]
    mapping._robot_file = context['robot_file']
    mapping._key = digest_of(path, context['robot_file'], *calibrations)
    return mapping


def guess_mapping(dataset: LeRobotDataset, robot: str, calibration: Path | None) -> dict[str, Any]:
    """Return the values of a mapping for columns that are named like the robot's joints.

    Views are the colour features that the calibration has, by the last part of their names.
    Without a calibration all colour features are views, whose cameras are not known.

    Raises:
        ConfigError: the calibration has none of the views, or there is no colour feature.
        CalibrationError: the calibration cannot be used.
    """
    found = _view_names(dataset.colour_features())
    known = found.keys() if calibration is None else load_calibration(calibration).keys()
    views = {view: {'feature': name} for view, name in found.items() if view in known}
    if not views:
        cameras = '' if calibration is None else f"'{calibration}' has views {', '.join(known)}, "
        raise ConfigError(
            f"{cameras and f'{cameras}and '}'{dataset.root}' has {', '.join(found) or 'none'}; "
            'call them alike, or write a mapping (--mapping)'
        )
    if calibration is not None:
        views = {k: {**v, 'calibration': str(calibration.resolve())} for k, v in views.items()}
    joints = load_robot(_robot_path(robot, Path())).joint_names
    action = _guess_features(dataset, joints, _ACTIONS)
    is_path = Path(robot).suffix in ('.yaml', '.yml')
    return {
        'robot': str(Path(robot).resolve()) if is_path else robot,
        'views': views,
        'state': {'feature': _guess_features(dataset, joints, _STATES) or _STATES[0]},
        'action': {'feature': action} if action else 'state',
    }


def _view_names(features: Sequence[str]) -> dict[str, str]:
    """Return image features by the shortest ends of their names that differ, as names of views."""
    for parts in range(1, max((name.count('.') for name in features), default=0) + 2):
        names = ['_'.join(name.split('.')[-parts:]) for name in features]
        if len(set(names)) == len(names):
            break
    return dict(zip(names, features, strict=True)) if features else {}


def _guess_features(
    dataset: LeRobotDataset, joints: Sequence[str], stems: Sequence[str]
) -> str | list[str]:
    """Return the feature of joint positions, or the features that they are split into.

    A data set has either one feature of a stem's name, or several below it, e.g.
    `observation.state.arm.position`, with columns that are named like the robot's joints. Where
    several have a joint, those that are called a position count. Empty if there is none.
    """
    for stem in stems:
        if stem in dataset.features:
            return stem
    below = {
        name: set(dataset.column_names(name)) & set(joints)
        for name in dataset.features
        if name.startswith(tuple(f'{stem}.' for stem in stems))
    }
    held = [name for name, found in below.items() if found]
    counts = Counter(joint for name in held for joint in below[name])
    if any(count > 1 for count in counts.values()):
        held = [name for name in held if 'position' in name]
    return held


def digest_of(*files: Path | None, start: bytes = b'') -> str:
    """Return a key that changes with the contents of the files, of a folder those in it."""
    digest = hashlib.sha256(start)
    for given in files:
        is_folder = given is not None and given.is_dir()
        inside = sorted(given.iterdir()) if given is not None and is_folder else [given]
        for file in inside:
            if is_folder and (file is None or not file.is_file()):
                continue
            require_regular(*filter(None, [file]))
            digest.update(b'' if file is None else file.read_bytes())
    return digest.hexdigest()[:16]
