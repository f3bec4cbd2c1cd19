"""Executor of a command's jobs: this process, worker processes, or actors of a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

from mtv_world_ros.core.errors import ConfigError, MtvWorldError
from mtv_world_ros.core.files import plain
from mtv_world_ros.core.processes import STOPPED_S, threads_each
from mtv_world_ros.core.worker_pool import raising, Run, run_job, thread_limit, WorkerPool

#: scores as plain values, or why there are none
Outcome = dict[str, Any] | str
Job = TypeVar('Job')
#: runs jobs, and yields each with its result when it is done
RunJobs = Callable[[Sequence[Job]], Iterator[tuple[Job, Any]]]


class Scores(Protocol):
    """Result of a job, or the reason why it failed."""

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        ...


class Scorer(Protocol):
    """Scores one job after the other."""

    @property
    def score(self) -> Callable[[Any], Scores]:
        """Function that returns a job's scores; it raises MtvWorldError where there are none."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Workers:
    """Workers of a command: processes of this machine, or actors of a Ray cluster.

    Attributes:
        count: number of workers, i.e. of jobs that run at once; 1 without Ray = this process.
        threads: CPU threads of each worker; 0 = with Ray `cpus`, else the cores shared evenly.
        ray: address of a Ray cluster; empty = `RAY_ADDRESS`, else a new one on this machine;
            None = no Ray.
        cpus: CPU cores that Ray reserves for a worker.
        gpus: GPUs that Ray reserves for a worker; 0.5 = two workers share one.
        reads: files and folders that jobs read; every machine of the cluster must have them.
        writes: folder that jobs write to; every machine of the cluster must see the same one.
            None = results come back to this process.
    """

    count: int = 1
    threads: int = 0
    ray: str | None = None
    cpus: int = 1
    gpus: float = 0.0
    reads: tuple[Path, ...] = ()
    writes: Path | None = None

    @property
    def are_here(self) -> bool:
        """Whether this process runs the jobs itself."""
        return self.count == 1 and self.ray is None

    @property
    def num_threads(self) -> int:
        """Number of CPU threads of each worker."""
        if self.threads:
            return self.threads
        return threads_each(self.count) if self.ray is None else max(self.cpus, 1)


#: this process runs the jobs itself, on one thread
IN_PROCESS = Workers(threads=1)


def run_all(
    jobs: Sequence[Job], make_run: Callable[[], Run], workers: Workers
) -> Iterator[tuple[Job, Any]]:
    """Yield jobs with their result, in the order in which they are done; see `started`."""
    with started(make_run, workers, len(jobs)) as run:
        yield from run(jobs)


@contextmanager
def started(make_run: Callable[[], Run], workers: Workers, num_jobs: int) -> Iterator[RunJobs]:
    """Yield a function that runs jobs on workers, which stay for the whole block.

    Processes are spawned, not forked, since the threads of torch and OpenCV do not survive a fork.
    They end with this process, however that ends. A job whose Ray worker dies goes to another one.

    Args:
        make_run: returns the function that runs a job; called once in every worker; has to be
            picklable unless this process runs the jobs.
        workers: where the jobs run.
        num_jobs: largest number of jobs of one call; no more workers are started.

    Raises:
        ConfigError: less than one worker; see also `ray_actors.started`.
        MtvWorldError: a process died, or what a job raised.
    """
    if workers.count < 1:
        raise ConfigError(f'workers is {workers.count}; it must be at least 1')
    if not num_jobs:
        yield lambda jobs: iter(())
    elif workers.ray is not None:
        from mtv_world_ros.core import ray_actors

        with ray_actors.started(make_run, workers, num_jobs) as run:
            yield run
    elif workers.count > 1 and num_jobs > 1:
        with _pool(make_run, min(workers.count, num_jobs), workers.num_threads) as run:
            yield run
    else:
        here = make_run()
        yield lambda jobs: ((job, here(job)) for job in jobs)


@contextmanager
def _pool(make_run: Callable[[], Run], count: int, threads: int) -> Iterator[RunJobs]:
    pool = WorkerPool(make_run, count, threads)

    def run(jobs: Sequence[Job]) -> Iterator[tuple[Job, Any]]:
        with thread_limit(threads):
            futures = {pool.submit(run_job, job): job for job in jobs}
        for future in as_completed(futures):
            yield futures[future], future.result()

    try:
        yield run
    except (KeyboardInterrupt, GeneratorExit):
        pool.kill()  # a job may take minutes; what is half done is done again
        raise
    except BrokenProcessPool as error:
        raise MtvWorldError(
            f'one of {count} workers died, most likely of lack of memory (one that is stopped '
            f'for {STOPPED_S:g} s is ended, too); what is done is kept: run the command again, '
            'with fewer --workers'
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


class _Scoring:
    """Runs a scorer; a job without scores gives the reason.

    Args:
        make_scorer: returns the scorer.
        is_late: whether an error of `make_scorer` is the outcome of every job, as in a worker;
            False = it is raised at once.
    """

    def __init__(self, make_scorer: Callable[[], Scorer], is_late: bool = True) -> None:
        try:
            self._score: Run = make_scorer().score
        except MtvWorldError as error:
            if not is_late:
                raise
            self._score = raising(error)

    def __call__(self, job: Any) -> Outcome:
        try:
            return plain(self._score(job).as_json())
        except MtvWorldError as error:
            return str(error)


def score_all(
    jobs: Sequence[Job], make_scorer: Callable[[], Scorer], workers: Workers
) -> Iterator[tuple[Job, Outcome]]:
    """Yield jobs with their scores, or why there are none; see `started`.

    Args:
        jobs: jobs to score, in any order.
        make_scorer: returns the scorer; called once in every worker; has to be picklable unless
            this process runs the jobs.
        workers: where the jobs run.
    """
    several = workers.ray is not None or (workers.count > 1 and len(jobs) > 1)
    make_run = partial(_Scoring, make_scorer, is_late=several)
    yield from run_all(jobs, make_run, workers)
