"""Tasks that the simulator can play: objects on the table, and the expert's moves.

A task is one file, `config/tasks/<name>.yaml` or a user's own: instruction and relations, which
`success/task.py` reads, and a `scene`, which is read here. Tasks in `config/tasks/zero_shot` are
for the zero-shot sets alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import json
from pathlib import Path
import re
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, Field, PlainValidator, Strict

from mtv_world_ros.core.config import (
    expected,
    ListOf,
    Number,
    read_yaml,
    Schema,
    Share,
    validated,
)
from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import ConfigError, SimulatorError, UnknownNameError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.simulation.scenes.shapes import SHAPES
from mtv_world_ros.success.own_tasks import bundled_tasks, YAML
from mtv_world_ros.success.situation import TruePoses
from mtv_world_ros.success.task import (
    dump_task,
    load_task,
    SCENES_REPLACED,
    stored_task,
    TaskSpec,
)

#: (x, y) [m], or a pair of angles [rad]
Two = Annotated[tuple[Number, Number], Strict(False), expected('a list of 2 numbers')]


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] > pair[1]:
        raise ValueError('the first is the larger one')
    return pair


#: (least, most)
Range = Annotated[
    tuple[Number, Number],
    Strict(False),
    AfterValidator(_ordered),
    expected('a list of 2 numbers, the smaller one first'),
]
#: `PickPlace.reference`: the goal is relative to where the subject started
START = 'start'
#: `PickPlace.reference`: the goal is a place on the table
TABLE = 'table'
#: `ObjectRole.size_share` of a role without a wanted size
ANY_SIZE = (0.0, 1.0)
#: names of tasks are parts of file names
_NAME = re.compile(r'[A-Za-z0-9][A-Za-z0-9._-]*')
#: page that describes a task's file
_PAGE = 'docs/tasks.md'


def _known_shapes(shapes: tuple[str, ...]) -> tuple[str, ...]:
    for shape in shapes:
        if shape not in SHAPES:
            raise UnknownNameError('unknown shape', shape, sorted(SHAPES), listed='; known are')
    if not shapes:
        raise ValueError(f'no shape is given; known are {", ".join(sorted(SHAPES))}')
    return shapes


class ObjectRole(Schema):
    """An object that a task asks for.

    Attributes:
        role: placeholder of the object in the task's instruction and relations.
        shapes: names of shapes (`simulation/scenes/shapes.py`); one is drawn and is the noun of
            the object's name (`red block`).
        size_share: range of sizes, from the shape's smallest (0) to its largest (1).
        x_range: range of its centre's x, to the right of the table's middle [m].
        y_range: range of its centre's y, away from the robot [m].
        yaw_range: range of its yaw [rad].
        probability: probability that the object is in the scene (below 1: distractors).
    """

    role: Annotated[
        str, Field(pattern=r'^[a-z][a-z0-9_]*$'), expected('small letters, digits and _, e.g. a')
    ]
    shapes: Annotated[ListOf[str], AfterValidator(_known_shapes)] = ('block',)
    size_share: Range = ANY_SIZE
    x_range: Range = (-0.2, 0.2)
    y_range: Range = (0.21, 0.35)
    yaw_range: Range = (-0.35, 0.35)
    probability: Share = 1.0


class PickPlace(Schema):
    """A move of the expert: pick `subject`, place it relative to `reference`.

    Attributes:
        subject: role that is carried.
        reference: role that the goal is relative to, or `start` (where the subject lay), or
            `table` (the middle of the table).
        offset: goal centre minus the reference's centre, (x, y) [m].
        spread: half widths of the region around it that the goal is drawn from, (x, y) [m].
        rest: place where the subject comes to rest: `table`, `on` (on the reference) or `in`
            (dropped into the reference).
        least: smallest distance of the goal from where the subject lies [m].
    """

    subject: str
    reference: str
    offset: Two = (0.0, 0.0)
    spread: Two = (0.0, 0.0)
    rest: Literal['table', 'on', 'in'] = 'table'
    least: Annotated[float, Field(ge=0, le=100)] = 0.0


class Shake(Schema):
    """A move of the expert: lift `subject`, swing it to and fro, put it back.

    Attributes:
        subject: role that is shaken.
    """

    removed: ClassVar = dict.fromkeys(
        ('lean', 'lift', 'num_swings'), 'the expert shakes all objects in the same way'
    )

    subject: str


Move = PickPlace | Shake


def _move(data: Any) -> Move:
    """Return a move: with a `reference` it places its subject, without one it shakes it."""
    if isinstance(data, PickPlace | Shake):
        return data
    if isinstance(data, Mapping) and 'reference' not in data:
        known = {*Shake.model_fields, *Shake.removed}
        strange = next((key for key in data if key not in known), None)
        if strange is not None:
            known = dict.fromkeys([*PickPlace.model_fields, *Shake.model_fields])
            raise UnknownNameError(
                'unknown key',
                str(strange),
                known,
                listed=f'; a move that places has {", ".join(PickPlace.model_fields)}, one that '
                f'shakes {", ".join(Shake.model_fields)}',
                most=0,
            )
        return Shake.model_validate(data)
    return PickPlace.model_validate(data)


class SceneSpec(Schema):
    """The `scene` of a task's file.

    Attributes:
        roles: objects; required roles come before distractors.
        moves: the expert's moves, in order.
        mirrored: whether left and right of the whole scene are exchanged in every second episode.
        after: bundled task after which this one takes its turn in `--task all`; empty = by name.
    """

    roles: ListOf[ObjectRole]
    moves: ListOf[Annotated[Move, PlainValidator(_move)]]
    mirrored: bool = False
    after: str = ''


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """A task with its scene.

    Attributes:
        definition: instruction, and the relations that must hold at the end.
        roles: objects; required roles come before distractors.
        moves: the expert's moves, in order.
        mirrored: whether left and right of the whole scene are exchanged in every second episode.
        zero_shot: whether the task is for the zero-shot sets alone, and no part of `--task all`.
    """

    definition: TaskSpec = field(hash=False)
    roles: tuple[ObjectRole, ...]
    moves: tuple[Move, ...]
    mirrored: bool = False
    zero_shot: bool = False

    @classmethod
    def of(cls, definition: TaskSpec, where: str, *, zero_shot: bool = False) -> Task:
        """Return the task of a definition that has a scene.

        Args:
            definition: content of the task's file.
            where: beginning of error texts, the file.
            zero_shot: see the attribute.

        Raises:
            SimulatorError: there is no scene.
            ConfigError: a key or a value of the scene is wrong.
        """
        if definition.scene is None:
            raise SimulatorError(
                f"{where}: task '{definition.name}' has no scene: it can be judged, but not "
                f"simulated; add 'scene' with its roles and moves to its file ({_PAGE})"
            )
        scene = validated(SceneSpec, definition.scene, f'{where}: scene')
        for fault in (_fault_of_names(definition, scene), _fault_of_moves(definition, scene)):
            if fault:
                raise ConfigError(f'{where}: {fault} ({_PAGE})')
        return cls(
            definition=definition,
            roles=scene.roles,
            moves=scene.moves,
            mirrored=scene.mirrored,
            zero_shot=zero_shot,
        )

    @property
    def name(self) -> str:
        """Name of the task."""
        return self.definition.name

    @property
    def instruction(self) -> str:
        """Template with one field per role, filled with the objects' names."""
        return self.definition.instruction

    def succeeds(self, poses: TruePoses) -> BoolArray:
        """Return (T,) whether the task is done at each sample."""
        return self.definition.holds(poses, poses.openings)

    def goals(self, places: Sequence[tuple[float, float, float]]) -> dict[str, FloatArray]:
        """Return role -> goal (3,) of the goals of the moves [m]."""
        pairs = zip(self.moves, places, strict=True)
        return {move.subject: np.asarray(place) for move, place in pairs}


