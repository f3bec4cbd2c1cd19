"""Tasks: which relations between objects an instruction asks for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, MISSING
from pathlib import Path
import re
from typing import Any

import numpy as np

from mtv_world_ros.config import check_keys, number, read_yaml
from mtv_world_ros.data_types import BoolArray, FloatArray
from mtv_world_ros.errors import ConfigError, nearest
from mtv_world_ros.success.goal_pictures import load_pictures, load_regions, Picture
from mtv_world_ros.success.relations import KINDS, Relation, roles_of
from mtv_world_ros.success.situation import grippers_open, Situation
from mtv_world_ros.vision.describers.describer import ends_phrase

GRIPPERS = ('open', 'any')
#: `final` means true in each of this many last samples (0.5 s at 10 Hz)
HELD_SAMPLES = 5
#: characters of an object's name in an instruction: what matches it takes bounded time
_LONGEST_NAME = 64
#: keys of relations whose values are picture files by view, and what reads them
PICTURES = {'pictures': load_pictures, 'regions': load_regions}


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskSpec:
    """One task.

    Attributes:
        name: e.g. `stack_blocks_two`.
        instruction: template with placeholders for the objects, `stack the {a} on the {b}`.
        relations: what must hold between the objects at the end, all of it.
        sizes_m: usual extents (x, y, z) of a placeholder's object, for where they are not known:
            from pictures, an object that is not named here is taken as a cube [m].
        nouns: what a placeholder's object may be called, by its last word; not given = anything.
            Tells tasks of one template apart.
        rims: last words of the names of objects that are held by their rim, not across the middle.
        gripper: `open`: every gripper has let go at the end; `any`: that does not matter.
        views: names of the views to look at; empty = all.
        softness_m: length that counts as one in the margins [m].
    """

    name: str
    instruction: str
    relations: tuple[Relation, ...]
    sizes_m: Mapping[str, FloatArray] = field(default_factory=dict)
    nouns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    rims: tuple[str, ...] = ()
    gripper: str = 'open'
    views: tuple[str, ...] = ()
    softness_m: float = 0.01

    @property
    def roles(self) -> tuple[str, ...]:
        """Placeholders that the relations are about."""
        found = [role for relation in self.relations for role in roles_of(relation)]
        return tuple(dict.fromkeys(found))

    @property
    def movers(self) -> tuple[str, ...]:
        """Placeholders of the objects that the robot is to move."""
        return tuple(dict.fromkeys(relation.subject for relation in self.relations))

    @property
    def pictures(self) -> tuple[tuple[str, Picture], ...]:
        """Views and their pictures, of all relations."""
        named = [getattr(relation, key, {}) for relation in self.relations for key in PICTURES]
        return tuple(item for by_view in named for item in by_view.items())

    def holds(self, at: Situation, openings: FloatArray) -> BoolArray:
        """Returns (T,) whether the task is done at each sample.

        Args:
            at: where the objects are.
            openings: (A, T) of the grippers, 0 closed to 1 open.

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
        return np.all(held, axis=0)

    def bind(self, instruction: str) -> dict[str, str] | None:
        """Returns the placeholders' objects if the instruction fits the template, else None."""
        name = rf'(?P<\1>[\\w -]{{1,{_LONGEST_NAME}}}?)'
        pattern = re.sub(r'\\\{(\w+)\\\}', name, re.escape(self.instruction.lower()))
        found = re.fullmatch(pattern, ' '.join(instruction.lower().split()).rstrip('.! '))
        if found is None:
            return None
        bound = found.groupdict()
        if any(ends_phrase(word) for name in bound.values() for word in name.split()):
            return None  # one placeholder took two objects
        fits = all(bound[role].split()[-1] in nouns for role, nouns in self.nouns.items())
        return bound if fits else None


def match_task(
    tasks: Iterable[TaskSpec], instruction: str
) -> tuple[TaskSpec, dict[str, str]] | None:
    """Returns the task whose template the instruction fits, and its objects.

    Where several fit, the one that says most about its objects' nouns, then the first.
    """
    bound = [(task, task.bind(instruction)) for task in tasks]
    found = [(task, objects) for task, objects in bound if objects is not None]
    return max(found, key=lambda pair: len(pair[0].nouns), default=None)


def ever_and_final(success: BoolArray, held: int = HELD_SAMPLES) -> tuple[bool, bool]:
    """Returns whether (T,) `success` held at any sample, and in each of the last `held`."""
    return bool(success.any()), bool(len(success) >= held and success[-held:].all())


def load_task(path: Path) -> TaskSpec:
    """Reads one task.

    Raises:
        ConfigError: the file is no YAML mapping, a key is unknown or missing, a value is wrong.
    """
    data = read_yaml(path, 'task file', 'task')
    values = _checked(TaskSpec, data, str(path))
    given = values['relations']
    if not isinstance(given, list) or not given:
        raise ConfigError(f"{path}: 'relations' is {given!r}; expected a list of relations")
    values['relations'] = tuple(
        _relation(item, Path(path).parent, f'{path}: relations[{index}]')
        for index, item in enumerate(given)
    )
    sizes = _sizes(values.pop('sizes_m', {}), str(path))
    values = {**_numeric(values, str(path)), 'sizes_m': sizes}
    values['nouns'] = _nouns(values.get('nouns', {}), str(path))
    for key in ('views', 'rims'):
        values[key] = _names(values.get(key, []), f"{path}: '{key}'")
    task = TaskSpec(**values)
    _check(task, path)
    return task


