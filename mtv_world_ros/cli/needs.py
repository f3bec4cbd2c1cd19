"""Packages of extras that a command needs, checked before any work."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib.util import find_spec

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.extras import install_command

#: packages that each command always needs
_ALWAYS = {
    'train': ('tensorboard',),
    'rank': ('matplotlib',),
    'fit success': ('matplotlib',),
    'export report': ('matplotlib',),
    'view': ('rerun',),
    'import lerobot': ('pyarrow',),
    'export lerobot': ('pyarrow',),
}
#: (command, option) -> packages that its value needs; an empty command = all
_WITH_OPTION = {
    ('evaluate', 'report'): ('matplotlib',),
    ('evaluate', 'quality'): ('torchmetrics',),
    ('rank', 'ray'): ('ray',),
    ('', 'watch'): ('rerun',),
}


def check_needs(words: Sequence[str], arguments: argparse.Namespace) -> None:
    """Refuse a command whose packages are not all installed; none is imported.

    Args:
        words: words of the command line.
        arguments: options as they were read.

    Raises:
        ConfigError: names all packages that are missing, and what installs them.
    """
    command = ' '.join(words[:2]) if ' '.join(words[:2]) in _ALWAYS else words[0]
    needed = list(_ALWAYS.get(command, ()))
    for (of, option), packages in _WITH_OPTION.items():
        if of in ('', command) and getattr(arguments, option, None):
            needed += packages
    missing = [name for name in dict.fromkeys(needed) if not _is_installed(name)]
    if missing:
        raise ConfigError(missing_text(missing))


def missing_text(packages: Sequence[str]) -> str:
    """Return the line on missing packages, with the command that installs them."""
    are = 'is' if len(packages) == 1 else 'are'
    return (
        f'{", ".join(packages)} {are} not installed: make in the folder of mtv_world_ros '
        f'(make dev has every extra), or {install_command(packages)}'
    )


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):
        return False
