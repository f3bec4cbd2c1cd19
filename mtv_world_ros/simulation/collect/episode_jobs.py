"""Jobs of a data set: name, seed, and whether the grasp misses, by episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
import zlib

import numpy as np

from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.simulation.scenes.tasks import Task
from mtv_world_ros.simulation.zero_shot import tasks_of

BLOCK = 10
#: of every ten episodes of a task, one of even and one of odd index misses (the paper's 8:2)
NUM_MISSED = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class CollectJob:
    """One episode to make.

    Attributes:
        task: the task.
        index: number within the task, in a zero-shot set within its kind and task.
        seed: the data set's random seed.
        miss: whether the grasp misses.
        path: folder to make.
        zero_shot: `view`, `task` or `object`; None = an ordinary episode.
        policy: name of the scripted policy that acts in place of the expert; empty = the expert.
    """

    task: Task
    index: int
    seed: int
    miss: bool
    path: Path
    zero_shot: str | None = None
    policy: str = ''


def episode_seed(
    seed: int, task: str, index: int, attempt: int, zero_shot: str | None = None
) -> int:
    """Return the seed of one attempt at an episode; it alone reproduces the scene."""
    entropy = [seed, _number(task, zero_shot), index, attempt]
    return int(np.random.SeedSequence(entropy).generate_state(1)[0])


def misses_grasp(
    seed: int, task: str, index: int, zero_shot: str | None = None, num_of_ten: int = NUM_MISSED
) -> bool:
    """Return whether this episode is one of the `num_of_ten` whose grasp misses."""
    block, place = divmod(index, BLOCK)
    rng = np.random.default_rng([seed, _number(task, zero_shot), block])
    if num_of_ten == NUM_MISSED:
        even, odd = rng.integers(0, BLOCK // 2, NUM_MISSED)
        return place in (2 * even, 2 * odd + 1)
    return place in rng.permutation(BLOCK)[:num_of_ten]


def _number(task: str, zero_shot: str | None) -> int:
    return zlib.crc32((task if zero_shot is None else f'{zero_shot}:{task}').encode())


def jobs_of(
    tasks: Sequence[Task],
    num_episodes: int,
    seed: int,
    out: Path,
    num_of_ten: int = NUM_MISSED,
    policies: Sequence[str] = (),
) -> list[CollectJob]:
    """Return `num_episodes` of each task; tasks take turns, so a growing set stays mixed.

    Args:
        tasks: the tasks to carry out.
        num_episodes: number of episodes of each.
        seed: the data set's random seed.
        out: folder of the data set.
        num_of_ten: number of grasps of the expert in ten that miss.
        policies: scripted policies that take turns in every task, where each task begins further
            down the list, so that many policies all come up in few episodes; none = the expert.

    Raises:
        SimulatorError: not 0 to 10 of ten episodes are to miss.
    """
    if not 0 <= num_of_ten <= BLOCK:
        raise SimulatorError(
            f'{num_of_ten} of {BLOCK} episodes are to miss; set --failures-of-ten to 0 ... {BLOCK}'
        )
    jobs = [
        _job(task, index, seed, out, num_of_ten=num_of_ten)
        for index in range(num_episodes)
        for task in tasks
    ]
    if not policies:
        return jobs
    count = len(policies)
    first = {task.name: number * count // len(tasks) for number, task in enumerate(tasks)}
    turns = [policies[(first[job.task.name] + job.index) % count] for job in jobs]
    return [replace(job, miss=False, policy=turn) for job, turn in zip(jobs, turns, strict=True)]


def zero_shot_jobs(
    kinds: Sequence[str], tasks: Sequence[Task], num_episodes: int, seed: int, out: Path
) -> list[CollectJob]:
    """Return `num_episodes` in all; kinds take turns, and within a kind its tasks do."""
    chosen = {kind: tasks_of(kind, tasks) for kind in kinds}
    jobs = []
    for number in range(num_episodes):
        turn, kind = number // len(kinds), kinds[number % len(kinds)]
        index, place = divmod(turn, len(chosen[kind]))
        jobs.append(_job(chosen[kind][place], index, seed, out, kind))
    return jobs


def _job(
    task: Task,
    index: int,
    seed: int,
    out: Path,
    kind: str | None = None,
    num_of_ten: int = NUM_MISSED,
) -> CollectJob:
    name = f'{task.name}_{index:05d}'
    return CollectJob(
        task=task,
        index=index,
        seed=seed,
        miss=misses_grasp(seed, task.name, index, kind, num_of_ten),
        path=out / (name if kind is None else f'{kind}_{name}'),
        zero_shot=kind,
    )
