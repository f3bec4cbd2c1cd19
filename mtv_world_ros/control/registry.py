"""Controls by name: those of the package, of entry points, and of `module:Class`."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
import json
from pathlib import Path
import sys
from typing import Any

from mtv_world_ros.control.control import Control, ControlOptions
from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.entry_points import CONTROLS as GROUP
from mtv_world_ros.core.entry_points import registered
from mtv_world_ros.core.errors import CheckpointError, ConfigError, MtvWorldError, nearest

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
#: packages that a control imports, and the extra that installs them
_EXTRAS = {'tokenizers': 'fast_tokens'}


def control_names() -> list[str]:
    """Return the names that are registered: the package's, then those of entry points."""
    return [*CONTROLS, *sorted(set(registered(GROUP)) - set(CONTROLS))]


def check_control_name(name: str) -> str:
    """Return a name that is registered, or of the form `module:Class`.

    Raises:
        ConfigError: it is neither.
    """
    if ':' not in name and name not in control_names():
        known = control_names()
        raise ConfigError(
            f"control '{name}' is not registered{nearest(name, known)}; registered are "
            f'{", ".join(known)}. Set video.control to one of them, to the name of an entry '
            f"point of the group '{GROUP}', or to module:Class"
        )
    return name


def control_class(name: str) -> type[Control]:
    """Return the class of a control.

    Args:
        name: registered, or `module:Class`.

    Raises:
        ConfigError: no such control, or it cannot be imported.
    """
    check_control_name(name)
    if ':' in name:
        target = name
    elif name in CONTROLS:
        target = CONTROLS[name]
    else:
        target = registered(GROUP)[name].value
    module, _, attribute = target.partition(':')
    try:
        found: Any = import_module(module)
        for part in attribute.split('.'):
            found = getattr(found, part)
    except Exception as error:  # a third-party module may raise anything
        raise ConfigError(
            f"control '{name}' cannot be imported: {error or type(error).__name__}{_remedy(error)}"
        ) from error
    missing = [part for part in ('create', 'make', 'layout') if not hasattr(found, part)]
    if missing:
        raise ConfigError(
            f"control '{name}': '{target}' lacks {', '.join(missing)}; see "
            'mtv_world_ros.control.control.Control for what a control has'
        )
    return found


def _remedy(error: Exception) -> str:
    package = getattr(error, 'name', None) if isinstance(error, ModuleNotFoundError) else None
    if package in _EXTRAS:
        return f"; install it with: pip install 'mtv_world_ros[{_EXTRAS[package]}]'"
    if package is not None and find_spec(package.partition('.')[0]) is None:
        return (
            f"; install the package that has '{package}', or add its folder to PYTHONPATH (now "
            f'{len(sys.path)} folders)'
        )
    return ''


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
    """Write what a control was fitted to into a folder; nothing if it has no state."""
    state = control.state()
    if state:
        text = json.dumps({'control': name, 'state': state}, ensure_ascii=False, indent=1)
        (folder / CONTROL_FILE).write_text(text + '\n', encoding='utf-8')


def load_control(name: str, options: ControlOptions, folder: Path) -> Control:
    """Return the control of a checkpoint, or of a training that is resumed.

    Args:
        name: of the control.
        options: what it is created for.
        folder: may hold `control.json`.

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
