"""Packages of extras that a command needs, checked before any work."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import metadata
from importlib.util import find_spec
import re

from mtv_world_ros.core.errors import ConfigError

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
#: name of the distribution of a module, where they differ
_DISTRIBUTIONS = {'rerun': 'rerun-sdk'}


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
    """Return the line on packages that are not installed, and what installs them."""
    extras = dict.fromkeys(filter(None, map(extra_of, packages)))
    are = 'is' if len(packages) == 1 else 'are'
    return (
        f'{", ".join(packages)} {are} not installed: make in the folder of mtv_world_ros '
        f"(make dev has every extra), or pip install 'mtv_world_ros[{','.join(extras)}]'"
    )


def extra_of(package: str) -> str:
    """Return the first extra of this package that asks for another one; empty = none does."""
    name = _DISTRIBUTIONS.get(package, package)
    for line in metadata.requires('mtv_world_ros') or ():
        found = re.match(rf'{re.escape(name)}\b(?!-).*extra == .([\w-]+)', line)
        if found and name:
            return found[1]
    return ''


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):
        return False
