"""The benchmark's tasks, each one declarative description."""

from __future__ import annotations

from dataclasses import dataclass

from mtv_world_ros.errors import nearest, SimulatorError
from mtv_world_ros.sim.tasks import predicates as is_true
from mtv_world_ros.sim.tasks.predicates import Predicate

Range = tuple[float, float]
#: `PickPlace.reference`: the goal is relative to where the subject started
START = 'start'
#: `PickPlace.reference`: the goal is a place on the table
TABLE = 'table'


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectRole:
    """An object that a task asks for.

    Attributes:
        role: its part in the task; the key of `History.positions`.
        shapes: keys of `SHAPES`, one of which is drawn; also the noun of its name (`red block`).
        size_share: which sizes between the shape's smallest (0) and largest (1) are drawn.
        x_range: where its centre may start, to the right of the table's middle [m].
        y_range: where its centre may start, away from the robot [m].
        yaw_range: how it may be turned about z [rad].
        probability: how often the object is there at all (distractors).
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
    """One task: what lies on the table, what is said, what the expert does, what succeeds.

    Attributes:
        name: key in `TASKS`.
        instruction: template with one field per role, filled with the objects' names.
        roles: objects; required roles come before distractors.
        moves: the expert's moves, in order.
        succeeds: History -> (T,) bool.
        mirrored: left and right of the whole scene are exchanged in every second episode.
        zero_shot: no part of the 15 tasks; for the zero-shot sets.
    """

    name: str
    instruction: str
    roles: tuple[ObjectRole, ...]
    moves: tuple[Move, ...]
    succeeds: Predicate
    mirrored: bool = False
    zero_shot: bool = False


_FOOD = ('bread', 'carrot', 'eggplant', 'corn')
_TOYS = ('car', 'duck', 'block')
_LEFT, _RIGHT, _MIDDLE = (-0.22, -0.135), (0.135, 0.22), (-0.015, 0.015)
_DISTRACTOR = ObjectRole(role='distractor', probability=0.2)
_TWO_BLOCKS = (ObjectRole(role='a'), ObjectRole(role='b'), _DISTRACTOR)
_SMALL = (0.0, 0.3)


def _collect(name: str, instruction: str, shapes: tuple[str, ...], container: str) -> Task:
    """Two things from either side go into a container in the middle."""
    roles = (
        ObjectRole(role='a', shapes=shapes, x_range=_LEFT, y_range=(0.2, 0.31)),
        ObjectRole(role='b', shapes=shapes, x_range=_RIGHT, y_range=(0.2, 0.31)),
        ObjectRole(
            role='c', shapes=(container,), x_range=_MIDDLE, y_range=(0.22, 0.245),
            yaw_range=(-0.1, 0.1),
        ),
    )  # fmt: skip
    rest = 'on' if container == 'tray' else 'in'
    test = is_true.are_collected(('a', 'b'), 'c')
    if container == 'tray':
        test = is_true.all_of(test, is_true.are_inside(('a', 'b'), 'c', footprint=True))
    if container == 'bin':
        test = is_true.are_inside(('a', 'b'), 'c')
    return Task(
        name=name,
        instruction=instruction,
        roles=roles,
        moves=tuple(
            PickPlace(subject=role, reference='c', offset=(side * 0.038, 0.0), rest=rest)
            for role, side in (('a', -1), ('b', 1))
        ),
        succeeds=is_true.all_of(test),
        mirrored=True,
    )


def _beside(name: str, side: float) -> Task:
    """One block goes to the left (-1) or the right (+1) of another."""
    word = 'left' if side < 0 else 'right'
    return Task(
        name=name,
        instruction=f'place the {{a}} to the {word} of the {{b}}',
        roles=_TWO_BLOCKS,
        moves=(PickPlace(subject='a', reference='b', offset=(side * 0.13, 0.0)),),
        succeeds=is_true.all_of(is_true.is_beside('a', 'b', side)),
    )


def _both_beside(name: str, side: float) -> Task:
    """Two blocks go to one side of a third, the farther one first."""
    word = 'left' if side < 0 else 'right'
    return Task(
        name=name,
        instruction=f'place the {{a}} and the {{b}} to the {word} of the {{c}}',
        roles=tuple(ObjectRole(role=role, size_share=_SMALL) for role in 'abc'),
        moves=(
            PickPlace(subject='a', reference='c', offset=(side * 0.18, 0.015)),
            PickPlace(subject='b', reference='c', offset=(side * 0.1, -0.015)),
        ),
        succeeds=is_true.all_of(
            is_true.is_beside('a', 'c', side),
            is_true.is_beside('b', 'c', side),
            is_true.is_apart('a', 'b'),
        ),
    )


def _serve(name: str, item: str) -> Task:
    """Bread or a cup goes onto a plate."""
    return Task(
        name=name,
        instruction='place the {a} on the {b}',
        roles=(
            ObjectRole(role='a', shapes=(item,)),
            ObjectRole(role='b', shapes=('plate',), y_range=(0.22, 0.32)),
            _DISTRACTOR,
        ),
        moves=(PickPlace(subject='a', reference='b', rest='on'),),
        succeeds=is_true.all_of(is_true.is_served('a', 'b')),
    )


_ALL = (
    _collect('bussing_table', 'clear the table: put the {a} and the {b} into the {c}',
             ('cup', 'bread', 'corn'), 'bin'),
    _collect('collect_food', 'collect the {a} and the {b} in the {c}', _FOOD, 'basket'),
    _collect('collect_tableware', 'put the {a} and the {b} on the {c}', ('cup',), 'tray'),
    _collect('collect_toy', 'put the {a} and the {b} away into the {c}', _TOYS, 'basket'),
    Task(
        name='move_stack_block_ab',
        instruction='move the {a} to the middle and stack the {b} on it',
        roles=(
            ObjectRole(role='a', x_range=(-0.21, -0.15), y_range=(0.2, 0.33)),
            ObjectRole(role='b', x_range=(0.12, 0.21), y_range=(0.2, 0.33)),
            _DISTRACTOR,
        ),
        moves=(
            PickPlace(subject='a', reference=TABLE, offset=(0.0, 0.225), spread=(0.02, 0.015)),
            PickPlace(subject='b', reference='a', rest='on'),
        ),
        succeeds=is_true.all_of(is_true.is_stacked('b', 'a'), is_true.has_moved('a')),
        mirrored=True,
    ),
    Task(
        name='move_stack_plate',
        instruction='stack the {a} on the {b}',
        roles=(
            ObjectRole(role='a', shapes=('plate',), y_range=(0.22, 0.3)),
            ObjectRole(role='b', shapes=('plate',), y_range=(0.22, 0.3)),
        ),
        moves=(PickPlace(subject='a', reference='b', rest='on'),),
        succeeds=is_true.all_of(is_true.are_plates_stacked('a', 'b')),
    ),
    Task(
        name='move_object_two',
        instruction='move the {a} and the {b} towards the robot',
        roles=tuple(
            ObjectRole(role=role, shapes=('block', 'cup', 'car', 'bread', 'bowl'), x_range=x_range,
                       y_range=(0.29, 0.35))
            for role, x_range in (('a', (-0.2, -0.07)), ('b', (0.07, 0.2)))
        ),
        moves=tuple(PickPlace(subject=role, reference=START, offset=(0, -0.1)) for role in 'ab'),
        succeeds=is_true.all_of(is_true.is_at_goal(0, 'a'), is_true.is_at_goal(1, 'b')),
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
        instruction='shake the {a}',
        roles=(
            ObjectRole(role='a', shapes=('bottle',), x_range=(-0.2, -0.05), y_range=(0.23, 0.29)),
            ObjectRole(role='b', shapes=('block', 'cup')),
            _DISTRACTOR,
        ),
        moves=(Shake(subject='a'),),
        succeeds=is_true.is_shaken('a'),
        mirrored=True,
    ),
    Task(
        name='stack_blocks_two',
        instruction='stack the {a} on the {b}',
        roles=_TWO_BLOCKS,
        moves=(PickPlace(subject='a', reference='b', rest='on'),),
        succeeds=is_true.all_of(is_true.is_stacked('a', 'b')),
    ),
    Task(
        name='random_pick_place',
        instruction='pick up the {a} and put it down somewhere else',
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
        succeeds=is_true.all_of(is_true.is_at_goal(0, 'a')),
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
