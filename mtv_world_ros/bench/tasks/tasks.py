"""Scenes of the benchmark's tasks: objects on the table, and the expert's moves.

Instruction and success relations are in `config/tasks/<name>.yaml`; of tasks whose goal only the
simulator knows, in `config/tasks/zero_shot`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from mtv_world_ros.data_types import BoolArray, FloatArray
from mtv_world_ros.errors import nearest, SimulatorError
from mtv_world_ros.files import share_path
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
        shapes: keys of `SHAPES`, one of which is drawn; also the noun of its name (`red block`).
        size_share: range of sizes, from the shape's smallest (0) to its largest (1).
        x_range: range of its centre's x, to the right of the table's middle [m].
        y_range: range of its centre's y, away from the robot [m].
        yaw_range: range of its yaw [rad].
        probability: of the object being in the scene (below 1: distractors).
    """

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

    subject: str
    reference: str
    offset: tuple[float, float] = (0.0, 0.0)
    spread: tuple[float, float] = (0.0, 0.0)
    rest: str = 'table'
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
        """Returns (T,) whether the task is done at each sample."""
        return self.definition.holds(poses, poses.openings)

    def goals(self, places: Sequence[tuple[float, float, float]]) -> dict[str, FloatArray]:
        """Returns role -> goal (3,) of the goals of the moves [m]."""
        pairs = zip(self.moves, places, strict=True)
        return {move.subject: np.asarray(place) for move, place in pairs}


@cache
def _read(path: Path) -> TaskSpec:
    return load_task(path)


_FOOD = ('bread', 'carrot', 'eggplant', 'corn')
_TOYS = ('car', 'duck', 'block')
_LEFT, _RIGHT, _MIDDLE = (-0.22, -0.135), (0.135, 0.22), (-0.015, 0.015)
_DISTRACTOR = ObjectRole(role='distractor', probability=0.2)
_TWO_BLOCKS = (ObjectRole(role='a'), ObjectRole(role='b'), _DISTRACTOR)
_SMALL = (0.0, 0.3)


def _collect(name: str, shapes: tuple[str, ...], container: str) -> Task:
    """Two objects, one from either side, go into a container in the middle."""
    roles = (
        ObjectRole(role='a', shapes=shapes, x_range=_LEFT, y_range=(0.2, 0.31)),
        ObjectRole(role='b', shapes=shapes, x_range=_RIGHT, y_range=(0.2, 0.31)),
        ObjectRole(
            role='c', shapes=(container,), x_range=_MIDDLE, y_range=(0.22, 0.245),
            yaw_range=(-0.1, 0.1),
        ),
    )  # fmt: skip
    rest = 'on' if container == 'tray' else 'in'
    return Task(
        name=name,
        roles=roles,
        moves=tuple(
            PickPlace(subject=role, reference='c', offset=(side * 0.038, 0.0), rest=rest)
            for role, side in (('a', -1), ('b', 1))
        ),
        mirrored=True,
    )


def _beside(name: str, side: float) -> Task:
    """One block goes to the left (-1) or the right (+1) of another."""
    return Task(
        name=name,
        roles=_TWO_BLOCKS,
        moves=(PickPlace(subject='a', reference='b', offset=(side * 0.13, 0.0)),),
    )


def _both_beside(name: str, side: float) -> Task:
    """Two blocks go to one side of a third, the farther one first."""
    return Task(
        name=name,
        roles=tuple(ObjectRole(role=role, size_share=_SMALL) for role in 'abc'),
        moves=(
            PickPlace(subject='a', reference='c', offset=(side * 0.18, 0.015)),
            PickPlace(subject='b', reference='c', offset=(side * 0.1, -0.015)),
        ),
    )


def _serve(name: str, item: str) -> Task:
    """Bread or a cup goes onto a plate."""
    return Task(
        name=name,
        roles=(
            ObjectRole(role='a', shapes=(item,)),
            ObjectRole(role='b', shapes=('plate',), y_range=(0.22, 0.32)),
            _DISTRACTOR,
        ),
        moves=(PickPlace(subject='a', reference='b', rest='on'),),
    )


