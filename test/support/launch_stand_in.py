"""Stand-ins of `launch` and `launch_ros`, which have no wheels: launch files run, nodes do not."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import contextmanager
from pathlib import Path
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

#: names that launch files import, by module
MODULES = {
    'launch': ('LaunchDescription',),
    'launch.actions': (
        'DeclareLaunchArgument',
        'IncludeLaunchDescription',
        'OpaqueFunction',
        'SetEnvironmentVariable',
        'Shutdown',
    ),
    'launch.conditions': ('IfCondition',),
    'launch.launch_description_sources': ('PythonLaunchDescriptionSource',),
    'launch.substitutions': ('LaunchConfiguration', 'PathJoinSubstitution'),
    'launch_ros': (),
    'launch_ros.actions': ('Node',),
    'launch_ros.parameter_descriptions': ('ParameterValue',),
    'launch_ros.substitutions': ('FindPackageShare',),
}


class Made(SimpleNamespace):
    """An object that a launch file made: its class's name, positional and keyword arguments."""

    kind: str
    words: tuple[Any, ...]
    fields: dict[str, Any]

    def perform(self, context: Mapping[str, str]) -> str:
        """Return the text of a substitution, as `launch` does."""
        return _text(self, context)


class LaunchStandIn:
    """Runs launch files of a folder.

    Args:
        folder: holds the files.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def nodes(self, name: str, given: Mapping[str, str]) -> list[dict[str, Any]]:
        """Return executable and parameters of the nodes that a file starts.

        Raises:
            AssertionError: an argument that is given or used is not declared.
        """
        with _modules():
            _, made = self._description(name)
            declared = _declared(made)
            assert {*given} <= {*declared}, f'{name} has no {sorted({*given} - {*declared})}'
            context: dict[str, str] = {}
            for argument, fields in declared.items():
                default = _text(fields['default_value'], context)
                context[argument] = given.get(argument, default)
            return self._started(made, context)

    def arguments(self, name: str) -> list[str]:
        """Return the arguments that a file takes; those that it refuses are left out."""
        with _modules():
            variables, made = self._description(name)
        return [one for one in _declared(made) if one not in variables.get('REPLACED', ())]

    def _description(self, name: str) -> tuple[dict[str, Any], list[Made]]:
        """Return the variables of a file and what it describes."""
        variables: dict[str, Any] = {}
        exec((self._folder / name).read_text(), variables)  # our own file
        return variables, variables['generate_launch_description']().words[0]

    def _started(self, made: list[Made], context: Mapping[str, str]) -> list[dict[str, Any]]:
        found = []
        for one in made:
            if one.kind == 'OpaqueFunction':
                found += self._started(one.fields['function'](context), context)
            elif one.kind == 'IncludeLaunchDescription':
                path = _text(one.words[0].words[0], context)
                arguments = dict(one.fields['launch_arguments'])
                given = {key: _text(value, context) for key, value in arguments.items()}
                found += self.nodes(Path(path).name, given)
            elif one.kind == 'Node':
                found.append(_node(one, context))
        return found


def _declared(made: list[Made]) -> dict[str, dict[str, Any]]:
    return {one.words[0]: one.fields for one in made if one.kind == 'DeclareLaunchArgument'}


def _node(made: Made, context: Mapping[str, str]) -> dict[str, Any]:
    """Executable and parameters of a node; those of a file are left out."""
    parameters = {
        key: _value(value, context)
        for group in made.fields.get('parameters', [])
        if isinstance(group, dict)
        for key, value in group.items()
    }
    for word in made.fields.get('arguments', []):
        _text(word, context)
    return {'executable': made.fields['executable'], 'parameters': parameters}


def _value(value: Any, context: Mapping[str, str]) -> Any:
    """A parameter, of the type that it is declared with."""
    if not isinstance(value, Made):
        return value
    text, kind = _text(value.words[0], context), value.fields['value_type']
    return text == 'true' if kind is bool else kind(text)


def _text(value: Any, context: Mapping[str, str]) -> str:
    """A substitution's text; KeyError = an argument that is not declared."""
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        return '/'.join(_text(part, context) for part in value)
    if value.kind == 'LaunchConfiguration':
        return context[value.words[0]]
    return _text(value.words[0], context)


def _maker(kind: str) -> Any:
    def make(*words: Any, **fields: Any) -> Made:
        return Made(kind=kind, words=words, fields=fields)

    return make


@contextmanager
def _modules() -> Any:
    """Put the stand-ins in place of the modules."""
    before = {name: sys.modules.get(name) for name in MODULES}
    try:
        for name, kinds in MODULES.items():
            module = ModuleType(name)
            for kind in kinds:
                setattr(module, kind, _maker(kind))
            sys.modules[name] = module
        yield
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module