def _fault_of_names(definition: TaskSpec, scene: SceneSpec) -> str:
    """Return what is wrong with the names of a task and of its roles; empty if nothing is."""
    if not _NAME.fullmatch(definition.name):
        return f"name is '{definition.name}'; it must be letters, digits and . _ -"
    names = [role.role for role in scene.roles]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        return f"scene.roles has '{twice[0]}' more than once"
    reserved = {START, TABLE} & set(names)
    if reserved:
        return f"scene.roles has '{min(reserved)}', which a move's reference means otherwise"
    always = [role.role for role in scene.roles if role.probability == 1]
    for role in re.findall(r'\{(\w+)\}', definition.instruction):
        if role not in always:
            return str(
                UnknownNameError(
                    f'the instruction has {{{role}}}, but scene.roles has no',
                    role,
                    names,
                    is_not=' of probability 1',
                    listed='; it has',
                )
            )
    return ''


def _fault_of_moves(definition: TaskSpec, scene: SceneSpec) -> str:
    """Return what is wrong with the moves of a scene; empty if nothing is."""
    always = {role.role: role for role in scene.roles if role.probability == 1}
    for number, move in enumerate(scene.moves):
        if move.subject not in always:
            return str(
                UnknownNameError(
                    f'scene.moves[{number}].subject is',
                    move.subject,
                    always,
                    listed='; it must be one of',
                )
            )
        fixed = [s for s in always[move.subject].shapes if SHAPES[s].grasp is None]
        if fixed:
            return (
                f"scene.moves[{number}].subject '{move.subject}' may be a {fixed[0]}, which no "
                'gripper can hold; take the shape out of its role'
            )
        if isinstance(move, PickPlace) and move.reference not in {*always, START, TABLE}:
            known = [*always, START, TABLE]
            return str(
                UnknownNameError(
                    f'scene.moves[{number}].reference is',
                    move.reference,
                    known,
                    listed='; it must be one of',
                )
            )
        if isinstance(move, PickPlace) and move.rest != 'table' and move.reference not in always:
            return (
                f"scene.moves[{number}].rest is '{move.rest}', which needs an object as "
                f"reference, not '{move.reference}'"
            )
    idle = [role for role in definition.movers if role not in {m.subject for m in scene.moves}]
    if idle:
        return f"scene.moves has none of '{idle[0]}', which the relations want to be moved"
    return ''