_ALL = (
    _collect('bussing_table', ('cup', 'bread', 'corn'), 'bin'),
    _collect('collect_food', _FOOD, 'basket'),
    _collect('collect_tableware', ('cup',), 'tray'),
    _collect('collect_toy', _TOYS, 'basket'),
    Task(
        name='move_stack_block_ab',
        roles=(
            ObjectRole(role='a', x_range=(-0.21, -0.15), y_range=(0.2, 0.33)),
            ObjectRole(role='b', x_range=(0.12, 0.21), y_range=(0.2, 0.33)),
            _DISTRACTOR,
        ),
        moves=(
            PickPlace(subject='a', reference=TABLE, offset=(0.0, 0.225), spread=(0.02, 0.015)),
            PickPlace(subject='b', reference='a', rest='on'),
        ),
        mirrored=True,
    ),
    Task(
        name='move_stack_plate',
        roles=(
            ObjectRole(role='a', shapes=('plate',), y_range=(0.22, 0.3)),
            ObjectRole(role='b', shapes=('plate',), y_range=(0.22, 0.3)),
        ),
        moves=(PickPlace(subject='a', reference='b', rest='on'),),
    ),
    Task(
        name='move_object_two',
        roles=tuple(
            ObjectRole(role=role, shapes=('block', 'cup', 'car', 'bread', 'bowl'), x_range=x_range,
                       y_range=(0.29, 0.35))
            for role, x_range in (('a', (-0.2, -0.07)), ('b', (0.07, 0.2)))
        ),
        moves=tuple(PickPlace(subject=role, reference=START, offset=(0, -0.1)) for role in 'ab'),
        mirrored=True,
    ),
    _beside('place_block_a2b_left', -1),
    _beside('place_block_a2b_right', 1),
    _both_beside('place_block_ab2c_left', -1),
    _both_beside('place_block_ab2c_right', 1),
    _serve('place_bread_plate', 'bread'),
    _serve('place_cup_plate', 'cup'),
    Task(
        name='shake_bottle',
        roles=(
            ObjectRole(role='a', shapes=('bottle',), x_range=(-0.2, -0.05), y_range=(0.23, 0.29)),
            ObjectRole(role='b', shapes=('block', 'cup')),
            _DISTRACTOR,
        ),
        moves=(Shake(subject='a'),),
        mirrored=True,
    ),
    Task(
        name='stack_blocks_two',
        roles=_TWO_BLOCKS,
        moves=(PickPlace(subject='a', reference='b', rest='on'),),
    ),
    Task(
        name='random_pick_place',
        roles=(
            *(
                ObjectRole(role=role, shapes=('bowl', 'cup', *_FOOD, *_TOYS),
                           x_range=(-0.18, 0.18), y_range=(0.21, 0.33))
                for role in 'ab'
            ),
            _DISTRACTOR,
        ),
        moves=(
            PickPlace(
                subject='a', reference=TABLE, offset=(0.0, 0.27), spread=(0.22, 0.07), least=0.08
            ),
        ),
        zero_shot=True,
    ),
)  # fmt: skip

TASKS = {task.name: task for task in _ALL}


def task_named(name: str) -> Task:
    """Returns a task by name.

    Raises:
        SimulatorError: unknown name; the text names the nearest known one.
    """
    if name not in TASKS:
        raise SimulatorError(
            f"unknown task '{name}'{nearest(name, TASKS)}; known are {', '.join(sorted(TASKS))}"
        )
    return TASKS[name]


def tasks_named(text: str) -> tuple[Task, ...]:
    """Returns the tasks of a comma-separated list of names; `all` = all but the zero-shot ones."""
    if text.strip() == 'all':
        return tuple(task for task in TASKS.values() if not task.zero_shot)
    return tuple(task_named(name.strip()) for name in text.split(',') if name.strip())
