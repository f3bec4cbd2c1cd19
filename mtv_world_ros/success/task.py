"""Tasks: which relations between objects an instruction asks for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
import re
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import BeforeValidator, model_validator, PlainValidator

from mtv_world_ros.core.bounded_input import parse_json
from mtv_world_ros.core.config import expected, ListOf, read_yaml, Schema, validated, wrong
from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import ConfigError, UnknownNameError
from mtv_world_ros.success.relations import EXPECTED, KINDS, Length, Lengths3, Relation
from mtv_world_ros.success.situation import grippers_open, grippers_released, Situation
from mtv_world_ros.vision.describers.describer import ends_phrase

GRIPPERS = ('open', 'released', 'any')
#: number of last samples in which a `final` task is done (0.5 s at 10 Hz)
HELD_SAMPLES = 5
#: maximum length of an object's name in an instruction; it bounds the matching time [characters]
_LONGEST_NAME = 64
#: error about a table of scenes, which version 0.1.0 read
SCENES_REPLACED = (
    "scenes are no longer read from a table: a task is one file, 'config/tasks/NAME.yaml' or your "
    "own, and its entry of the table is its key 'scene' (docs/tasks.md)"
)
#: keys of a task's file that files of other kinds do not have
_REQUIRED = {'instruction', 'relations'}
#: words of an instruction that name nothing
_ARTICLES = frozenset({'a', 'an', 'the'})


def _relation(data: Any) -> Relation:
    if isinstance(data, Relation):
        return data
    kind = data.get('kind') if isinstance(data, Mapping) else None
    if kind not in KINDS:
        raise UnknownNameError('kind is', str(kind), sorted(KINDS), listed='; known are')
    return KINDS[kind].model_validate(data)


def _listed(data: Any) -> Any:
    if not isinstance(data, list | tuple) or not data:
        raise wrong('a list of relations', EXPECTED)
    return data


def _by_role(what: str) -> BeforeValidator:
    def checked(data: Any) -> Any:
        if not isinstance(data, Mapping):
            raise wrong(f'{what} by placeholder', EXPECTED)
        return data

    return BeforeValidator(checked)


_Words = Annotated[ListOf[str], expected('a list of words', EXPECTED)]
#: extents (x, y, z) [m]
_Extents = Annotated[Lengths3, expected('3 positive length(s) in metres', EXPECTED, parts=2)]
_Nouns = Annotated[ListOf[str], expected('a list of words', EXPECTED, parts=2)]


class TaskSpec(Schema):
    """Definition of a task: instruction template and relations of objects.

    Attributes:
        name: name of the task, e.g. `stack_blocks_two`.
        instruction: template with placeholders for the objects, `stack the {a} on the {b}`.
        relations: relations between objects; all must hold at the end.
        sizes_m: usual extents (x, y, z) of a placeholder's object, for where they are not known:
            from pictures, an object that is not named here is taken as a cube [m].
        nouns: allowed last words of the object's name, by placeholder; not given = any. Tells
            tasks of one template apart.
        rims: last words of the names of objects that are held by their rim, not across the middle.
        phrasings: further templates with the same placeholders. A task that has some takes
            instructions with and without articles.
        gripper: `open`: every gripper has let go at the end; `released`: every gripper is open,
            or away from the objects that it was to move; `any`: that does not matter.
        views: names of the views to look at; empty = all.
        softness_m: length that counts as one in the margins [m].
        scene: objects on the table and moves of the expert, for the simulator; None = the task can
            be judged, but not simulated. `simulation/scenes/tasks.py` reads it.
    """

    basic: ClassVar = ('name', 'instruction', 'relations')

    name: str
    instruction: str
    relations: Annotated[
        ListOf[Annotated[Relation, PlainValidator(_relation)]], BeforeValidator(_listed)
    ]
    sizes_m: Annotated[dict[str, _Extents], _by_role('lengths')] = {}
    nouns: Annotated[dict[str, _Nouns], _by_role('words')] = {}
    rims: _Words = ()
    phrasings: _Words = ()
    gripper: str = 'open'
    views: _Words = ()
    softness_m: Length = 0.01
    scene: dict[str, Any] | None = None

    @model_validator(mode='after')
    def _is_about_the_instruction(self) -> Self:
        for role in (*self.roles, *self.nouns, *self.sizes_m):
            for template in self.templates:
                if f'{{{role}}}' not in template:
                    raise ValueError(
                        f"the relations, nouns or sizes are about '{role}', which the instruction "
                        f"'{template}' does not hold as {{{role}}}"
                    )
        if self.gripper not in GRIPPERS:
            raise ValueError(
                f"gripper is '{self.gripper}'; it must be one of {', '.join(GRIPPERS)}"
            )
        return self

    @property
    def roles(self) -> tuple[str, ...]:
        """Placeholders that the relations are about."""
        found = [role for relation in self.relations for role in relation.roles]
        return tuple(dict.fromkeys(found))

    @property
    def templates(self) -> tuple[str, ...]:
        """Templates of instructions: `instruction`, then `phrasings`."""
        return (self.instruction, *self.phrasings)

    @property
    def movers(self) -> tuple[str, ...]:
        """Placeholders of the objects that the robot is to move."""
        return tuple(dict.fromkeys(relation.subject for relation in self.relations))

    def holds(self, at: Situation, openings: FloatArray) -> BoolArray:
        """Return (T,) whether the task is done at each sample.

        Args:
            at: object poses and gripper openings over time.
            openings: (A, T) openings of the grippers, 0 closed to 1 open.

        Raises:
            CannotTell: the situation does not know what a relation asks for.
        """
        held = [
            margin.values > 0
            for relation in self.relations
            for margin in relation.margins(at)
            if margin.is_required
        ]
        if self.gripper == 'open':
            held.append(grippers_open(openings))
        elif self.gripper == 'released':
            centres = np.stack([at.centres(role) for role in self.movers])
            held.append(grippers_released(openings, at.tools, centres))
        return np.all(held, axis=0)

    def bind(self, instruction: str, *, with_articles: bool = True) -> dict[str, str] | None:
        """Return the placeholders' objects if the instruction fits a template, else None.

        Args:
            instruction: text for the robot.
            with_articles: articles have to be as in the template; those of a task with
                `phrasings` never have to.
        """
        said = ' '.join(instruction.lower().split()).rstrip('.! ')
        templates = [template.lower() for template in self.templates]
        if self.phrasings or not with_articles:
            said, templates = _bare(said), [_bare(template) for template in templates]
        found = (self._bound(said, template) for template in templates)
        return next((bound for bound in found if bound is not None), None)

    def _bound(self, said: str, template: str) -> dict[str, str] | None:
        """Return the placeholders' objects if words in lower case fit a template, else None."""
        name = rf'(?P<\1>[\\w -]{{1,{_LONGEST_NAME}}}?)'
        pattern = re.sub(r'\\\{(\w+)\\\}', name, re.escape(template))
        found = re.fullmatch(pattern, said)
        if found is None:
            return None
        bound = found.groupdict()
        if any(ends_phrase(word) for name in bound.values() for word in name.split()):
            return None  # one placeholder took two objects
        fits = all(bound[role].split()[-1] in nouns for role, nouns in self.nouns.items())
        return bound if fits else None


