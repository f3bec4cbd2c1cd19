"""Tasks: which relation between two objects an instruction asks for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, MISSING
from pathlib import Path
import re
from typing import Any

import numpy as np
import yaml

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import ConfigError, nearest


@dataclass(frozen=True, slots=True, kw_only=True)
class BesideRelation:
    """The subject stands on the table to the left (-x) or right (+x) of the target.

    Attributes:
        kind: `left_of` or `right_of`.
        subject: placeholder of the object that moves.
        target: placeholder of the object it is placed by.
        distance_m: smallest and largest distance of the centres in the table plane.
        max_across_m: largest |dy|.
        max_rise_m: largest |dz|.
        goal_distance_m: dx at which the goal mask is drawn.
    """

    kind: str
    subject: str
    target: str
    distance_m: tuple[float, float] = (0.08, 0.20)
    max_across_m: float = 0.05
    max_rise_m: float = 0.03
    goal_distance_m: float = 0.13

    def goal(self, target: FloatArray, height: float) -> FloatArray:
        """Returns where the subject's centre should be (3,) [m]."""
        del height
        return target + np.array([self._side() * self.goal_distance_m, 0.0, 0.0])

    def margins(self, subject: FloatArray, target: FloatArray, height: float) -> dict[str, float]:
        """Returns by how much each condition holds [m]; negative = violated."""
        del height
        dx, dy, dz = (subject - target).tolist()
        distance = float(np.hypot(dx, dy))
        return {
            'far enough': distance - self.distance_m[0],
            'near enough': self.distance_m[1] - distance,
            'on the right side': self._side() * dx,
            'in line': self.max_across_m - abs(dy),
            'on the table': self.max_rise_m - abs(dz),
        }

    def _side(self) -> float:
        return -1.0 if self.kind == 'left_of' else 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class OnRelation:
    """The subject stands on the target.

    Attributes:
        kind: `on_top_of` (plain `on` is a truth value in YAML).
        subject: placeholder of the object that moves.
        target: placeholder of the object below.
        max_offset_m: largest |dx|, |dy|, |dz| from the place right above the target.
    """

    kind: str
    subject: str
    target: str
    max_offset_m: tuple[float, float, float] = (0.025, 0.025, 0.012)

    def goal(self, target: FloatArray, height: float) -> FloatArray:
        """Returns where the subject's centre should be (3,) [m]."""
        return target + np.array([0.0, 0.0, height])

    def margins(self, subject: FloatArray, target: FloatArray, height: float) -> dict[str, float]:
        """Returns by how much each condition holds [m]; negative = violated."""
        room = np.asarray(self.max_offset_m) - np.abs(subject - self.goal(target, height))
        return dict(
            zip(('over it in x', 'over it in y', 'at its top'), room.tolist(), strict=True)
        )


Relation = BesideRelation | OnRelation
_KINDS = {'left_of': BesideRelation, 'right_of': BesideRelation, 'on_top_of': OnRelation}


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskSpec:
    """One task.

    Attributes:
        name: e.g. `stack_blocks_two`.
        instruction: template with placeholders for the objects, `stack the {a} on the {b}`.
        relation: what must hold between the objects at the end.
        softness_m: length that counts as one in the margins [m].
    """

    name: str
    instruction: str
    relation: Relation
    softness_m: float = 0.01

    def bind(self, instruction: str) -> dict[str, str] | None:
        """Returns the placeholders' objects if the instruction fits the template, else None."""
        pattern = re.sub(
            r'\\\{(\w+)\\\}', r'(?P<\1>[\\w -]+?)', re.escape(self.instruction.lower())
        )
        found = re.fullmatch(pattern, ' '.join(instruction.lower().split()).rstrip('.! '))
        return found.groupdict() if found else None


def match_task(
    tasks: Iterable[TaskSpec], instruction: str
) -> tuple[TaskSpec, dict[str, str]] | None:
    """Returns the first task whose template the instruction fits, and its objects."""
    for task in tasks:
        bound = task.bind(instruction)
        if bound is not None:
            return task, bound
    return None


def load_task(path: Path) -> TaskSpec:
    """Reads one task.

    Raises:
        ConfigError: the file is no YAML mapping, a key is unknown or missing, a value is wrong.
    """
    try:
        data = yaml.safe_load(Path(path).read_text(encoding='utf-8'))
    except (OSError, yaml.YAMLError) as error:
        raise ConfigError(f"task file '{path}' cannot be read: {error}") from error
    values = _checked(TaskSpec, data, str(path))
    relation = values['relation']
    kind = relation.get('kind') if isinstance(relation, Mapping) else None
    if kind not in _KINDS:
        raise ConfigError(
            f"{path}: relation.kind is '{kind}'{nearest(str(kind), _KINDS)}; known are "
            f'{sorted(_KINDS)}'
        )
    where = f'{path}: relation'
    values['relation'] = _KINDS[kind](**_numeric(_checked(_KINDS[kind], relation, where), where))
    task = TaskSpec(**_numeric(values, str(path)))
    for role in (task.relation.subject, task.relation.target):
        if f'{{{role}}}' not in task.instruction:
            raise ConfigError(
                f"{path}: the relation is about '{role}', which the instruction "
                f"'{task.instruction}' does not hold as {{{role}}}"
            )
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


def _checked(kind: type, data: Any, where: str) -> dict[str, Any]:
    """The mapping's items, if its keys are the dataclass's."""
    known = {item.name: item for item in fields(kind)}
    if not isinstance(data, Mapping):
        raise ConfigError(f'{where}: expected a mapping with the keys {sorted(known)}')
    for key in data:
        if key not in known:
            raise ConfigError(f"{where}: unknown key '{key}'{nearest(str(key), known)}")
    missing = [key for key, item in known.items() if item.default is MISSING and key not in data]
    if missing:
        raise ConfigError(f'{where}: missing {missing}')
    return dict(data)


#: numbers a key holds; a single number where it is not named
_LENGTHS = {'distance_m': 2, 'max_offset_m': 3}


def _numeric(values: dict[str, Any], where: str) -> dict[str, Any]:
    """The mapping with every `*_m` checked to be the finite, positive length(s) it should be."""
    checked = dict(values)
    for key, value in values.items():
        if not key.endswith('_m'):
            continue
        numbers = value if isinstance(value, list) else [value]
        fits = len(numbers) == _LENGTHS.get(key, 1) and isinstance(value, list) == (
            key in _LENGTHS
        )
        if not fits or not all(isinstance(n, int | float) and 0 < n < 1e3 for n in numbers):
            raise ConfigError(
                f"{where}: '{key}' is {value!r}; expected {_LENGTHS.get(key, 1)} positive "
                'length(s) in metres'
            )
        checked[key] = tuple(map(float, numbers)) if key in _LENGTHS else float(numbers[0])
    return checked
