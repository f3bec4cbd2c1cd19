"""Parameters of a node: the fields of a schema say default, range, choices and meaning, once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from textwrap import wrap
from typing import Annotated, Any, ClassVar, get_args, get_origin, Literal

from pydantic import AfterValidator, Field
from pydantic.fields import FieldInfo
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter
import yaml

from mtv_world_ros.core.config import ListOf, Model, Schema
from mtv_world_ros.core.errors import ConfigError, MtvWorldError, nearest, UnknownNameError
from mtv_world_ros.robot.plan import PlanLimits
from mtv_world_ros.ros.messages.request_limits import RefusingCallback
from mtv_world_ros.vision.segmenters.registry import SEGMENTERS

Span = tuple[float, float]
Mode = Literal['observe', 'imagine']
#: a list of texts; empty ones are left out
Names = Annotated[ListOf[str], AfterValidator(lambda names: tuple(filter(None, names)))]


def parameter(default: Any, text: str, within: Span | None = None) -> Any:
    """Return the field of a parameter that can be set at any time.

    Args:
        default: default of the parameter.
        text: meaning of the parameter, in Markdown.
        within: least and greatest allowed value.
    """
    low, high = within or (None, None)
    return Field(default, description=text, ge=low, le=high)


def at_start(default: Any, text: str, within: Span | None = None) -> Any:
    """Return the field of a parameter that is read-only while the node runs."""
    low, high = within or (None, None)
    return Field(default, description=text, ge=low, le=high, json_schema_extra={'read_only': True})


_SECONDS = (0.001, 86400.0)
#: parameters of earlier versions -> what holds now
REMOVED = {
    'publish_compressed': 'predictions are always offered as JPEG too',
    'jpeg_quality': 'the quality is 90',
    'publish_trajectory_video': 'the trajectory video is always offered',
    'publish_masks': 'masks are always offered',
    'rollout_timeout_s': 'a rollout that takes longer than 300 s ends the episode',
    'frames_timeout_s': 'frames are lost that arrive later than 10 s after their rollout',
}
#: services that change parameters
_SET_SERVICES = ('set_parameters', 'set_parameters_atomically')


class CheckpointSettings(Schema):
    """Parameters of every node that loads a checkpoint."""

    checkpoint: str = at_start(
        'bundled', "Checkpoint folder; 'bundled' and 'bundled-paper' ship with the package."
    )
    robot_file: str = at_start(
        '', "Robot YAML or a bundled robot's name; empty = the checkpoint's."
    )
    compressed_input: bool = at_start(
        False, 'Subscribe to `<camera>/image_raw/compressed` (JPEG or PNG).'
    )


class ObservationSettings(Schema):
    """Limits of an observation, and the calibration of its cameras."""

    calibration_file: str = parameter(
        '',
        "YAML with every view's pose; empty = the one in the checkpoint. Read again when an "
        'episode begins (`~/reset`, `~/start`).',
    )
    joint_state_topics: Names = at_start(
        (),
        'Topics of the measured positions, several where an arm and its gripper have their own; '
        'empty = joint_states.',
    )
    max_image_age_s: float = parameter(0.5, 'Older images are no observation [s].', _SECONDS)
    max_joint_state_age_s: float = parameter(
        0.5, 'Older joint states are no observation [s].', _SECONDS
    )
    max_view_skew_s: float = parameter(
        0.05, 'Images of views further apart are no observation [s].', _SECONDS
    )
    place: str = parameter(
        '',
        'Name of this robot cell, as in `mtv-world fit contact --place`. Where contact parameters '
        'were fitted in another one, futures are drawn from a wide prior, and most successes stay '
        'open until ten executed plans of their task ended as foreseen; the evidence is kept in '
        '`$ROS_HOME/mtv_world/cells`. Simulated episodes are of '
        "'simulator/PHYSICS'.",
    )


class NodeSettings(ObservationSettings, CheckpointSettings):
    """Parameters of every node that observes."""


class LiveSettings(ObservationSettings):
    """Parameters of every node that takes the robot's description and TF."""

    use_robot_description: bool = at_start(
        True,
        'Take lengths, offsets and limits of the robot from the topic `robot_description`; while '
        'it describes another robot, trajectories are rejected.',
    )
    extrinsics: Literal['auto', 'tf', 'file'] = at_start(
        'auto',
        "Where the cameras' poses come from: /tf and /tf_static (needs tf2_msgs), or the "
        'calibration file; auto = TF if it leads from the frame of the images to the robot and '
        '`calibration_file` is empty.',
    )
    tf_prefix: str = at_start('', 'Prefix of the frame names in TF, e.g. `left_cell/`.')
    max_tf_age_s: float = parameter(
        1.0,
        'Camera poses from /tf that are older than the image by more are no observation [s].',
        _SECONDS,
    )


