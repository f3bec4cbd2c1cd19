"""The mapping file: which features of a dataset are which view, joint and camera."""

from __future__ import annotations

from collections.abc import Sequence
import hashlib
from pathlib import Path
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationInfo,
)

from mtv_world_ros.config import ListOf, read_yaml, validated, wrong
from mtv_world_ros.data.bag_mapping import Written
from mtv_world_ros.data.episode import check_outcome
from mtv_world_ros.data.tool_targets import add_tool_poses, tool_joints
from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import ConfigError, nearest
from mtv_world_ros.files import bundled
from mtv_world_ros.geometry.calibration_file import load_calibration
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.geometry.robot.joint_columns import JointEntries, JointTable, to_positions
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.lab.importing.camera_parameters import CameraSource
from mtv_world_ros.lab.importing.lerobot import LeRobotDataset
from mtv_world_ros.lab.importing.tool_poses import ToolPoses


class Stream(JointTable):
    """Joint values of a feature."""

    feature: str = Field(description='name in the dataset')
    joints: JointEntries | None = None


class ActionStream(Stream):
    """What is commanded: joint values, differences of them, or poses of tools."""

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

    def _needed(self, robot: RobotModel) -> Sequence[str]:
        led = tool_joints(self.tools, robot)
        both = sorted(led & set(self.joints or ()))
        if both:
            raise ValueError(f'joints {both} follow from the poses of `tools`; give one of both')
        for joint in self.differences:
            if joint in led or joint not in robot.joint_names:
                known = [name for name in robot.joint_names if name not in led]
                raise ValueError(
                    f"differences: '{joint}' is not among {known}{nearest(joint, known)}"
                )
        return [joint for joint in robot.joint_names if joint not in led]

    def commanded(
        self, values: FloatArray, names: Sequence[str], measured: FloatArray, robot: RobotModel
    ) -> tuple[FloatArray, tuple[str, ...]]:
        """Returns (T, J) positions of a feature's values (T, C), and what was odd.

        Args:
            values: in the dataset's units.
            names: of the columns; empty where the dataset does not name them.
            measured: (T, J) positions of the same rows.
            robot: gives the order of joints, and the tools.

        Raises:
            ConfigError: a column is not there.
            EpisodeError: most poses of a tool are out of reach.
        """
        positions = measured.copy()
        at = [robot.joint_names.index(column.joint) for column in self.columns]
        positions[:, at] = to_positions(values, names, self.columns, self.feature)
        added = [robot.joint_names.index(joint) for joint in self.differences]
        positions[:, added] += measured[:, added]
        odd = [
            add_tool_poses(
                positions, measured, robot, arm, poses, poses.wanted(values, names, self.feature)
            )
            for arm, poses in self.tools.items()
        ]
        return positions, tuple(filter(None, odd))


def load_mapped_robot(name: Any, info: ValidationInfo[dict[str, Any]]) -> RobotModel:
    """Loads the robot that a mapping names; its file is put into the context."""
    if not isinstance(name, str):
        raise wrong("the name of a bundled robot, or a robot's YAML")
    is_path = Path(name).suffix in ('.yaml', '.yml')
    file = info.context['folder'] / name if is_path else bundled('robots', name, 'robot')
    info.context.update(robot_file=file, robot=load_robot(file))
    return info.context['robot']


def _not_from_state(value: Any) -> Any:
    return None if value == 'state' else value


def _named(views: dict[str, CameraSource]) -> dict[str, CameraSource]:
    if not views:
        raise ValueError("'views' is empty; name at least one")
    return {view: source.model_copy(update={'view': view}) for view, source in views.items()}


class DatasetMapping(Written):
    """A mapping file."""

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
    jpeg_quality: int = Field(default=90, ge=1, le=100)
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
    """Reads a mapping file; `config/datasets/example.yaml` describes its keys.

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


def guess_mapping(
    dataset: LeRobotDataset, robot: str, calibration: Path
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Returns the values of a mapping for columns that are named like the robot's joints.

    Views are the image features that the calibration has, by the last part of their names; the
    others are returned beside.

    Raises:
        ConfigError: the calibration has none of the views.
        CalibrationError: the calibration cannot be used.
    """
    known = load_calibration(calibration)
    features = [n for n, f in dataset.features.items() if f.get('dtype') in ('video', 'image')]
    found = {name.rpartition('.')[2]: name for name in features}
    if not found.keys() & known.keys():
        raise ConfigError(
            f"'{calibration}' has views {', '.join(known)}, and '{dataset.root}' has "
            f'{", ".join(found) or "none"}; call them alike, or write a mapping (--mapping)'
        )
    file = str(calibration.resolve())
    is_path = Path(robot).suffix in ('.yaml', '.yml')
    values = {
        'robot': str(Path(robot).resolve()) if is_path else robot,
        'views': {
            view: {'feature': name, 'calibration': file}
            for view, name in found.items()
            if view in known
        },
        'state': {'feature': 'observation.state'},
        'action': {'feature': 'action'} if 'action' in dataset.features else 'state',
    }
    return values, tuple(name for view, name in found.items() if view not in known)


def digest_of(*files: Path | None, start: bytes = b'') -> str:
    """Returns a key that changes with the contents of the files."""
    digest = hashlib.sha256(start)
    for file in files:
        digest.update(b'' if file is None else file.read_bytes())
    return digest.hexdigest()[:16]