def _bare(text: str) -> str:
    """Return a text without articles."""
    return ' '.join(word for word in text.split() if word not in _ARTICLES)


def object_called(name: str, names: Sequence[str]) -> str | None:
    """Return the object that a name refers to; None = no object, or more than one.

    Args:
        name: name as an instruction says it, e.g. `towel`.
        names: names of the objects, e.g. `green towel`.
    """
    if name in names:
        return name
    words = set(_bare(name.lower()).split())
    fits = [known for known in names if words <= set(known.lower().split())]
    return fits[0] if len(fits) == 1 and words else None


def match_task(
    tasks: Iterable[TaskSpec], instruction: str
) -> tuple[TaskSpec, dict[str, str]] | None:
    """Return the task whose template the instruction fits, and its objects.

    Where several fit, the one that says most about its objects' nouns, then the first. Where none
    fits, articles of instruction and templates do not count.
    """
    known = list(tasks)
    for with_articles in (True, False):
        bound = [(task, task.bind(instruction, with_articles=with_articles)) for task in known]
        found = [(task, objects) for task, objects in bound if objects is not None]
        if found:
            return max(found, key=lambda pair: len(pair[0].nouns))
    return None


def ever_and_final(success: BoolArray, held: int = HELD_SAMPLES) -> tuple[bool, bool]:
    """Return whether (T,) `success` held at any sample, and in each of the last `held`."""
    return bool(success.any()), bool(len(success) >= held and success[-held:].all())


def load_task(path: Path) -> TaskSpec:
    """Read one task.

    Raises:
        ConfigError: the file is no YAML mapping, a key is unknown or missing, a value is wrong.
    """
    values = read_yaml(path, 'task file', 'task')
    if isinstance(values, Mapping) and _is_table_of_scenes(values):
        raise ConfigError(f'{path}: {SCENES_REPLACED}')
    if isinstance(values, Mapping) and not _REQUIRED & set(values):
        keys = ', '.join(map(str, list(values)[:5])) or 'none'
        raise ConfigError(
            f"'{path}' is no task: its keys are {keys}; the file of a task has name, instruction "
            'and relations (docs/tasks.md)'
        )
    return validated(TaskSpec, values, str(path))


def dump_task(task: TaskSpec) -> dict[str, Any]:
    """Return a task's definition in plain values, as its file has it; inverse of `stored_task`."""
    return task.model_dump(mode='json', exclude_unset=True, serialize_as_any=True)


def stored_task(values: Any, where: str) -> TaskSpec:
    """Return the task of a stored definition.

    Args:
        values: plain values of `dump_task`, or their JSON text.
        where: place of the definition, for error texts.

    Raises:
        ConfigError: the definition cannot be used.
    """
    if isinstance(values, str):
        try:
            values = parse_json(values, where)
        except ValueError as error:
            raise ConfigError(f'{where} cannot be used: {error}') from error
    return validated(TaskSpec, values, where)


def _is_table_of_scenes(values: Mapping[str, Any]) -> bool:
    return bool(values) and all(
        isinstance(scene, Mapping) and {'roles', 'moves'} <= set(scene)
        for scene in values.values()
    )


def load_tasks(folder: Path) -> tuple[TaskSpec, ...]:
    """Read every `*.yaml` of a folder, in the order of names.

    Raises:
        ConfigError: a file is wrong, or two tasks share a name.
    """
    tasks = tuple(load_task(path) for path in sorted(Path(folder).glob('*.yaml')))
    names = [task.name for task in tasks]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigError(f'{folder}: more than one file holds task {twice}')
    return tasks