class Settings(LiveSettings, NodeSettings):
    """Parameters of the node `world_model`."""

    basic: ClassVar = (
        'checkpoint',
        'robot_file',
        'calibration_file',
        'joint_state_topics',
        'compressed_input',
        'device',
        'task',
        'segmenter',
        'instruction',
        'objects',
        'place',
        'mode',
        'foresight',
    )

    device: str = at_start('cpu', 'Device of the model: cpu, cuda, cuda:1.')
    num_threads: int = at_start(
        0,
        'CPU threads of the model; 0 = all cores but one, of two both (motions: all).',
        (0, 1024),
    )
    serving: str = at_start(
        '', 'What makes the model faster or smaller, e.g. `compile=true`; see docs/serving.md.'
    )
    task: str = at_start(
        '', 'Task to judge: name or YAML file; empty = the one the instruction matches.'
    )
    segmenter: str = at_start(
        'auto',
        f'What finds the objects: {", ".join(SEGMENTERS)}, module:Class of your own or a file of '
        'examples; auto = sam2 if MTV_WORLD_WEIGHTS has its weights, else colour.',
    )
    describer: str = at_start(
        '',
        "YAML of what names the objects of an episode's first real frame where `objects` is "
        "empty, like config/describer.yaml; empty = the instruction's colour words.",
    )
    foresight: bool = at_start(
        True,
        'Foresee where objects go, where the checkpoint can; false = the imagined frames alone '
        "decide, and the model is shown no objects that it was not trained with (the paper's "
        "method is the checkpoint 'bundled-paper').",
    )
    camera_check: bool = at_start(
        True,
        "Compare the first pictures of an episode with the arm's outline, correct small errors of "
        'the calibration for the episode, and give no verdict on large ones.',
    )
    mode: Mode = at_start('observe', 'Mode at start; `~/imagine` changes it.')
    autostart: bool = at_start(
        True, 'Configures and activates itself; false = a lifecycle manager does that.'
    )
    publish_tf: bool = at_start(
        True, 'Publish the frames of the views to /tf_static where TF lacks them.'
    )
    diagnostics_period_s: float = at_start(1.0, 'Period of /diagnostics [s].', (0.05, 60.0))
    adapter: str = parameter(
        '',
        "LoRA adapter, taken between rollouts: folder or file; empty = the checkpoint's, none = "
        'without.',
    )
    instruction: str = parameter(
        '', 'The instruction until the topic `instruction` gives another.'
    )
    objects: Names = parameter(
        (),
        "Names of the objects, e.g. red block; `['']` = the ones that `describer` names, else "
        'those of the topic `objects`.',
    )
    seed: int = parameter(0, 'Seed of the noise; chunk k uses seed + k.', (0, 2**31 - 1))
    num_seeds: int = parameter(
        1,
        'Rollouts of a plan whose mean the success estimate is; each takes as long as one.',
        (1, 64),
    )
    trusted_jaccard: float = parameter(
        0.7, 'Reports say up to which time J is expected to be at least this.', (0.0, 1.0)
    )
    num_inference_steps: int = parameter(
        0, 'Denoising steps a chunk; 0 = those the checkpoint is made for, else 4.', (0, 1000)
    )
    least_goal_success: float = parameter(
        0.0,
        'Goals of `~/follow_joint_trajectory` whose success estimate is lower, or abstains, fail; '
        '0 = the estimate is only reported.',
        (0.0, 1.0),
    )
    max_trajectory_age_s: float = parameter(
        1.0,
        'Trajectories stamped longer before their observation are rejected [s].',
        (0.001, 3600.0),
    )
    max_horizon_s: float = parameter(
        60.0,
        'Trajectories that end later after their observation are rejected [s].',
        (0.001, 3600.0),
    )
    limit_tolerance: float = parameter(
        1e-3, 'Joints may exceed their limits by this [rad or m].', (0.0, 0.1)
    )
    stuck_after_s: float = parameter(
        600.0,
        'A model that does not end a denoising step for this time is given up: the rollout fails, '
        'and a new thread takes over [s]. The first step may compile.',
        (0.1, 86400.0),
    )
    stamp_mode: Literal['target', 'source'] = parameter(
        'target', 'Stamp of predictions: the predicted time, or the observation they come from.'
    )
    pace: Literal['realtime', 'burst'] = parameter(
        'realtime', 'When images go out: one period before their stamps, or each chunk at once.'
    )

    @property
    def plan_limits(self) -> PlanLimits:
        """Limits within which a plan is accepted."""
        return PlanLimits(
            tolerance=self.limit_tolerance,
            max_age_s=self.max_trajectory_age_s,
            max_horizon_s=self.max_horizon_s,
            may_omit_joints=True,
        )


