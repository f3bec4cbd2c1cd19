"""Executor of a command's jobs: this process, worker processes, or actors of a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from typing import Any, Protocol, TypeVar

from mtv_world_ros.core.errors import ConfigError, MtvWorldError
from mtv_world_ros.core.files import plain
from mtv_world_ros.core.processes import STOPPED_S
from mtv_world_ros.core.worker_pool import raising, Run, run_job, thread_limit, WorkerPool
from mtv_world_ros.core.workers import RunJobs, Workers

#: scores as plain values, or why there are none
Outcome = dict[str, Any] | str
Job = TypeVar('Job')


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
