"""Controls by name: those of the package, of entry points, and of `module:Class`."""

from __future__ import annotations

from collections.abc import Mapping
import json
from pathlib import Path

from mtv_world_ros.control.control import Control, ControlOptions
from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.entry_points import CONTROLS as GROUP
from mtv_world_ros.core.errors import CheckpointError, ConfigError, MtvWorldError
from mtv_world_ros.core.registry import Registry

TRAJECTORY_VIDEO = 'trajectory_video'
#: the paper's method, first, and its three baselines
CONTROLS: Mapping[str, str] = {
    TRAJECTORY_VIDEO: 'mtv_world_ros.control.trajectory_video:TrajectoryVideo',
    'policy2vec': 'mtv_world_ros.control.policy2vec:Policy2Vec',
    'ee_mlp': 'mtv_world_ros.control.ee_mlp:EndEffectorMlp',
    'fast_tokens': 'mtv_world_ros.control.fast_tokens:FastTokens',
}
#: what `fitted` found, in the folder of a checkpoint or a training
CONTROL_FILE = 'control.json'
_REGISTRY = Registry(
    kind='control',
    bundled=CONTROLS,
    group=GROUP,
    setting='video.control',
    required=('create', 'make', 'layout'),
    protocol='mtv_world_ros.control.control.Control',
)


def control_names() -> list[str]:
    """Return the names that are registered: the package's, then those of entry points."""
    return _REGISTRY.names()


def check_control_name(name: str) -> str:
    """Return a name that is registered, or of the form `module:Class`.

    Raises:
        ConfigError: it is neither.
    """
    return _REGISTRY.check(name)


def control_class(name: str) -> type[Control]:
    """Return the class of a control.

    Args:
        name: registered, or `module:Class`.

    Raises:
        ConfigError: no such control, or it cannot be imported.
    """
    return _REGISTRY.load(name)


def create_control(name: str, options: ControlOptions) -> Control:
    """Return a control that is not yet fitted.

    Raises:
        ConfigError: no such control, or it cannot be imported or created.
    """
    kind = control_class(name)
    try:
        return kind.create(options)
    except MtvWorldError:
        raise
    except Exception as error:  # a third-party class may raise anything
        raise ConfigError(
            f"control '{name}' cannot be created for robot '{options.robot.name}' "
            f'({type(error).__name__}: {error})'
        ) from error


def save_control(control: Control, name: str, folder: Path) -> None:
    """Write the fitted statistics of a control, if it has some, into a folder."""
    state = control.state()
    if state:
        text = json.dumps({'control': name, 'state': state}, ensure_ascii=False, indent=1)
        (folder / CONTROL_FILE).write_text(text + '\n', encoding='utf-8')


def load_control(name: str, options: ControlOptions, folder: Path) -> Control:
    """Return the control of a checkpoint, or of a training that is resumed.

    Args:
        name: name of the control.
        options: robot, drawing settings and number of frames that the control is created for.
        folder: folder of the checkpoint; may hold `control.json`.

    Raises:
        CheckpointError: no such control, its package is missing, or its file is missing or broken.
    """
    try:
        control = create_control(name, options)
    except ConfigError as error:
        raise CheckpointError(f"checkpoint '{folder}': {error}") from error
    file = folder / CONTROL_FILE
    if not file.is_file():
        if control.state():
            raise CheckpointError(
                f"checkpoint '{folder}' has no {CONTROL_FILE}, which control '{name}' needs; "
                'export it again, or train it again if version 0.1.0 wrote it'
            )
        return control
    try:
        found = dict(read_json(file))
        if found['control'] != name:
            raise CheckpointError(
                f"'{file}' is of control '{found['control']}', the model's is '{name}'"
            )
        return control.restored(found['state'])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(
            f"'{file}' cannot be used ({type(error).__name__}: {error}); export the checkpoint "
            'again'
        ) from error