def help_text(name: str, kind: type[Schema]) -> str:
    """Return what a node prints on `--help`."""
    lines = [f'usage: {name} [--ros-args [-p PARAMETER:=VALUE] [--params-file FILE]]', '']
    fields = kind.model_fields
    for parameter_name in sorted(fields, key=lambda one: one not in kind.basic):
        if parameter_name not in kind.basic and 'advanced:' not in lines and kind.basic:
            lines += ['', 'advanced:', '']
        field = fields[parameter_name]
        lines += [f'  {parameter_name}  {shown_default(field)}  {valid_values(field)}'.rstrip()]
        lines += [f'      {line}' for line in wrap(field.description or '', 90)]
    return '\n'.join(lines)


def declare(node: Node, kind: type[Schema]) -> None:
    """Declare the fields on the node; later changes are held to their ranges and choices.

    Raises:
        ConfigError: a value given at start-up is refused.
    """
    for name, field in kind.model_fields.items():
        _declare(node, name, field)
    node.add_on_set_parameters_callback(refusing(partial(_check, node, kind)))
    guard_parameter_services(node)


def guard_parameter_services(node: Node) -> None:
    """Let the node's parameter services refuse requests that rclpy fails on.

    Without it a value of an unknown type ends the executor, and with it the node. A second call
    changes nothing.
    """
    for service in node.services:
        name = service.srv_name.rpartition('/')[2]
        if name in _SET_SERVICES and not isinstance(
            service.callback, _Answered | RefusingCallback
        ):
            service.callback = _Answered(service.callback)


def refusing(
    check: Callable[[list[Parameter]], None],
) -> Callable[[list[Parameter]], SetParametersResult]:
    """Return a set-parameters callback that refuses with the text of what `check` raises."""

    def called(changed: list[Parameter]) -> SetParametersResult:
        try:
            check(changed)
        except MtvWorldError as error:
            return SetParametersResult(successful=False, reason=str(error))
        except Exception as error:  # of a file system, a library: the node outlives it
            return SetParametersResult(successful=False, reason=f'{type(error).__name__}: {error}')
        return SetParametersResult(successful=True)

    return called


class _Answered:
    """Callback of a parameter service that always answers.

    Args:
        serve: rclpy's callback.
    """

    def __init__(self, serve: Callable[[Any, Any], Any]) -> None:
        self._serve = serve

    def __call__(self, request: Any, response: Any) -> Any:
        try:
            return self._serve(request, response)
        except Exception as error:
            reason = f'{type(error).__name__}: {error}'
            refused = SetParametersResult(successful=False, reason=reason)
            if hasattr(response, 'results'):
                done = len(response.results)
                response.results += [refused] * (len(request.parameters) - done)
            else:
                response.result = refused
            return response


def declare_one(
    node: Node,
    name: str,
    default: Any,
    described: ParameterDescriptor,
    within: str = '',
    *,
    empty: Any = None,
) -> Any:
    """Declare one parameter and returns its value.

    Args:
        node: node that gets the parameter.
        name: name of the parameter.
        default: default of the parameter, which gives the type.
        described: range and meaning.
        within: range, in words.
        empty: value that `[]` stands for, which rclpy takes as "not set"; None = it is refused.

    Raises:
        ConfigError: the value given at start-up is refused.
    """
    kind = type(default).__name__
    given = node._parameter_overrides.get(name)  # rclpy has no public way to ask
    is_unset = given is not None and given.type_ == Parameter.Type.NOT_SET
    if is_unset and empty is None:
        raise ConfigError(
            f"parameter '{name}' is given without a value, or as []; it must be of type "
            f'{kind}{within}, or be left out'
        )
    try:
        return node.declare_parameter(
            name, empty if is_unset else default, described, ignore_override=is_unset
        ).value
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        raise ConfigError(f"parameter '{name}' must be of type {kind}{within}: {error}") from error


