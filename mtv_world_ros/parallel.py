"""Runs jobs one after the other, in several processes, or in Ray actors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
import importlib
import multiprocessing
import os
import signal
import threading
from typing import Any, Protocol, TypeVar

from mtv_world_ros.errors import ConfigError, MtvWorldError
from mtv_world_ros.files import plain
from mtv_world_ros.processes import StandStill, STILL_S

#: scores as plain values, or why there are none
Outcome = dict[str, Any] | str
#: runs one job
Run = Callable[[Any], Any]
#: libraries that start threads read these when they are loaded
_THREAD_VARIABLES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')
#: between two looks at the workers of a pool [s]
_LOOK_S = 0.5

Job = TypeVar('Job')


class Scores(Protocol):
    """What a job gives."""

    def as_json(self) -> dict[str, Any]:
        """Returns plain values."""
        ...


class Scorer(Protocol):
    """Scores one job after the other."""

    def score(self, job: Any) -> Scores:
        """Returns a job's scores; raises MtvWorldError where there are none."""
        ...


#: of this process, if it is a worker
_run: Run | None = None


def run_all(
    jobs: Sequence[Job], make_run: Callable[[], Run], workers: int, threads: int = 1
) -> Iterator[tuple[Job, Any]]:
    """Yields jobs with their result, in the order in which they are done.

    Workers are spawned, not forked, since the threads of torch and OpenCV do not survive a fork.
    They end with this process, however that ends.

    Args:
        jobs: arguments of the function, one a call.
        make_run: makes what runs a job, once in every process; has to be picklable for more than
            one.
        workers: processes; 1 = this one.
        threads: of each process, where there are several.

    Raises:
        ConfigError: less than one worker.
        MtvWorldError: a worker died, or what a job raised.
    """
    if workers < 1:
        raise ConfigError(f'workers is {workers}; it must be at least 1')
    if workers > 1 and len(jobs) > 1:
        yield from _in_processes(jobs, make_run, min(workers, len(jobs)), threads)
    elif jobs:
        run = make_run()
        for job in jobs:
            yield job, run(job)


