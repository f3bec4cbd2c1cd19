"""Zero-shot sets: episodes from new cameras, of an unseen task, with unseen objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.simulation.scenes.cameras import CameraMoves, moved_camera
from mtv_world_ros.simulation.scenes.randomize import RandomizationConfig
from mtv_world_ros.simulation.scenes.shapes import SHAPES
from mtv_world_ros.simulation.scenes.tasks import (
    ANY_SIZE,
    ObjectRole,
    PickPlace,
    Shake,
    Task,
    task_named,
)

#: kinds of novelty: cameras, task or objects (paper, "Zero-Shot Ability")
KINDS = ('view', 'task', 'object')
UNSEEN_TASK = 'random_pick_place'
#: shapes that no task asks for
UNSEEN_SHAPES = ('can', 'house')


def kinds_named(text: str | Sequence[str]) -> tuple[str, ...]:
    """Return the kinds of a comma-separated list, or of a sequence; each one once.

    Raises:
        SimulatorError: unknown kind; the text names the nearest known one.
    """
    names = text.split(',') if isinstance(text, str) else text
    kinds = tuple(dict.fromkeys(name.strip() for name in names if name.strip()))
    for kind in kinds:
        if kind not in KINDS:
            raise SimulatorError.unknown(
                'unknown zero-shot set',
                kind,
                KINDS,
                listed='; known are',
                advice='; set --zero-shot',
            )
    return kinds


def tasks_of(kind: str, tasks: Sequence[Task]) -> tuple[Task, ...]:
    """Return the tasks that a zero-shot set is made of, out of the chosen ones.

    Raises:
        SimulatorError: none of the chosen tasks can show unseen objects.
    """
    if kind == 'task':
        return (task_named(UNSEEN_TASK),)
    if kind == 'view':
        return tuple(tasks)
    usable = tuple(task for task in tasks if _exchangeable(task))
    if not usable:
        raise SimulatorError(
            f'no object of {", ".join(task.name for task in tasks)} can be exchanged for an '
            'unseen one; set --task all, or leave object out of --zero-shot'
        )
    return usable


def variant(
    kind: str | None,
    task: Task,
    seed: int,
    randomization: RandomizationConfig,
    moves: CameraMoves,
) -> tuple[Task, RandomizationConfig]:
    """Return the task and the randomisation of one episode; as given where `kind` is None.

    Args:
        kind: kind of the zero-shot set, one of `KINDS`; None = an ordinary set.
        task: the task it is derived from.
        seed: the episode's random seed.
        randomization: the randomisation of training.
        moves: distance of the cameras of `view` from those of training.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2,)))
    if kind == 'view':
        return task, with_moved_cameras(randomization, moves, rng)
    if kind == 'object':
        return _with_unseen_objects(task, rng), randomization
    return task, randomization


def with_moved_cameras(
    randomization: RandomizationConfig, moves: CameraMoves, rng: np.random.Generator
) -> RandomizationConfig:
    """Return the randomisation with every fixed camera moved; its cameras must be known."""
    cameras = tuple(moved_camera(spec, moves, rng) for spec in randomization.cameras or ())
    return replace(randomization, cameras=cameras)


def _movable(task: Task) -> tuple[ObjectRole, ...]:
    """Return the roles that are always present and can be grasped, so not trays and baskets."""
    return tuple(
        role
        for role in task.roles
        if role.probability == 1 and all(SHAPES[shape].grasp for shape in role.shapes)
    )


def _exchangeable(task: Task) -> tuple[str, ...]:
    """Return the roles that any graspable object can have.

    Not what carries something, is shaken or is a plate, nor what has to be of a certain size.
    """
    carriers = {
        move.reference
        for move in task.moves
        if isinstance(move, PickPlace) and move.rest != 'table'
    }
    shaken = {move.subject for move in task.moves if isinstance(move, Shake)}
    return tuple(
        role.role
        for role in _movable(task)
        if role.role not in carriers | shaken
        and 'plate' not in role.shapes
        and role.size_share == ANY_SIZE
    )


def _with_unseen_objects(task: Task, rng: np.random.Generator) -> Task:
    """Give half of the movable objects (rounded at random) shapes that training never shows."""
    roles, usable = _movable(task), _exchangeable(task)
    half = (len(roles) + int(rng.integers(2)) * (len(roles) % 2)) // 2
    chosen = set(rng.permutation(usable)[:half].tolist())
    return replace(
        task,
        roles=tuple(
            role.replace(shapes=UNSEEN_SHAPES) if role.role in chosen else role
            for role in task.roles
            if role.probability == 1
        ),
    )