def refuse_unknown(node: Node) -> None:
    """Refuse parameters that were given at start-up and that the node does not have.

    Call it when all parameters are declared.

    Raises:
        ConfigError: there are unknown parameters; the error names similar ones.
    """
    known = node.list_parameters([], 0).names
    # rclpy has no public way to ask for what was given
    unknown = [name for name in node._parameter_overrides if not node.has_parameter(name)]
    gone = [f"'{name}': {REMOVED[name]}" for name in unknown if name in REMOVED]
    if gone:
        raise ConfigError(
            f"'{node.get_name()}' no longer has the parameter {', '.join(gone)}; images are made "
            'for subscribers alone. Delete it from the parameter file'
        )
    if unknown:
        names = ', '.join(f"'{name}'{nearest(name, known)}" for name in unknown)
        raise ConfigError(f"'{node.get_name()}' has no parameter {names}; --help lists them")


def declare_camera_topics(node: Node, views: Sequence[str]) -> dict[str, str]:
    """Declare `camera_topics.<view>` and returns each view's camera topic, by default its name.

    Raises:
        ConfigError: a value given at start-up is refused.
    """
    topics = {}
    for view in views:
        text = f"Topic prefix of view '{view}': <it>/image_raw and <it>/camera_info."
        topics[view] = str(_declare(node, f'camera_topics.{view}', at_start(view, text)))
    return topics


def read(node: Node, kind: type[Model]) -> Model:
    """Return the present values."""
    return kind(**{name: node.get_parameter(name).value for name in kind.model_fields})


def shown_default(field: FieldInfo) -> str:
    """Return the default as YAML, or `empty`."""
    if field.default in ('', ()):
        return 'empty'
    return yaml.safe_dump(field.default).split('\n')[0]


def valid_values(field: FieldInfo) -> str:
    """Return range or choices as text, empty if any value of the type is valid."""
    limits = span(field)
    return '{:.10g} … {:.10g}'.format(*limits) if limits else ', '.join(choices(field))


def choices(field: FieldInfo) -> tuple[str, ...]:
    """Return the only valid values; empty = any of the type."""
    kind = field.annotation
    return get_args(kind) if get_origin(kind) is Literal else ()


def span(field: FieldInfo) -> Span | None:
    """Return least and greatest value."""
    limits = {
        key: getattr(item, key)
        for item in field.metadata
        for key in ('ge', 'le')
        if hasattr(item, key)
    }
    return (limits['ge'], limits['le']) if limits else None


def is_read_only(field: FieldInfo) -> bool:
    """Return whether the parameter is read only when the node starts."""
    return bool(field.json_schema_extra)


def descriptor(field: FieldInfo) -> ParameterDescriptor:
    """Return what `ros2 param describe` shows."""
    described = ParameterDescriptor(description=field.description, read_only=is_read_only(field))
    if choices(field):
        described.additional_constraints = f'one of: {", ".join(choices(field))}'
    limits = span(field)
    if limits and isinstance(field.default, int):
        low, high = map(int, limits)
        described.integer_range = [IntegerRange(from_value=low, to_value=high)]
    elif limits:
        low, high = map(float, limits)
        described.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return described


def _declare(node: Node, name: str, field: FieldInfo) -> object:
    if node.has_parameter(name):  # a lifecycle node is configured again
        return node.get_parameter(name).value
    default = [''] if field.default == () else field.default  # ROS has no empty list
    limits = span(field)
    within = ' in [{:g}, {:g}]'.format(*limits) if limits else ''
    is_list = isinstance(default, list)
    value = declare_one(
        node, name, default, descriptor(field), within, empty=[''] if is_list else None
    )
    refused = _refusal(name, field, value)
    if refused:
        raise ConfigError(f'parameter {refused}')
    return value


def _refusal(name: str, field: FieldInfo, value: object) -> str:
    """Return why a choice is refused, or an empty text; ROS checks types and ranges."""
    valid = choices(field)
    if not valid or value in valid:
        return ''
    return str(UnknownNameError(f'{name} is', str(value), valid, listed='; it must be one of'))


def _check(node: Node, kind: type[Schema], parameters: list[Parameter]) -> None:
    """Refuse values outside the schema: choices, ranges, numbers that are not finite.

    Raises:
        ConfigError: names the parameter and what would be valid.
    """
    changed = {one.name: one.value for one in parameters if one.name in kind.model_fields}
    for name, value in changed.items():
        refused = _refusal(name, kind.model_fields[name], value)
        if refused:
            raise ConfigError(refused)
    if changed:
        present = {name: node.get_parameter(name).value for name in kind.model_fields}
        kind(**present | changed)
