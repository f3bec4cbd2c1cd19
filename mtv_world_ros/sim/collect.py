"""Collects a data set of simulated episodes: seeded, resumable, in parallel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
import json
import multiprocessing
from pathlib import Path
import time
import zlib

import numpy as np
from tqdm import tqdm

from mtv_world_ros.errors import SimulatorError
from mtv_world_ros.geometry.robot_file import load_robot
from mtv_world_ros.resources import share_path
from mtv_world_ros.sim.dataset_card import (
    check_same_set,
    EpisodeEntry,
    read_entry,
    remove_leftovers,
    write_card,
)
from mtv_world_ros.sim.episode import SimEpisode
from mtv_world_ros.sim.expert import Expert, ExpertConfig
from mtv_world_ros.sim.opengl import load_mujoco
from mtv_world_ros.sim.randomize import RandomizationConfig
from mtv_world_ros.sim.record import RecordConfig, simulate, Take, write_take
from mtv_world_ros.sim.tasks import Task, task_named, tasks_named

ROBOT_FILE = ('config', 'robots', 'yam_bimanual.yaml')
#: of every ten episodes of a task, one of even and one of odd index misses (the paper's 8:2)
BLOCK = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class CollectConfig:
    """What is randomised, how the expert moves, how episodes are sampled."""

    randomization: RandomizationConfig = field(default_factory=RandomizationConfig)
    expert: ExpertConfig = field(default_factory=ExpertConfig)
    record: RecordConfig = field(default_factory=RecordConfig)


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One episode to make: task, number within the task, and whether the grasp misses."""

    task: str
    index: int
    seed: int
    miss: bool
    path: Path


@dataclass(frozen=True, slots=True, kw_only=True)
class Spent:
    """CPU time that one episode took, dropped attempts included [s]."""

    physics_s: float
    rendering_s: float
    writing_s: float


def episode_seed(seed: int, task: str, index: int, attempt: int) -> int:
    """Returns the seed of one attempt at an episode; it alone reproduces the scene."""
    entropy = [seed, zlib.crc32(task.encode()), index, attempt]
    return int(np.random.SeedSequence(entropy).generate_state(1)[0])


def misses(seed: int, task: str, index: int) -> bool:
    """Returns whether this episode is one of the two in ten whose grasp misses."""
    block, place = divmod(index, BLOCK)
    entropy = [seed, zlib.crc32(task.encode()), block]
    even, odd = np.random.default_rng(entropy).integers(0, BLOCK // 2, 2)
    return place in (2 * even, 2 * odd + 1)


def jobs_of(tasks: Sequence[Task], num_episodes: int, seed: int, out: Path) -> list[Job]:
    """Returns the episodes of a data set; tasks take turns, so a growing set stays mixed."""
    return [
        Job(
            task=task.name,
            index=index,
            seed=seed,
            miss=misses(seed, task.name, index),
            path=out / f'{task.name}_{index:05d}',
        )
        for index in range(num_episodes)
        for task in tasks
    ]


class EpisodeMaker:
    """Makes episodes one after the other in one process."""

    def __init__(self, config: CollectConfig) -> None:
        robot = load_robot(share_path(*ROBOT_FILE))
        self._config = config
        self._expert = Expert(robot, config.expert)
        self._sim = SimEpisode(robot, self._expert.home, config.randomization)

    def make(self, job: Job) -> Spent:
        """Simulates attempts until one is as wanted, and writes it.

        Raises:
            SimulatorError: none of `max_attempts` seeds gave the wanted outcome.
        """
        task, record = task_named(job.task), self._config.record
        physics = rendering = 0.0
        for attempt in range(record.max_attempts):
            seed = episode_seed(job.seed, job.task, job.index, attempt)
            try:
                take = simulate(self._sim, self._expert, task, seed, record, miss=job.miss)
            except SimulatorError:
                continue
            physics += take.physics_s
            rendering += take.rendering_s
            if take.is_as_wanted():
                writing = self._write(job, take, seed, attempt)
                return Spent(physics_s=physics, rendering_s=rendering, writing_s=writing)
        raise SimulatorError(
            f"episode {job.index} of task '{job.task}' (seed {job.seed}) was "
            f'{"no clean miss" if job.miss else "no success"} in {record.max_attempts} attempts; '
            'see sim/expert.py'
        )

    def _write(self, job: Job, take: Take, seed: int, attempt: int) -> float:
        started = time.process_time()
        extra = {'attempt': str(attempt), 'index': str(job.index)}
        try:
            write_take(job.path, self._sim, take, seed, self._config.record, **extra)
        except OSError as error:
            raise SimulatorError(
                f"cannot write '{job.path}': {error}; finished episodes are kept, so run the same "
                'command again once there is room'
            ) from error
        return time.process_time() - started


_maker: EpisodeMaker | None = None


def _start_worker(config: CollectConfig) -> None:
    global _maker
    _maker = EpisodeMaker(config)


def _make(job: Job) -> tuple[Job, Spent]:
    assert _maker is not None
    return job, _maker.make(job)


@contextmanager
def _made(
    jobs: list[Job], workers: int, config: CollectConfig
) -> Iterator[Iterator[tuple[Job, Spent]]]:
    """Yields the finished jobs, in any order; spawned processes where more than one works."""
    if workers == 1:
        _start_worker(config)
        yield map(_make, jobs)
        return
    context = multiprocessing.get_context('spawn')
    with context.Pool(workers, _start_worker, (config,)) as pool:
        yield pool.imap_unordered(_make, jobs)


def collect(
    tasks: str | Sequence[str],
    num_episodes: int,
    seed: int,
    out: Path | str,
    *,
    workers: int = 1,
    config: CollectConfig | None = None,
    progress: bool = True,
) -> list[EpisodeEntry]:
    """Makes the missing episodes of a data set and writes its card, `dataset.json`.

    The same arguments give the same episodes, whatever the number of workers; episodes that
    are there already are kept, so an interrupted run is continued by starting it again.

    Args:
        tasks: names, comma-separated names, or `all`.
        num_episodes: episodes per task.
        seed: of the data set.
        out: folder of the data set; one episode folder appears in it at a time.
        workers: processes.
        config: what is randomised and how it is sampled.
        progress: show a progress bar.

    Returns:
        The entries of all episodes of the set.

    Raises:
        SimulatorError: unknown task, no OpenGL library, or `out` holds another set.
    """
    chosen = tasks_named(tasks if isinstance(tasks, str) else ','.join(tasks))
    if num_episodes < 1 or workers < 1:
        raise SimulatorError(
            f'episodes is {num_episodes} and workers is {workers}; both must be at least 1'
        )
    load_mujoco()
    out, config = Path(out), config or CollectConfig()
    out.mkdir(parents=True, exist_ok=True)
    described = json.loads(json.dumps(asdict(config)))
    check_same_set(out, seed, described)
    remove_leftovers(out)
    jobs = jobs_of(chosen, num_episodes, seed, out)
    entries = {job.path.name: read_entry(job.path) for job in jobs if job.path.exists()}
    missing = [job for job in jobs if job.path.name not in entries]
    write_card(out, seed, described, entries.values())
    with (
        tqdm(total=len(jobs), initial=len(entries), unit='ep', disable=not progress) as bar,
        _made(missing, min(workers, max(1, len(missing))), config) as made,
    ):
        for job, _ in made:
            entries[job.path.name] = read_entry(job.path)
            bar.update()
            if len(entries) % 20 == 0:
                write_card(out, seed, described, entries.values())
    write_card(out, seed, described, entries.values())
    return [entries[job.path.name] for job in jobs]
