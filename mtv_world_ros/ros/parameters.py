"""The node's parameters: one table with defaults, ranges and what they mean."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from mtv_world_ros.errors import ConfigError, nearest
from mtv_world_ros.vision.segmenters.choose import SEGMENTERS

MODES = ('observe', 'imagine')
STAMP_MODES = ('target', 'source')
PACES = ('realtime', 'burst')


@dataclass(frozen=True, slots=True)
class Entry:
    """One parameter: `bounds` or `choices` limit it, `read_only` = set at start-up only."""

    name: str
    default: object
    description: str
    bounds: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = False

    def descriptor(self) -> ParameterDescriptor:
        """What `ros2 param describe` shows."""
        described = ParameterDescriptor(description=self.description, read_only=self.read_only)
        if self.choices:
            described.additional_constraints = f'one of: {", ".join(self.choices)}'
        if self.bounds is not None:
            low, high = self.bounds
            if isinstance(self.default, int):
                described.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
            else:
                span = FloatingPointRange(from_value=float(low), to_value=float(high))
                described.floating_point_range = [span]
        return described

    def check(self, value: object) -> str:
        """Returns why the value is refused, or an empty text."""
        if self.choices and value not in self.choices:
            hint = nearest(str(value), self.choices)
            return f"{self.name} is '{value}'{hint}; it must be one of {', '.join(self.choices)}"
        if self.bounds is None:
            return ''
        low, high = self.bounds
        if not low <= value <= high:  # type: ignore[operator]
            return f'{self.name} is {value}; it must be in [{low:g}, {high:g}]'
        return ''


_at_start = partial(Entry, read_only=True)
_AGE = (0.001, 3600.0)
#: `Settings` has a field for every row
TABLE: tuple[Entry, ...] = (
    _at_start('checkpoint', 'bundled', "Checkpoint folder; 'bundled' ships with the package."),
    _at_start('robot_file', '', "Robot YAML or a bundled robot's name; empty = the checkpoint's."),
    _at_start('device', 'cpu', 'Device of the model: cpu, cuda, cuda:1.'),
    _at_start(
        'num_threads', 0, 'CPU threads of the model; 0 = all cores but one.', bounds=(0, 1024)
    ),
    _at_start(
        'serving', '', "What makes the model faster or smaller, e.g. 'compile=true'; see README."
    ),
    _at_start(
        'task', '', 'Task to judge: name or YAML file; empty = the one the instruction matches.'
    ),
    _at_start(
        'segmenter',
        'auto',
        'What finds the objects; auto = sam2 if MTV_WORLD_WEIGHTS has its weights, else colour.',
        choices=SEGMENTERS,
    ),
    _at_start(
        'compressed_input', False, 'Subscribe to <camera>/image_raw/compressed (JPEG or PNG).'
    ),
    _at_start('mode', 'observe', 'Mode at start; ~/imagine changes it.', choices=MODES),
    _at_start('diagnostics_period_s', 1.0, 'Period of /diagnostics [s].', bounds=(0.05, 60.0)),
    Entry(
        'calibration_file',
        '',
        "YAML with every view's pose; empty = config/cameras/<robot>.yaml of the package. It is "
        'read again at ~/reset.',
    ),
    Entry(
        'adapter',
        '',
        "LoRA adapter, taken between rollouts: folder or file; empty = the checkpoint's, none = "
        'without.',
    ),
    Entry('instruction', '', 'What the robot is told until the topic `instruction` says so.'),
    Entry(
        'objects',
        [''],
        'Names of the objects, e.g. red block; [""] = the ones the instruction names.',
    ),
    Entry('seed', 0, 'Seed of the noise; chunk k uses seed + k.', bounds=(0, 2**31 - 1)),
    Entry(
        'num_seeds',
        1,
        'Rollouts of a plan whose mean the success estimate is; each takes as long as one.',
        bounds=(1, 64),
    ),
    Entry(
        'trusted_jaccard',
        0.7,
        'Reports say up to which time J is expected to be at least this.',
        bounds=(0.0, 1.0),
    ),
    Entry(
        'num_inference_steps',
        0,
        'Denoising steps a chunk; 0 = those the checkpoint is made for, else 4.',
        bounds=(0, 1000),
    ),
    Entry('max_image_age_s', 0.5, 'Older images reject a trajectory [s].', bounds=_AGE),
    Entry(
        'max_joint_state_age_s', 0.5, 'Older joint states reject a trajectory [s].', bounds=_AGE
    ),
    Entry('max_view_skew_s', 0.05, 'Views further apart reject a trajectory [s].', bounds=_AGE),
    Entry(
        'max_trajectory_age_s',
        1.0,
        'Trajectories stamped longer before their observation are rejected [s].',
        bounds=_AGE,
    ),
    Entry(
        'max_horizon_s',
        60.0,
        'Trajectories that end later after their observation are rejected [s].',
        bounds=_AGE,
    ),
    Entry(
        'limit_tolerance',
        1e-3,
        'Joints may exceed their limits by this [rad or m].',
        bounds=(0.0, 0.1),
    ),
    Entry(
        'stamp_mode',
        'target',
        'Stamp of predictions: the predicted time, or the observation they come from.',
        choices=STAMP_MODES,
    ),
    Entry(
        'pace',
        'realtime',
        "How frames go out: at the model's frame rate, or each chunk at once.",
        choices=PACES,
    ),
    Entry('publish_compressed', True, 'Offer predictions as JPEG too (made when subscribed).'),
    Entry('jpeg_quality', 90, 'Quality of those.', bounds=(1, 100)),
    Entry('publish_trajectory_video', True, 'Publish the control video (when subscribed).'),
    Entry('publish_masks', True, 'Publish the object masks (when subscribed).'),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Values of the parameters in `TABLE`, by the same names."""

    checkpoint: str
    robot_file: str
    device: str
    num_threads: int
    serving: str
    task: str
    segmenter: str
    compressed_input: bool
    mode: str
    diagnostics_period_s: float
    calibration_file: str
    adapter: str
    instruction: str
    objects: tuple[str, ...]
    seed: int
    num_seeds: int
    trusted_jaccard: float
    num_inference_steps: int
    max_image_age_s: float
    max_joint_state_age_s: float
    max_view_skew_s: float
    max_trajectory_age_s: float
    max_horizon_s: float
    limit_tolerance: float
    stamp_mode: str
    pace: str
    publish_compressed: bool
    jpeg_quality: int
    publish_trajectory_video: bool
    publish_masks: bool


