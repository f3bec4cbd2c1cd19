"""Writes the reference of configuration files: `python docs/configuration_page.py`.

Keys, types, defaults, ranges and meanings are those of the schemas that read the files.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, MISSING
from importlib import import_module
import inspect
from pathlib import Path
import re
from types import NoneType, UnionType
from typing import Annotated, Any, get_args, get_origin, get_type_hints, Literal, NamedTuple, Union

from pydantic.fields import FieldInfo
import yaml

from mtv_world_ros.cameras.calibration_file import CalibratedView
from mtv_world_ros.core.config import read_yaml, Schema
from mtv_world_ros.core.files import bundled_names, share_path
from mtv_world_ros.data.bag_mapping import BagMapping
from mtv_world_ros.importing.mapping import DatasetMapping
from mtv_world_ros.importing.object_boxes import ObjectBoxes
from mtv_world_ros.importing.videos import VideoMapping
from mtv_world_ros.inspection.foreseen_scene import SceneFile
from mtv_world_ros.physics.contact_settings import ContactSettings
from mtv_world_ros.policies.kinds import POLICY_KINDS
from mtv_world_ros.ranking.policy_list import PolicyList
from mtv_world_ros.robot.file import RobotFile
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.simulation.physics import Physics
from mtv_world_ros.simulation.scenes.tasks import SceneSpec
from mtv_world_ros.simulation.scenes.workcell import WorkcellFile
from mtv_world_ros.success.task import TaskSpec
from mtv_world_ros.training.training_config import TrainingConfig
from mtv_world_ros.vision.describers.describer_config import DescriberConfig

PAGE = Path(__file__).parent / 'configuration.md'


class ConfigFile(NamedTuple):
    """A kind of file on the page.

    Attributes:
        heading: what the file is.
        given: where a user names it, in Markdown.
        schema: schema of its top level.
        guide: page that explains it, with an anchor.
        example: bundled file, relative to `config/`; empty = none.
    """

    heading: str
    given: str
    schema: type[Schema]
    guide: str
    example: str = ''

    def introduction(self) -> str:
        """Return the paragraph before the table."""
        page = self.guide.partition('.')[0]
        text = f'{self.given} Guide: [{page.replace("_", " ").capitalize()}]({self.guide}).'
        path = f'config/{self.example}'
        return f'{text} Example: [`{path}`](../{path}).' if self.example else text


def _policy_files() -> Iterator[ConfigFile]:
    """Return the kinds of policy files of the registry, each with its first bundled example."""
    examples: dict[str, str] = {}
    for name in bundled_names('policies'):
        path = share_path('config', 'policies', f'{name}.yaml')
        kind = read_yaml(path, 'policy file', 'policy')['kind']
        if name == kind:
            examples[kind] = f'policies/{name}.yaml'
    for kind, target in POLICY_KINDS.items():
        module, _, schema = target.partition(':')
        yield ConfigFile(
            f'Policy: {kind}',
            '`--policy FILE`.',
            getattr(import_module(module), schema),
            'policies.md#which-policy',
            examples.get(kind, ''),
        )


FILES = (
    ConfigFile(
        'Robot',
        "`--robot FILE`, `video.robot` of a preset, the node's `robot_file`.",
        RobotFile,
        'robots.md',
        'robots/yam_bimanual/robot.yaml',
    ),
    ConfigFile(
        'Cameras',
        'A mapping a view under `views`: `calibration.yaml` of an episode, `--calibration FILE`, '
        "the node's `calibration_file`.",
        CalibratedView,
        'cameras.md',
        'robots/yam_bimanual/cameras.yaml',
    ),
    ConfigFile(
        'Workcell',
        "`workcell.yaml` in a robot's folder, for the simulator. Positions are in the base link: "
        'x to the right, y away from the robot, z up from the table.',
        WorkcellFile,
        'simulator.md',
        'robots/franka/workcell.yaml',
    ),
    ConfigFile(
        'Task',
        "`--task FILE`, the node's `task`. The guide has the keys of every relation.",
        TaskSpec,
        'tasks.md',
        'tasks/stack_blocks_two.yaml',
    ),
    ConfigFile(
        'Scene of a task',
        'The key `scene` of a task, for the simulator.',
        SceneSpec,
        'tasks.md',
        'tasks/stack_blocks_two.yaml',
    ),
    ConfigFile(
        'Training preset',
        '`mtv-world train --preset FILE`; `--set SECTION.KEY=VALUE` changes a value.',
        TrainingConfig,
        'training.md',
        'models/small.yaml',
    ),
    ConfigFile(
        'Bags',
        '`--topics FILE` of `import bag` and of all commands that read bags.',
        BagMapping,
        'importing.md',
        'datasets/bag.yaml',
    ),
    ConfigFile(
        'LeRobot data sets',
        '`mtv-world import lerobot --mapping FILE`.',
        DatasetMapping,
        'importing.md',
        'datasets/example.yaml',
    ),
    ConfigFile(
        'Videos and tables',
        '`mtv-world import videos --mapping FILE`.',
        VideoMapping,
        'importing.md',
        'datasets/videos.yaml',
    ),
    ConfigFile(
        'Boxes around objects',
        '`--objects FILE` of the imports.',
        ObjectBoxes,
        'objects.md#boxes-drawn-once',
    ),
    ConfigFile(
        'Describer',
        "`--describer FILE`, the node's `describer`.",
        DescriberConfig,
        'objects.md',
        'describer.yaml',
    ),
    *_policy_files(),
    ConfigFile(
        'List of policies',
        '`mtv-world rank --policies FILE`.',
        PolicyList,
        'ranking.md',
        'rankings/example.yaml',
    ),
    ConfigFile(
        'Scene and plan',
        '`mtv-world foresee FILE`.',
        SceneFile,
        'foresight.md#without-a-picture',
    ),
    ConfigFile(
        'Numbers of contact',
        '`contact.json` in the folder `object_motion/` of a checkpoint, which `mtv-world fit '
        'contact` writes.',
        ContactSettings,
        'foresight.md#numbers-of-contact',
    ),
    ConfigFile(
        'Physics of the simulator',
        'An entry of the file: `--physics NAME` of `rank` and `collect`.',
        Physics,
        'ranking.md',
        'physics.yaml',
    ),
)
_HEAD = """\
# Configuration files

