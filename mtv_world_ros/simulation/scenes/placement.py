"""Feasible placements: objects and goals apart from each other and within the arms' reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mtv_world_ros.simulation.scenes.scene import Place, SceneObject
from mtv_world_ros.simulation.scenes.shapes import RIM_M, SHAPES
from mtv_world_ros.simulation.scenes.tasks import Move, PickPlace, START, Task
from mtv_world_ros.simulation.scenes.workcell import PlacementConfig, Workcell
from mtv_world_ros.success.relations import FLOOR_M


def side_of(subject: SceneObject) -> float:
    """Return on which side of the table's middle line an object lies: -1 left, 1 right."""
    return -1.0 if subject.position[0] < 0 else 1.0


def _plane(a: Sequence[float], b: Sequence[float]) -> float:
    return float(np.hypot(a[0] - b[0], a[1] - b[1]))


def _gap(a: SceneObject, b: SceneObject) -> float:
    """Return the gap between the circles around two objects' longer halves [m]."""
    return _plane(a.position, b.position) - (max(a.size[:2]) + max(b.size[:2])) / 2


def _fits(subject: SceneObject, under: SceneObject) -> bool:
    return max(subject.size[:2]) < min(under.size[:2]) - 2 * RIM_M


def goal_of(move: Move, items: dict[str, SceneObject], shift: tuple[float, float]) -> Place:
    """Return where a move's subject comes to rest, centre [m].

    Args:
        move: the expert's move.
        items: role -> object where it is before the move.
        shift: drawn shift of the goal in x and y, as a share (-1..1) of its spread.
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
    """Return the goal of each of a task's moves, one after the other."""
    now, goals = dict(items), []
    for move, shift in zip(task.moves, shifts, strict=True):
        goal = goal_of(move, now, shift)
        now[move.subject] = replace(now[move.subject], position=goal)
        goals.append(goal)
    return tuple(goals)


def is_feasible(
    task: Task,
    items: dict[str, SceneObject],
    goals: tuple[Place, ...],
    config: PlacementConfig,
    workcell: Workcell,
) -> bool:
    """Return whether objects lie apart, and goals are free and in the arm's reach."""
    listed = list(items.values())
    if any(_gap(a, b) < config.clearance for i, a in enumerate(listed) for b in listed[:i]):
        return False
    now = dict(items)
    for number, (move, goal) in enumerate(zip(task.moves, goals, strict=True)):
        subject = now[move.subject]
        moved, way = replace(subject, position=goal), _plane(subject.position, goal)
        if isinstance(move, PickPlace) and way < move.least:
            return False
        if not _reaches(move, subject, goal, config, workcell):
            return False
        if not _is_free(task, number, moved, now, config):
            return False
        now[move.subject] = moved
    return True


def _reaches(
    move: Move, subject: SceneObject, goal: Place, config: PlacementConfig, workcell: Workcell
) -> bool:
    grasp = SHAPES[subject.shape].grasp
    assert grasp is not None, f'{subject.shape} cannot be grasped'
    shift = grasp.offset(subject.size, side_of(subject))
    base = workcell.bases[workcell.arm_at(subject.position[0])]

    def distance(place: Place) -> float:
        return _plane((place[0] + shift, place[1]), base)

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
    """Return True if the goal is free of objects, except for those that define the goal."""
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