def load_tasks(folder: Path) -> tuple[TaskSpec, ...]:
    """Reads every `*.yaml` of a folder, in the order of names.

    Raises:
        ConfigError: a file is wrong, or two tasks share a name.
    """
    tasks = tuple(load_task(path) for path in sorted(Path(folder).glob('*.yaml')))
    names = [task.name for task in tasks]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigError(f'{folder}: more than one file holds task {twice}')
    return tasks


def _check(task: TaskSpec, path: Path) -> None:
    """Refuses placeholders that the instruction does not hold, and an unknown gripper word."""
    for role in (*task.roles, *task.nouns, *task.sizes_m):
        if f'{{{role}}}' not in task.instruction:
            raise ConfigError(
                f"{path}: the relations, nouns or sizes are about '{role}', which the instruction "
                f"'{task.instruction}' does not hold as {{{role}}}"
            )
    if task.gripper not in GRIPPERS:
        raise ConfigError(
            f"{path}: gripper is '{task.gripper}'; it must be one of {', '.join(GRIPPERS)}"
        )


def _relation(data: Any, folder: Path, where: str) -> Relation:
    kind = data.get('kind') if isinstance(data, Mapping) else None
    if kind not in KINDS:
        raise ConfigError(
            f"{where}: kind is '{kind}'{nearest(str(kind), KINDS)}; known are {sorted(KINDS)}"
        )
    values = _numeric(_checked(KINDS[kind], data, where), where)
    for key in values.keys() & PICTURES.keys():
        values[key] = PICTURES[key](values[key], folder, f"{where}: '{key}'")
    return KINDS[kind](**values)


def _checked(kind: type, data: Any, where: str) -> dict[str, Any]:
    """The mapping's items, if its keys are the dataclass's."""
    required = [
        item.name
        for item in fields(kind)
        if item.default is MISSING and item.default_factory is MISSING
    ]
    return dict(check_keys(data, [item.name for item in fields(kind)], required, where))


#: numbers a key holds; a single number where it is not named
_LENGTHS = {
    'distance_m': 2,
    'half_size_m': 2,
    'max_offset_m': 3,
    'offset_m': 3,
    'rise_m': 2,
    'sizes_m': 3,
}
#: keys of shares, above 0 and at most 1
_SHARES = ('min_jaccard', 'min_share')
#: keys whose lengths may be negative
_SIGNED = ('rise_m', 'offset_m')


def _numeric(values: dict[str, Any], where: str) -> dict[str, Any]:
    """The mapping with every number checked to be the finite one, or list, it should be."""
    checked = dict(values)
    for key, value in values.items():
        if key == 'num_reversals' and (type(value) is not int or value < 1):
            raise ConfigError(f"{where}: '{key}' is {value!r}; expected a count of at least 1")
        if key == 'whole' and type(value) is not bool:
            raise ConfigError(f"{where}: '{key}' is {value!r}; expected true or false")
        if key.endswith(('_m', '_rad')):
            checked[key] = _lengths(key, value, where)
        elif key in _SHARES:
            checked[key] = number(values, key, 0.0, where)
            if not 0 < checked[key] <= 1:
                raise ConfigError(f"{where}: '{key}' is {value!r}; it must be in (0, 1]")
    return checked


def _lengths(key: str, value: Any, where: str) -> float | tuple[float, ...]:
    kind = key.split('.')[0]
    count, is_list = _LENGTHS.get(kind, 1), kind in _LENGTHS
    numbers = value if isinstance(value, list) else [value]
    low = -1e3 if key in _SIGNED else 0.0
    fits = len(numbers) == count and isinstance(value, list) == is_list
    if not fits or not all(isinstance(n, int | float) and low < n < 1e3 for n in numbers):
        sort = '' if key in _SIGNED else 'positive '
        unit = 'radians' if key.endswith('_rad') else 'metres'
        raise ConfigError(
            f"{where}: '{key}' is {value!r}; expected {count} {sort}length(s) in {unit}"
        )
    return tuple(map(float, numbers)) if is_list else float(numbers[0])


def _sizes(data: Any, where: str) -> dict[str, FloatArray]:
    if not isinstance(data, Mapping):
        raise ConfigError(f"{where}: 'sizes_m' is {data!r}; expected lengths by placeholder")
    return {
        str(role): np.atleast_1d(_lengths(f'sizes_m.{role}', size, where))
        for role, size in data.items()
    }


def _nouns(data: Any, where: str) -> dict[str, tuple[str, ...]]:
    if not isinstance(data, Mapping):
        raise ConfigError(f"{where}: 'nouns' is {data!r}; expected words by placeholder")
    return {role: _names(words, f"{where}: 'nouns.{role}'") for role, words in data.items()}


def _names(data: Any, where: str) -> tuple[str, ...]:
    if not isinstance(data, list) or not all(isinstance(name, str) for name in data):
        raise ConfigError(f'{where} is {data!r}; expected a list of words')
    return tuple(data)
