"""Entry points of upper floors and other packages: commands, policy kinds, rollout readers."""

from __future__ import annotations

from importlib import metadata
from typing import Any

from mtv_world_ros.core.errors import ConfigError

#: groups of entry points; each names a module, see docs/architecture.md
COMMANDS = 'mtv_world.commands'
POLICIES = 'mtv_world.policies'
ROLLOUTS = 'mtv_world.rollouts'
#: group of controls: each entry point names a class, see `control/control.py`
CONTROLS = 'mtv_world.controls'
#: group of segmenters: each entry point names a class, see `vision/segmenters/registry.py`
SEGMENTERS = 'mtv_world.segmenters'
#: group of describers: each entry point names a class without arguments
DESCRIBERS = 'mtv_world.describers'


def registered(group: str) -> dict[str, metadata.EntryPoint]:
    """Return the entry points of a group by name; nothing is imported."""
    return {entry.name: entry for entry in metadata.entry_points(group=group)}


def load(entry: metadata.EntryPoint) -> Any:
    """Return the object that an entry point names.

    Raises:
        ConfigError: the module cannot be imported.
    """
    try:
        return entry.load()
    except Exception as error:  # a third-party module may raise anything
        raise broken(entry, error) from error


def broken(entry: metadata.EntryPoint, error: Exception) -> ConfigError:
    """Return the error of an entry point that cannot be used."""
    return ConfigError(
        f"entry point '{entry.name} = {entry.value}' of the group '{entry.group}' cannot be "
        f'loaded ({error or type(error).__name__}); install the package that registers it again, '
        'or remove it'
    )


def policy_kind(name: str) -> Any:
    """Return the module of a registered kind of policies.

    Raises:
        ConfigError: no installed package registers it.
    """
    known = registered(POLICIES)
    if name not in known:
        raise ConfigError(
            f"no installed package has policies of the kind '{name}' (entry point "
            f"'{POLICIES}'); install mtv_world_ros with its simulator: "
            "pip install 'mtv_world_ros[sim]'"
        )
    return load(known[name])
