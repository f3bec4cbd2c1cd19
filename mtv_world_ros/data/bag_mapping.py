"""Mapping files of bags: which topics hold views, joint states and commands."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, BeforeValidator, Field

from mtv_world_ros.core.config import Length, ListOf, Number, read_yaml, Schema, Seconds, validated
from mtv_world_ros.data.episode import check_outcome
from mtv_world_ros.data.tool_targets import ToolTargets

STATE = 'state'
#: key of `joints` whose value is taken off the recorded names
PREFIX = 'prefix'
#: end of the names of ros2_control's position interfaces, which broadcasters may publish as joints
_INTERFACE = '/position'


class ViewSource(Schema):
    """Topics of a view."""

    image: str = Field(description='topic of Image, CompressedImage or FFMPEGPacket')
    camera_info: str = Field(default='', description='default: beside the images')
    frame: str = Field(
        default='', description="optical frame in TF; default: the CameraInfo's, or the images'"
    )


class ToolTopic(ToolTargets):
    """Topic of the commanded poses of an arm's tool."""

    topic: str = Field(description='of PoseStamped')
    frame: str = Field(
        default='',
        description='link that poses are in; empty = that of their header, else the base link',
    )


def _view(value: Any) -> Any:
    return {'image': value} if isinstance(value, str) else value


#: begins a value that is read from each recording: `key: NAME`
_KEY = 'key:'


def key_of(value: str) -> str:
    """Return NAME of a value `key: NAME`, which each recording has; empty = it is for all."""
    return value.removeprefix(_KEY).strip() if value.startswith(_KEY) else ''


def keyed(value: Any) -> Any:
    """Return the text `key: NAME` that YAML has read as a mapping, because quotes are missing."""
    is_key = isinstance(value, dict) and list(value) == ['key'] and isinstance(value['key'], str)
    return f'{_KEY} {value["key"]}' if is_key else value


def _check_outcome(value: str) -> str:
    return value if key_of(value) else check_outcome(value)


class Written(Schema):
    """Description and encoding of the episodes that an import writes."""

    task: str = Field(default='', description='name of the task; empty = none')
    outcome: Annotated[str, AfterValidator(_check_outcome), BeforeValidator(keyed)] = Field(
        default='unknown',
        description='success, failure or unknown; or `key: NAME`: each recording has its own '
        '(videos: of the file of rows; bags: of custom_data in metadata.yaml)',
    )
    objects: ListOf[str] = Field(default=(), description='names of the objects')
    chunk_s: Seconds = Field(default=3.2, description='length of a joint trajectory message [s]')
    limit_tolerance: Length = Field(
        default=0.05, description='positions further outside the joint limits fail [rad or m]'
    )
    jpeg_quality: int = Field(
        default=95, ge=1, le=100, description='quality of the JPEG images that are written'
    )


class BagMapping(Written):
    """A mapping file of bags; topics without a leading slash are in the namespace."""

    basic: ClassVar = ('robot', 'views', 'joint_states', 'action')

    robot: str = Field(
        default='',
        description="name of a bundled robot or a robot's YAML relative to this file; empty = "
        'the one of `/robot_description`',
    )
    namespace: str = Field(default='', description='namespace of the robot, e.g. `left_arm`')
    views: dict[str, Annotated[ViewSource, BeforeValidator(_view)]] = Field(
        default={}, description='topic of the images by view; empty = `<view>/image_raw`'
    )
    joint_states: str | Annotated[ListOf[str], Field(min_length=1)] = Field(
        default='joint_states',
        description='topic of the measured positions (JointState), or a list of topics: of an arm '
        'and its gripper',
    )
    state_joints: ListOf[str] = Field(
        default=(),
        description='joints of JointState messages of measured positions that have no names, in '
        'their order',
    )
    joints: dict[str, str] = Field(
        default={},
        description="the robot's name of a joint, by the recorded one; `prefix: NAME` takes NAME "
        'off all recorded names that begin with it',
    )
    constants: dict[str, Number] = Field(
        default={}, description='positions of joints that are not measured, by name [rad or m]'
    )
    action: str = Field(
        default='joint_trajectory',
        description='topic of the commanded positions: JointTrajectory, JointState, state of a '
        'JointTrajectoryController, goals or feedback of FollowJointTrajectory, or '
        'Float64MultiArray; `state` = the measured ones that follow',
    )
    action_joints: ListOf[str] = Field(
        default=(),
        description='joints of commands without names (Float64MultiArray, JointState), in the '
        "order of the controller's `joints`",
    )
    tools: dict[str, ToolTopic] = Field(
        default={},
        description='commanded poses of the tools of arms, in place of their joints; `action` '
        'then has the other joints',
    )
    received_times: ListOf[str] = Field(
        default=(),
        description='views and streams (`joint_states`, `action`, arms of `tools`) whose receive '
        "times are taken in place of their headers' stamps",
    )
    robot_description: str = Field(
        default='robot_description', description='topic of the URDF, without `robot`'
    )
    tf_prefix: str = Field(default='', description='prefix of frame names in TF, which is removed')
    instruction_topic: str = Field(default='instruction', description='topic of the instruction')
    instruction: str = Field(
        default='', description='text for the robot; empty = the messages of `instruction_topic`'
    )

    def topic(self, name: str) -> str:
        """Return the absolute name of a topic."""
        if name.startswith('/'):
            return name
        return '/'.join(['', *filter(None, self.namespace.strip('/').split('/')), name])

    @property
    def state_topics(self) -> tuple[str, ...]:
        """Absolute names of the topics of the measured positions."""
        names = self.joint_states
        return tuple(map(self.topic, (names,) if isinstance(names, str) else names))

    def joint_name(self, recorded: str) -> str:
        """Return the robot's name of a recorded joint."""
        if recorded in self.joints and recorded != PREFIX:
            return self.joints[recorded]
        return recorded.removeprefix(self.joints.get(PREFIX, '')).removesuffix(_INTERFACE)

    def streams(self) -> dict[str, str]:
        """Return the topics by view and by stream, as `read_episode` takes them."""
        return {
            **{view: self.topic(row.image) for view, row in self.views.items()},
            'joint_states': self.state_topics[0],
            'joint_trajectory': self.topic(
                'joint_trajectory' if self.action == STATE else self.action
            ),
            'instruction': self.topic(self.instruction_topic),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeSource:
    """Topic names and calibration of recordings that were not made by this package.

    Attributes:
        mapping: names and kinds of the topics; None = the default names.
        calibration: camera calibration; None = `calibration.yaml` next to each recording, or TF.
    """

    mapping: BagMapping | None = None
    calibration: Path | None = None


def load_source(topics: Path | None, calibration: Path | None) -> EpisodeSource:
    """Return the source that `--topics` and `--calibration` name.

    Raises:
        ConfigError: the mapping file is missing or wrong.
    """
    mapping = None if topics is None else load_bag_mapping(topics)
    return EpisodeSource(mapping=mapping, calibration=calibration)


def load_bag_mapping(path: Path) -> BagMapping:
    """Read a mapping file; `config/datasets/bag.yaml` describes its keys.

    Raises:
        ConfigError: the file is missing, not YAML, or has unknown or wrong values.
    """
    mapping = validated(BagMapping, read_yaml(path, 'mapping file', '--topics'), str(path))
    if Path(mapping.robot).suffix in ('.yaml', '.yml'):
        mapping = mapping.replace(robot=str(path.parent / mapping.robot))
    return mapping
