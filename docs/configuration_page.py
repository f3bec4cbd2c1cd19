"""Writes the reference of configuration files: `python docs/configuration_page.py`.

Keys, types, defaults, ranges and meanings are those of the schemas that read the files.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import inspect
from pathlib import Path
import re
from types import NoneType, UnionType
from typing import Annotated, Any, get_args, get_origin, Literal, NamedTuple, Union

from pydantic.fields import FieldInfo
import yaml

from mtv_world_ros.cameras.calibration_file import CalibratedView
from mtv_world_ros.core.config import Schema
from mtv_world_ros.data.bag_mapping import BagMapping
from mtv_world_ros.importing.mapping import DatasetMapping
from mtv_world_ros.importing.object_boxes import ObjectBoxes
from mtv_world_ros.importing.videos import VideoMapping
from mtv_world_ros.inspection.foreseen_scene import SceneFile
from mtv_world_ros.physics.contact_settings import ContactSettings
from mtv_world_ros.policies.lerobot_client import LeRobotConfig
from mtv_world_ros.policies.openpi_client import OpenPiConfig
from mtv_world_ros.policies.python_policy import PythonPolicyConfig
from mtv_world_ros.policies.scripted_settings import ScriptedPolicySettings
from mtv_world_ros.ranking.policy_list import PolicyList
from mtv_world_ros.robot.file import RobotFile
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.rollout.recorded_policy import RecordedPolicySettings
from mtv_world_ros.simulation.physics import Physics
from mtv_world_ros.simulation.scenes.tasks import SceneSpec
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
    ConfigFile(
        'Policy: scripted',
        '`--policy FILE`.',
        ScriptedPolicySettings,
        'policies.md',
        'policies/scripted.yaml',
    ),
    ConfigFile(
        'Policy: recorded',
        '`--policy FILE`.',
        RecordedPolicySettings,
        'policies.md',
        'policies/recorded.yaml',
    ),
    ConfigFile(
        'Policy: python',
        '`--policy FILE`: a class of your own.',
        PythonPolicyConfig,
        'policies.md#which-policy',
    ),
    ConfigFile(
        'Policy: openpi', '`--policy FILE`.', OpenPiConfig, 'policies.md', 'policies/openpi.yaml'
    ),
    ConfigFile(
        'Policy: lerobot',
        '`--policy FILE`.',
        LeRobotConfig,
        'policies.md',
        'policies/lerobot.yaml',
    ),
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

Keys of all YAML files that a user writes. An unknown key is an error that names the nearest known
one. Numbers have the units that stand in brackets. This page is written by
`python docs/configuration_page.py`; the node's parameters are on [a page of their
own](parameters.md).
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
    lines = [_HEAD]
    shown: set[type[Schema]] = set()
    for file in FILES:
        lines += [f'## {file.heading}', '', file.introduction(), '', *_table(file.schema), '']
        shown.add(file.schema)
        waiting = _parts(file.schema)
        while waiting:
            part = waiting.pop(0)
            if part not in shown:
                shown.add(part)
                lines += [f'### {_title(part)}', '', _first_line(part), '', *_table(part), '']
                waiting += _parts(part)
    return '\n'.join(lines)


def _title(kind: type[Schema]) -> str:
    """Return the heading of a section, e.g. `OptimizerConfig` -> `Optimizer`."""
    name = re.sub(r'(Config|Settings|Entry)$', '', kind.__name__).replace('LeRobot', 'Lerobot')
    first, *rest = re.findall(r'[A-Z]+(?![a-z])|[A-Z][a-z0-9]*', name)
    words = [first, *(word if word.isupper() else word.lower() for word in rest)]
    return ' '.join(_NAMES.get(word) or word for word in words)


def _first_line(kind: type[Schema]) -> str:
    return (inspect.getdoc(kind) or '').split('\n\n')[0].replace('\n', ' ')


def _table(kind: type[Schema]) -> Iterator[str]:
    meanings = _attributes(kind)
    yield '| key | value | default | |'
    yield '|---|---|---|---|'
    for name, field in kind.model_fields.items():
        meaning = ' '.join((field.description or meanings.get(name, '')).split())
        if not meaning and len(get_args(field.annotation)) == 1:
            meaning = 'selects this kind'
        cells = (f'`{field.alias or name}`', _value(field), _default(field), meaning)
        yield '| ' + ' | '.join(cell.replace('|', r'\|') for cell in cells) + ' |'


def _attributes(kind: type[Schema]) -> dict[str, str]:
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
    if inspect.isclass(kind) and issubclass(kind, Schema):
        return f'[{_title(kind)}](#{_title(kind).lower().replace(" ", "-")})'
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


def _parts(kind: type[Schema]) -> list[type[Schema]]:
    """Return the schemas that the fields of a schema hold, in their order."""
    found: list[type[Schema]] = []

    def visit(one: Any) -> None:
        if inspect.isclass(one) and issubclass(one, Schema):
            found.append(one)
        for part in get_args(one):
            visit(part)

    for field in kind.model_fields.values():
        visit(field.annotation)
    return list(dict.fromkeys(found))


if __name__ == '__main__':
    PAGE.write_text(page(), encoding='utf-8')