def _read_tasks() -> dict[str, Task]:
    """Return the tasks of `config/tasks` by name, in the order of `--task all`."""
    folder = share_path('config', 'tasks')
    tasks: dict[str, Task] = {}
    places: dict[str, str] = {}
    for path in sorted(folder.glob('*.yaml')):
        definition = load_task(path)
        if definition.scene is not None:
            _check_new(definition.name, tasks, path)
            tasks[definition.name] = Task.of(definition, str(path))
            places[definition.name] = definition.scene.get('after', '')
    names = [name for name in tasks if not places[name]]
    for name in (name for name in tasks if places[name]):
        if places[name] not in names:
            raise ConfigError.unknown(
                f"task '{name}': scene.after is", places[name], names, listed='; it must be one of'
            )
        names.insert(names.index(places[name]) + 1, name)
    ordered = {name: tasks[name] for name in names}
    for path in sorted(folder.glob('zero_shot/*.yaml')):
        definition = load_task(path)
        _check_new(definition.name, ordered, path)
        ordered[definition.name] = Task.of(definition, str(path), zero_shot=True)
    _check_old_table(folder.parent / 'scenes.yaml', ordered)
    return ordered


def _check_new(name: str, tasks: Mapping[str, Task], path: Path) -> None:
    """Raise if another file holds a task of this name.

    Raises:
        ConfigError: names the file.
    """
    if name in tasks:
        raise ConfigError(
            f"'{path}': another file of '{path.parent}' or the folder beside it holds a task "
            f"'{name}', too; give one of them another name"
        )


def _check_old_table(path: Path, tasks: Mapping[str, Task]) -> None:
    """Raise if a table of scenes, as version 0.1.0 has it, holds what no task's file holds.

    An installation over an older one may leave the bundled table behind: it is not read.

    Raises:
        ConfigError: a scene was added to the table or changed in it.
    """
    if not path.is_file():
        return
    table = read_yaml(path, 'scene file', 'config')
    held = {name: dict(task.definition.scene or {}) for name, task in tasks.items()}
    for name, values in table.items() if isinstance(table, Mapping) else ():
        scene = dict(values) if isinstance(values, Mapping) else {}
        scene.pop('zero_shot', None)
        if scene != {key: v for key, v in held.get(name, {}).items() if key != 'after'}:
            raise ConfigError(f"{path}: scene of '{name}': {SCENES_REPLACED}")


TASKS = _read_tasks()


def task_named(name: str) -> Task:
    """Return a task by name.

    Raises:
        SimulatorError: unknown name, for which the text names the nearest known one, or a task
            without a scene.
    """
    if name not in TASKS:
        known = f'{", ".join(sorted(TASKS))}, or give the YAML file of a task'
        if name in {task.name for task in bundled_tasks()}:
            raise SimulatorError(
                f"task '{name}' has no scene: it can be judged, but not simulated; those with a "
                f'scene are {known}'
            )
        raise SimulatorError.unknown(
            'unknown task', name, TASKS, listed=f'; known are {known}', most=0
        )
    return TASKS[name]


def tasks_named(text: str, folder: Path = Path()) -> tuple[Task, ...]:
    """Return the tasks of a comma-separated list of names and of YAML files.

    Args:
        text: the list; `all` = all bundled ones but the zero-shot ones.
        folder: folder that relative paths of files begin in.

    Raises:
        SimulatorError: unknown name, or a file without a scene.
        ConfigError: a file cannot be used, or two tasks have one name.
    """
    if text.strip() == 'all':
        return tuple(task for task in TASKS.values() if not task.zero_shot)
    words = [word.strip() for word in text.split(',') if word.strip()]
    tasks = tuple(_read_task(w, folder) if w.endswith(YAML) else task_named(w) for w in words)
    by_name: dict[str, Task] = {}
    for task in tasks:
        if by_name.setdefault(task.name, task) != task:
            raise ConfigError(
                f"'{text}' has two different tasks of the name '{task.name}'; rename one of their "
                'files'
            )
    return tasks


def own_definition(task: Task) -> str:
    """Return the definition of a task as JSON, for `stored_or_named`; empty for a bundled task."""
    name = task.name
    if name in TASKS and TASKS[name].definition == task.definition:
        return ''
    return json.dumps(dump_task(task.definition), sort_keys=True)


def stored_or_named(definition: str, name: str, where: str) -> Task:
    """Return the task of a stored definition, else the bundled task of a name.

    Args:
        definition: text of `own_definition`; empty = the name is enough.
        name: name of the task.
        where: place of the definition, for error texts.

    Raises:
        ConfigError: the definition cannot be used.
        SimulatorError: there is no such task.
    """
    if not definition:
        return task_named(name)
    return Task.of(stored_task(definition, where), where)


def _read_task(word: str, folder: Path) -> Task:
    path = folder / Path(word).expanduser()
    return Task.of(load_task(path), str(path))