def _in_processes(
    jobs: Sequence[Job], make_run: Callable[[], Run], workers: int, threads: int
) -> Iterator[tuple[Job, Any]]:
    context = multiprocessing.get_context('spawn')
    pool = ProcessPoolExecutor(workers, context, _start_worker, (make_run, threads))
    watch = WorkerWatch(pool)
    try:
        with _environment(dict.fromkeys(_THREAD_VARIABLES, str(threads))):
            futures = {pool.submit(_run_job, job): job for job in jobs}
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BrokenProcessPool as error:
        raise MtvWorldError(
            f'one of {workers} workers died, most likely of lack of memory (one that is stopped '
            f'for {STILL_S:g} s is ended, too); what is done is kept: run the command again, with '
            'fewer --workers'
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        watch.close()


class WorkerWatch:
    """Kills workers of a pool that stand still (SIGSTOP): the pool breaks, and nobody waits on.

    Args:
        pool: whose workers are looked at, until `close`.
    """

    def __init__(self, pool: ProcessPoolExecutor) -> None:
        self._pool, self._closed = pool, threading.Event()
        threading.Thread(target=self._look, daemon=True).start()

    def close(self) -> None:
        """Looks no more."""
        self._closed.set()

    def _look(self) -> None:
        still = StandStill()
        while not self._closed.wait(_LOOK_S):
            found = still.find(list(self._pool._processes or ()))
            if found is not None:
                with suppress(ProcessLookupError):
                    os.kill(found, signal.SIGKILL)


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Environment variables as processes that start within it see them."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _start_worker(make_run: Callable[[], Run], threads: int) -> None:
    """Prepares a worker; an error is raised by every job."""
    global _run
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops the pool
    threading.Thread(target=_end_with_parent, daemon=True).start()
    import cv2

    cv2.setNumThreads(threads)
    try:
        _run = make_run()
    except MtvWorldError as error:
        _run = _raising(error)


def _end_with_parent() -> None:
    """A killed command must not go on writing: the same command may have been started again."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _raising(error: MtvWorldError) -> Run:
    def run(job: Any) -> Any:
        raise error

    return run


def _run_job(job: Any) -> Any:
    assert _run is not None
    return _run(job)


class _Scoring:
    """Runs a scorer, and says why where a job has no scores."""

    def __init__(self, make_scorer: Callable[[], Scorer]) -> None:
        self._score: Callable[[Any], Scores] = make_scorer().score

    def __call__(self, job: Any) -> Outcome:
        try:
            return plain(self._score(job).as_json())
        except MtvWorldError as error:
            return str(error)


class _LateScoring(_Scoring):
    """A scorer of another process; what goes wrong while it is made is told by every job."""

    def __init__(self, make_scorer: Callable[[], Scorer]) -> None:
        try:
            super().__init__(make_scorer)
        except MtvWorldError as error:
            self._score = _raising(error)


def threads_each(workers: int) -> int:
    """Returns the usable cores' share of each of some processes, at least 1."""
    return max(len(os.sched_getaffinity(0)) // max(workers, 1), 1)


def score_all(
    jobs: Sequence[Job], make_scorer: Callable[[], Scorer], workers: int, threads: int
) -> Iterator[tuple[Job, Outcome]]:
    """Yields jobs with their scores, or why there are none; see `run_all`.

    Args:
        jobs: to score, in any order.
        make_scorer: called once in every process; has to be picklable for more than one.
        workers: processes; 1 = this one.
        threads: of each process, where there are several.
    """
    several = workers > 1 and len(jobs) > 1
    make_run = partial(_LateScoring if several else _Scoring, make_scorer)
    yield from run_all(jobs, make_run, workers, threads)


class _RayWorker:
    """Lives in an actor."""

    def __init__(self, make_scorer: Callable[[], Scorer]) -> None:
        self._scoring = _LateScoring(make_scorer)

    def run(self, number: int, job: Any) -> tuple[int, Outcome]:
        return number, self._scoring(job)


def score_with_ray(
    jobs: Sequence[Job], make_scorer: Callable[[], Scorer], workers: int, address: str = ''
) -> Iterator[tuple[Job, Outcome]]:
    """Yields jobs with their scores, or why there are none, from actors of a Ray cluster.

    Every machine of the cluster needs this package, and checkpoints under the same path.

    Args:
        jobs: to score, in any order.
        make_scorer: called once in every actor; has to be picklable.
        workers: actors, of one core each.
        address: of the cluster; empty = `RAY_ADDRESS`, else a new one on this machine.

    Raises:
        ConfigError: Ray is not installed or cannot be reached, or less than one worker.
        MtvWorldError: an actor died.
    """
    if workers < 1:
        raise ConfigError(f'workers is {workers}; it must be at least 1')
    ray = _ray()
    try:
        ray.init(address=address or None, log_to_driver=False, include_dashboard=False)
    except (ConnectionError, ValueError) as error:
        raise ConfigError(f"Ray cannot be reached at '{address}': {error}; set --ray") from error
    except ray.exceptions.AuthenticationError as error:
        raise ConfigError(
            f"the Ray cluster at '{address or 'this machine'}' asks for its token, and there is "
            'none, or another one, here: copy ~/.ray/auth_token of the head node to this user, '
            'or set RAY_AUTH_TOKEN (docs/ray.md)'
        ) from error
    try:
        actor = ray.remote(num_cpus=1)(_RayWorker)
        pool = ray.util.ActorPool([actor.remote(make_scorer) for _ in range(workers)])
        numbered = list(enumerate(jobs))
        for number, outcome in pool.map_unordered(lambda a, one: a.run.remote(*one), numbered):
            yield jobs[number], outcome
    except ray.exceptions.RayError as error:
        raise MtvWorldError(
            f'a Ray worker died ({error}); what is done is kept: run the command again'
        ) from error
    finally:
        ray.shutdown()


def _ray() -> Any:
    """Ray, which is optional and large."""
    try:
        ray = importlib.import_module('ray')
        importlib.import_module('ray.util')
    except ImportError as error:
        raise ConfigError(
            "--ray needs Ray: pip install 'mtv_world_ros[rank]', or leave it out and use --workers"
        ) from error
    return ray