Keys of all YAML files that a user writes, in two tiers: the [basic](#basic) keys are those that
most users set, and the [advanced](#advanced) part has all keys. An unknown key is an error that
names the nearest known one. Numbers have the units that stand in brackets. This page is written by
`python docs/configuration_page.py`; the node's parameters are on [a page of their
own](parameters.md).

## Basic

| file | key | value | default | |
|---|---|---|---|---|
"""
_ATTRIBUTE = re.compile(r'^ {4}(\w+): (.*(?:\n {8}.*)*)', re.M)
#: spelling of names in headings
_NAMES = {'Dh': 'DH', 'Lora': 'LoRA', 'Lerobot': 'LeRobot'}
_PLAIN = {
    str: 'text',
    int: 'whole number',
    float: 'number',
    bool: 'true or false',
    Path: 'file',
    Any: 'any value',
}


def page() -> str:
    """Return the text of the page: a table of keys for each file and each of its sections."""
    lines = [_HEAD + '\n'.join(_basic_rows()), '', '## Advanced', '', 'All keys of all files.', '']
    for file, parts in sections():
        lines += [f'### {file.heading}', '', file.introduction(), '', *_table(file.schema), '']
        for part in parts:
            lines += [f'#### {_title(part)}', '', _first_line(part), '', *_table(part), '']
    return '\n'.join(lines)


def sections() -> Iterator[tuple[ConfigFile, list[type]]]:
    """Yield the kinds of files, each with the sections that no earlier kind has."""
    shown: set[type] = set()
    for file in FILES:
        shown.add(file.schema)
        parts: list[type] = []
        waiting = _parts(file.schema)
        while waiting:
            part = waiting.pop(0)
            if part not in shown:
                shown.add(part)
                parts.append(part)
                waiting += _parts(part)
        yield file, parts


def keys(kind: type) -> dict[str, FieldInfo]:
    """Return the keys of a schema or dataclass by the names that a file writes."""
    return {field.alias or name: field for name, field in _fields(kind).items()}


def _anchor(heading: str) -> str:
    return re.sub(r'[^\w -]', '', heading.lower()).replace(' ', '-')


def _title(kind: type) -> str:
    """Return the heading of a section, e.g. `OptimizerConfig` -> `Optimizer`."""
    name = re.sub(r'(Config|Settings|Entry|Spec)$', '', kind.__name__).replace(
        'LeRobot', 'Lerobot'
    )
    first, *rest = re.findall(r'[A-Z]+(?![a-z])|[A-Z][a-z0-9]*', name)
    words = [first, *(word if word.isupper() else word.lower() for word in rest)]
    return ' '.join(_NAMES.get(word) or word for word in words)


def _first_line(kind: type) -> str:
    return (inspect.getdoc(kind) or '').split('\n\n')[0].replace('\n', ' ')


def _basic_rows() -> Iterator[str]:
    for file, parts in sections():
        for kind in (file.schema, *parts):
            link = f'[{file.heading}](#{_anchor(file.heading)})'
            if kind is not file.schema:
                link += f': [{_title(kind)}](#{_anchor(_title(kind))})'
            rows = dict(zip(keys(kind), _rows(kind), strict=True))
            yield from (f'| {link} {rows[key]}' for key in getattr(kind, 'basic', ()))


def _table(kind: type) -> Iterator[str]:
    yield '| key | value | default | |'
    yield '|---|---|---|---|'
    yield from _rows(kind)


def _rows(kind: type) -> Iterator[str]:
    meanings = _attributes(kind)
    for name, field in _fields(kind).items():
        meaning = ' '.join((field.description or meanings.get(name, '')).split())
        if not meaning and len(get_args(field.annotation)) == 1:
            meaning = 'selects this kind'
        cells = (f'`{field.alias or name}`', _value(field), _default(field), meaning)
        yield '| ' + ' | '.join(cell.replace('|', r'\|') for cell in cells) + ' |'


def _fields(kind: type) -> Mapping[str, FieldInfo]:
    """Return the keys of a schema, or of a dataclass that a schema holds."""
    if issubclass(kind, Schema):
        return kind.model_fields
    hints = get_type_hints(kind, include_extras=True)
    return {
        one.name: FieldInfo.from_annotation(hints[one.name])
        if one.default is MISSING and one.default_factory is MISSING
        else FieldInfo.from_annotated_attribute(hints[one.name], one.default)
        for one in fields(kind)
    }


def _is_part(kind: Any) -> bool:
    return inspect.isclass(kind) and (issubclass(kind, Schema) or is_dataclass(kind))


def _attributes(kind: type) -> dict[str, str]:
    """Return the meanings of attributes in the docstrings of a class and its bases."""
    found: dict[str, str] = {}
    for base in kind.__mro__:
        for name, text in _ATTRIBUTE.findall(inspect.cleandoc(base.__doc__ or '')):
            found.setdefault(name, text.rstrip('.'))
    return found


def _value(field: FieldInfo) -> str:
    """Return type and range in words."""
    limits = {
        key: f'{getattr(item, key):.10g}'
        for item in field.metadata
        for key in ('ge', 'gt', 'le', 'lt')
        if hasattr(item, key)
    }
    low, high = limits.get('ge', limits.get('gt')), limits.get('le', limits.get('lt'))
    return ', '.join(
        filter(
            None,
            (
                _type(field.annotation),
                f'{low} … {high}' if low is not None and high is not None else '',
                f'from {low} on' if low is not None and high is None else '',
            ),
        )
    )


def _type(kind: Any) -> str:
    """Return a type in words."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _type(arguments[0])
    if origin is Literal:
        return ', '.join(f'`{choice}`' for choice in arguments)
    if origin in (Union, UnionType):
        texts = [_type(one) for one in arguments if one is not NoneType]
        return ' or '.join(dict.fromkeys([*texts, *(['null'] if NoneType in arguments else [])]))
    if origin in (tuple, list, Sequence):
        return f'list of {_plural(_type(arguments[0]))}' if arguments else 'list'
    if origin in (dict, Mapping):
        return f'name -> {_type(arguments[1])}'
    if kind is RobotModel:
        return _PLAIN[Path]
    if kind is not RobotModel and _is_part(kind):
        return f'[{_title(kind)}](#{_anchor(_title(kind))})'
    return _PLAIN.get(kind, 'see the guide')


def _plural(text: str) -> str:
    return f'{text}s' if text in _PLAIN.values() and text != 'true or false' else text


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return 'required'
    default = field.get_default(call_default_factory=True)
    if isinstance(default, Schema):
        return 'its defaults'
    if default in ('', (), {}):
        return 'empty'
    value = list(default) if isinstance(default, tuple) else default
    return f'`{yaml.safe_dump(value, default_flow_style=True).splitlines()[0]}`'


def _parts(kind: type) -> list[type]:
    """Return the schemas that the fields of a schema hold, in their order."""
    found: list[type] = []

    def visit(one: Any) -> None:
        if one is not RobotModel and _is_part(one):
            found.append(one)
        for part in get_args(one):
            visit(part)

    for field in _fields(kind).values():
        visit(field.annotation)
    return list(dict.fromkeys(found))


if __name__ == '__main__':
    PAGE.write_text(page(), encoding='utf-8')
