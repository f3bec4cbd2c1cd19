"""Packages that the extras of this package install."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import metadata
import re

#: name of the distribution of a module, where they differ
_DISTRIBUTIONS = {
    'google': 'mcap-protobuf-support',
    'mcap_protobuf': 'mcap-protobuf-support',
    'rerun': 'rerun-sdk',
}


def extra_of(package: str) -> str:
    """Return the first extra of this package that asks for another one; empty = none does."""
    name = _DISTRIBUTIONS.get(package, package)
    for line in metadata.requires('mtv_world_ros') or ():
        found = re.match(rf'{re.escape(name)}\b(?!-).*extra == .([\w-]+)', line)
        if found and name:
            return found[1]
    return ''


def install_command(packages: Sequence[str]) -> str:
    """Return the command that installs packages: by extras of this one, else by their names."""
    extras = list(dict.fromkeys(filter(None, map(extra_of, packages))))
    if not extras:
        return f'pip install {" ".join(_DISTRIBUTIONS.get(name, name) for name in packages)}'
    return f"pip install 'mtv_world_ros[{','.join(extras)}]'"


def needs_text(what: str, *packages: str, instead: str = '') -> str:
    """Return the text on something whose packages are not installed.

    Args:
        what: thing that needs them.
        packages: names of the modules.
        instead: what to do without them.
    """
    text = f'{what} needs {" and ".join(packages)}: {install_command(packages)}'
    return f'{text}, or {instead}' if instead else text
