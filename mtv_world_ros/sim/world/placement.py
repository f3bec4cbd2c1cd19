"""Where objects and goals may lie: apart from each other and in the arms' reach."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mtv_world_ros.sim.shapes import RIM_M, SHAPES
from mtv_world_ros.sim.tasks.tasks import Move, PickPlace, START, Task
from mtv_world_ros.sim.world.arm import BASE_POSITIONS
from mtv_world_ros.sim.world.scene import Place, SceneObject
from mtv_world_ros.success.relations import FLOOR_M


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacementConfig:
    """Limits of a feasible scene.

    Attributes:
        clearance: least gap between the objects' outlines, room for a finger [m].
        reach: how far from an arm's base its tool is sent, top-down, over the table [m].
        reach_above: the same where it is higher, over or in another object [m].
        max_x: goals are at most this far from the table's middle line, in all views [m].
    """

    clearance: float = 0.06
    reach: float = 0.4
    reach_above: float = 0.375
    max_x: float = 0.23


def arm_of(subject: SceneObject) -> str:
    """Returns the arm that handles an object: the one on its side of the table."""
    return 'left' if subject.position[0] < 0 else 'right'


def _plane(a: Place, b: Place) -> float:
    return float(np.hypot(a[0] - b[0], a[1] - b[1]))


def _gap(a: SceneObject, b: SceneObject) -> float:
    """Gap between the circles around two objects' longer halves [m]."""
    return _plane(a.position, b.position) - (max(a.size[:2]) + max(b.size[:2])) / 2


def _fits(subject: SceneObject, under: SceneObject) -> bool:
    return max(subject.size[:2]) < min(under.size[:2]) - 2 * RIM_M


def goal_of(move: Move, items: dict[str, SceneObject], shift: tuple[float, float]) -> Place:
    """Returns where a move's subject comes to rest, centre [m].

    Args:
        move: what the expert does.
        items: role -> object where it is before the move.
        shift: drawn share (-1..1) of the goal's spread in x and y.
    """
    subject = items[move.subject]
    if not isinstance(move, PickPlace):
        return subject.position
    half, anchor, floor = subject.size[2] / 2, (0.0, 0.0), 0.0
    if move.reference == START:
        anchor = subject.position[:2]
    elif move.reference in items:
        under = items[move.reference]
        anchor = under.position[:2]
        if move.rest != 'table':
            goes_in = SHAPES[under.shape].hollow and _fits(subject, under)
            bottom = under.position[2] - under.size[2] / 2
            floor = bottom + (FLOOR_M if goes_in else under.size[2])
    x, y = (anchor[i] + move.offset[i] + shift[i] * move.spread[i] for i in range(2))
    return (x, y, floor + half)


def goals_of(
    task: Task, items: dict[str, SceneObject], shifts: list[tuple[float, float]]
) -> tuple[Place, ...]:
    """Returns the goal of each of a task's moves, one after the other."""
    now, goals = dict(items), []
    for move, shift in zip(task.moves, shifts, strict=True):
        goal = goal_of(move, now, shift)
        now[move.subject] = replace(now[move.subject], position=goal)
        goals.append(goal)
    return tuple(goals)


def is_feasible(
    task: Task, items: dict[str, SceneObject], goals: tuple[Place, ...], config: PlacementConfig
) -> bool:
    """Returns whether objects lie apart, and goals are free and in the arm's reach."""
    listed = list(items.values())
    if any(_gap(a, b) < config.clearance for i, a in enumerate(listed) for b in listed[:i]):
        return False
    now = dict(items)
    for number, (move, goal) in enumerate(zip(task.moves, goals, strict=True)):
        subject = now[move.subject]
        moved, way = replace(subject, position=goal), _plane(subject.position, goal)
        if isinstance(move, PickPlace) and way < move.least:
            return False
        if not _reaches(move, subject, goal, config):
            return False
        if not _is_free(task, number, moved, now, config):
            return False
        now[move.subject] = moved
    return True


def _reaches(move: Move, subject: SceneObject, goal: Place, config: PlacementConfig) -> bool:
    arm = arm_of(subject)
    grasp = SHAPES[subject.shape].grasp
    assert grasp is not None, f'{subject.shape} cannot be grasped'
    shift, base = grasp.offset(subject.size, arm), BASE_POSITIONS[arm]

    def distance(place: Place) -> float:
        return _plane((place[0] + shift, place[1], place[2]), base)

    above = not isinstance(move, PickPlace) or move.rest != 'table'
    limit = config.reach_above if above else config.reach
    within = distance(subject.position) <= config.reach and distance(goal) <= limit
    return within and abs(goal[0]) <= config.max_x


def _is_free(
    task: Task,
    number: int,
    moved: SceneObject,
    now: dict[str, SceneObject],
    config: PlacementConfig,
) -> bool:
    """Nothing is in the way at the goal but what the object is put on, in or with."""
    move = task.moves[number]
    if not isinstance(move, PickPlace):
        return True
    together = {
        earlier.subject
        for earlier in task.moves[:number]
        if isinstance(earlier, PickPlace) and earlier.reference == move.reference
    }
    under = {move.reference} if move.rest != 'table' else set()
    others = [item for role, item in now.items() if role not in {move.subject} | together | under]
    return all(_gap(moved, item) >= config.clearance for item in others)