def declare(node: Node, table: Sequence[Entry] = TABLE) -> None:
    """Declares the table on the node and keeps later changes to what the table allows.

    Raises:
        ConfigError: a value given at start-up is refused.
    """
    for entry in table:
        _declare(node, entry)
    by_name = {entry.name: entry for entry in table}
    node.add_on_set_parameters_callback(partial(_check, by_name))


def declare_camera_topics(node: Node, views: Sequence[str]) -> dict[str, str]:
    """Declares `camera_topics.<view>` and returns each view's camera topic, by default its name.

    Raises:
        ConfigError: a value given at start-up is refused.
    """
    topics = {}
    for view in views:
        text = f"Topic prefix of view '{view}': <it>/image_raw and <it>/camera_info."
        topics[view] = _declare(node, _at_start(f'camera_topics.{view}', view, text))
    return topics


def read(node: Node) -> Settings:
    """The present values."""
    values = {field.name: node.get_parameter(field.name).value for field in fields(Settings)}
    values['objects'] = tuple(name for name in values['objects'] or () if name)
    return Settings(**values)  # type: ignore[arg-type]


def _declare(node: Node, entry: Entry) -> str:
    try:
        value = node.declare_parameter(entry.name, entry.default, entry.descriptor()).value
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        span = '' if entry.bounds is None else ' in [{:g}, {:g}]'.format(*entry.bounds)
        kind = type(entry.default).__name__
        raise ConfigError(
            f"parameter '{entry.name}' must be of type {kind}{span}: {error}"
        ) from error
    refused = entry.check(value)
    if refused:
        raise ConfigError(f'parameter {refused}')
    return str(value)


def _check(by_name: Mapping[str, Entry], parameters: list[Parameter]) -> SetParametersResult:
    for parameter in parameters:
        entry = by_name.get(parameter.name)
        refused = entry.check(parameter.value) if entry else ''
        if refused:
            return SetParametersResult(successful=False, reason=refused)
    return SetParametersResult(successful=True)
