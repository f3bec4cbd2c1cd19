"""The benchmark's tasks, each one declarative description."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mtv_world_ros.data_types import BoolArray
from mtv_world_ros.errors import nearest, SimulatorError
from mtv_world_ros.sim import predicates
from mtv_world_ros.sim.predicates import History


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectRole:
    """An object that a task asks for.

    Attributes:
        role: its part in the task; the key of `History.positions`.
        shape: key of `scene.SHAPES`; also the noun of its name (`red block`).
        size_range: smallest and largest extent [m].
        x_range: where its centre may start, to the right of the table's middle [m].
        y_range: where its centre may start, away from the robot [m].
        probability: how often the object is there at all (distractors).
    """

    role: str
    shape: str = 'block'
    size_range: tuple[float, float] = (0.04, 0.055)
    x_range: tuple[float, float] = (-0.2, 0.2)
    y_range: tuple[float, float] = (0.21, 0.35)
    probability: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PickPlace:
    """One move of the expert: pick `subject`, place it relative to `reference`.

    Attributes:
        subject: role that is carried.
        reference: role that the goal is relative to.
        offset: (x, y) goal centre minus the reference's centre [m].
        on_top: the subject comes to rest on the reference, turned like it.
    """

    subject: str
    reference: str
    offset: tuple[float, float] = (0.0, 0.0)
    on_top: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One task: what lies on the table, what is said, what the expert does, what succeeds.

    Attributes:
        name: key in `TASKS`.
        instruction: template with one field per role, filled with the objects' names.
        roles: objects; required roles come before distractors.
        moves: the expert's moves, in order.
        succeeds: History -> (T,) bool.
    """

    name: str
    instruction: str
    roles: tuple[ObjectRole, ...]
    moves: tuple[PickPlace, ...]
    succeeds: Callable[[History], BoolArray]


_TWO_BLOCKS = (
    ObjectRole(role='a'),
    ObjectRole(role='b'),
    ObjectRole(role='distractor', probability=0.2),
)

TASKS = {
    task.name: task
    for task in (
        Task(
            name='place_block_a2b_left',
            instruction='place the {a} to the left of the {b}',
            roles=_TWO_BLOCKS,
            moves=(PickPlace(subject='a', reference='b', offset=(-0.13, 0.0)),),
            succeeds=predicates.a_left_of_b,
        ),
        Task(
            name='stack_blocks_two',
            instruction='stack the {a} on the {b}',
            roles=_TWO_BLOCKS,
            moves=(PickPlace(subject='a', reference='b', on_top=True),),
            succeeds=predicates.a_on_b,
        ),
    )
}


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
    """Returns the tasks of a comma-separated list of names, or all for `all`."""
    if text.strip() == 'all':
        return tuple(TASKS.values())
    return tuple(task_named(name.strip()) for name in text.split(',') if name.strip())
