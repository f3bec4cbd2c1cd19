"""Scenes of the benchmark's tasks: objects on the table, and the expert's moves.

Scenes are data, in `config/scenes.yaml`. Instruction and success relations of a task are in
`config/tasks/<name>.yaml`, or in `config/tasks/zero_shot` where only the simulator knows the goal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ConfigDict, TypeAdapter

from mtv_world_ros.core.config import read_yaml
from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import nearest, SimulatorError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.success.situation import TruePoses
from mtv_world_ros.success.task import load_task, TaskSpec

Range = tuple[float, float]
#: `PickPlace.reference`: the goal is relative to where the subject started
START = 'start'
#: `PickPlace.reference`: the goal is a place on the table
TABLE = 'table'


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectRole:
    """An object that a task asks for.

    Attributes:
        role: its part in the task; the placeholder of the task's instruction and relations.
        shapes: keys of `SHAPES`; one is drawn and is the noun of its name (`red block`).
        size_share: range of sizes, from the shape's smallest (0) to its largest (1).
        x_range: range of its centre's x, to the right of the table's middle [m].
        y_range: range of its centre's y, away from the robot [m].
        yaw_range: range of its yaw [rad].
        probability: of the object being in the scene (below 1: distractors).
    """

    __pydantic_config__ = ConfigDict(extra='forbid')

    role: str
    shapes: tuple[str, ...] = ('block',)
    size_share: Range = (0.0, 1.0)
    x_range: Range = (-0.2, 0.2)
    y_range: Range = (0.21, 0.35)
    yaw_range: Range = (-0.35, 0.35)
    probability: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PickPlace:
    """A move of the expert: pick `subject`, place it relative to `reference`.

    Attributes:
        subject: role that is carried.
        reference: role that the goal is relative to, or `START`, or `TABLE`.
        offset: goal centre minus the reference's centre, (x, y) [m].
        spread: half widths of the region around it that the goal is drawn from, (x, y) [m].
        rest: `table`, `on` (comes to rest on the reference) or `in` (dropped into it).
        least: no goal is nearer than this to where the subject lies [m].
    """

    __pydantic_config__ = ConfigDict(extra='forbid')

    subject: str
    reference: str
    offset: tuple[float, float] = (0.0, 0.0)
    spread: tuple[float, float] = (0.0, 0.0)
    rest: Literal['table', 'on', 'in'] = 'table'
    least: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Shake:
    """A move of the expert: lift `subject`, swing it to and fro, put it back.

    Attributes:
        subject: role that is shaken.
        lean: how far it leans in turn, positive towards the table's middle [rad]; the wrist has
            less room the other way.
        lift: height it is shaken at, over where it stood [m].
        num_swings: from one side to the other.
    """

    __pydantic_config__ = ConfigDict(extra='forbid')

    subject: str
    lean: tuple[float, float] = (0.45, -0.1)
    lift: Range = (0.074, 0.082)
    num_swings: int = 4


Move = PickPlace | Shake


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One task's scenes.

    Attributes:
        name: key in `TASKS`, and name of the file that defines the task.
        roles: objects; required roles come before distractors.
        moves: the expert's moves, in order.
        mirrored: left and right of the whole scene are exchanged in every second episode.
        zero_shot: no part of the 15 tasks; for the zero-shot sets.
    """

    __pydantic_config__ = ConfigDict(extra='forbid')

    name: str
    roles: tuple[ObjectRole, ...]
    moves: tuple[Move, ...]
    mirrored: bool = False
    zero_shot: bool = False

    @property
    def definition(self) -> TaskSpec:
        """Instruction, and the relations that must hold at the end."""
        folder = ('config', 'tasks', *(['zero_shot'] if self.zero_shot else []))
        return _read(share_path(*folder, f'{self.name}.yaml'))

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


@cache
def _read(path: Path) -> TaskSpec:
    return load_task(path)


def _read_tasks() -> dict[str, Task]:
    """The tasks of `config/scenes.yaml`, in its order."""
    entries = read_yaml(share_path('config', 'scenes.yaml'), 'scene file', 'config')
    adapter = TypeAdapter(Task)
    return {n: adapter.validate_python({'name': n, **values}) for n, values in entries.items()}


TASKS = _read_tasks()


def task_named(name: str) -> Task:
    """Return a task by name.

    Raises:
        SimulatorError: unknown name; the text names the nearest known one.
    """
    if name not in TASKS:
        raise SimulatorError(
            f"unknown task '{name}'{nearest(name, TASKS)}; known are {', '.join(sorted(TASKS))}"
        )
    return TASKS[name]


def tasks_named(text: str) -> tuple[Task, ...]:
    """Return the tasks of a comma-separated list of names; `all` = all but the zero-shot ones."""
    if text.strip() == 'all':
        return tuple(task for task in TASKS.values() if not task.zero_shot)
    return tuple(task_named(name.strip()) for name in text.split(',') if name.strip())
