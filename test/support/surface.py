"""What a user can set or import, by kind: the live surface that `test/surface.json` lists."""

from __future__ import annotations

import argparse
import ast
from collections.abc import Iterator
from dataclasses import fields
import json
from pathlib import Path
import re

import mtv_world_ros
from mtv_world_ros.cli.commands import COMMANDS
from mtv_world_ros.control.registry import CONTROLS
from mtv_world_ros.core import entry_points
from mtv_world_ros.core.bounded_input import Limits, PREFIX
from mtv_world_ros.policies.kinds import POLICY_KINDS
from mtv_world_ros.success.relations import KINDS
from mtv_world_ros.vision.segmenters.registry import SEGMENTERS
from test.support.launch_stand_in import LaunchStandIn
from test.support.pages import generator

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / 'test' / 'surface.json'
#: variables that are read by name, and names that hold one: `FOLLOW_LINKS = 'MTV_WORLD_...'`
_VARIABLE = re.compile(
    r"""environ(?:\.\w+)?[\[(]['"]([A-Z][A-Z0-9_]+)['"]|['"](MTV_WORLD_[A-Z_]*[A-Z])['"]"""
)


def live() -> dict[str, list[str]]:
    """Return the names of today's surface by kind, sorted.

    Names are written as `evaluate --steps`, `world_model.device`, `replay.launch.py rate`,
    `OptimizerConfig.steps`.
    """
    found = {
        'options': _options(),
        'parameters': _parameters(),
        'arguments': _arguments(),
        'keys': _keys(),
        'names': [*mtv_world_ros._PLACES],
        'registries': _registries(),
        'extras': _extras(),
        'variables': _variables(),
    }
    return {kind: sorted(set(names)) for kind, names in found.items()}


def _options() -> Iterator[str]:
    for command in COMMANDS:
        parser: argparse.ArgumentParser = generator('command_pages').parser_of(command)
        for action in parser._actions:
            if not isinstance(action, argparse._HelpAction):
                yield f'{command} {[*action.option_strings, action.dest][0]}'


def _parameters() -> Iterator[str]:
    for node, settings in generator('parameter_tables').NODES.items():
        yield from (f'{node}.{name}' for name in settings.model_fields)


def _arguments() -> Iterator[str]:
    launch = LaunchStandIn(ROOT / 'launch')
    for path in (ROOT / 'launch').glob('*.launch.py'):
        yield from (f'{path.name} {name}' for name in launch.arguments(path.name))


def _keys() -> Iterator[str]:
    page = generator('configuration_page')
    for file, parts in page.sections():
        for kind in (file.schema, *parts):
            yield from (f'{kind.__name__}.{key}' for key in page.keys(kind))


def _registries() -> Iterator[str]:
    named = {
        'control': CONTROLS,
        'segmenter': SEGMENTERS,
        'policy kind': POLICY_KINDS,
        'relation': KINDS,
        'command': COMMANDS,
    }
    for kind, names in named.items():
        yield from (f'{kind} {name}' for name in names)
    for group in vars(entry_points).values():
        if isinstance(group, str) and group.startswith('mtv_world.'):
            yield f'entry points {group}'


def _extras() -> list[str]:
    """Return the extras of setup.py, which is not run."""
    for node in ast.walk(ast.parse((ROOT / 'setup.py').read_text())):
        if isinstance(node, ast.keyword) and node.arg == 'extras_require':
            assert isinstance(node.value, ast.Dict)
            return [ast.literal_eval(key) for key in node.value.keys if key is not None]
    raise AssertionError('setup.py has no extras_require')


def _variables() -> Iterator[str]:
    yield from (PREFIX + field.name.upper() for field in fields(Limits))
    for folder in ('mtv_world_ros', 'launch'):
        for path in (ROOT / folder).rglob('*.py'):
            for one, other in _VARIABLE.findall(path.read_text()):
                yield one or other


def written() -> dict[str, dict[str, str]]:
    """Return the rows of `test/surface.json` by kind: name -> who sets it."""
    return json.loads(FILE.read_text(encoding='utf-8'))
