"""Jobs scored one after the other, by several processes at once, or by Ray actors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
import importlib
from multiprocessing import get_context
import os
import signal
from typing import Any, Protocol, TypeVar

from mtv_world_ros.errors import ConfigError, MtvWorldError
from mtv_world_ros.files import plain

#: scores as plain values, or why there are none
Outcome = dict[str, Any] | str
#: libraries that start threads read these when they are loaded
_THREAD_VARIABLES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')

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
_scorer: Scorer | MtvWorldError | None = None


def score_all(
    jobs: Sequence[Job], make_scorer: Callable[[], Scorer], workers: int, threads: int
) -> Iterator[tuple[Job, Outcome]]:
    """Yields jobs with their outcome, as they are done.

    Args:
        jobs: what to score.
        make_scorer: called once in every process; has to be picklable for more than one.
        workers: processes; 1 = this one.
        threads: of each process, where there are several.

    Raises:
        ConfigError: less than one worker.
        MtvWorldError: a worker died.
    """
    if workers < 1:
        raise ConfigError(f'workers is {workers}; it must be at least 1')
    if workers == 1 or len(jobs) < 2:
        yield from _score_here(jobs, make_scorer)
    else:
        yield from _score_in_processes(jobs, make_scorer, min(workers, len(jobs)), threads)


def _score_here(
    jobs: Sequence[Job], make_scorer: Callable[[], Scorer]
) -> Iterator[tuple[Job, Outcome]]:
    scorer = make_scorer() if jobs else None
    for job in jobs:
        assert scorer is not None
        yield job, outcome_of(scorer, job)


def outcome_of(scorer: Scorer, job: Any) -> Outcome:
    """Returns a job's scores as plain values, or why there are none."""
    try:
        return plain(scorer.score(job).as_json())
    except MtvWorldError as error:
        return str(error)


def _score_in_processes(
    jobs: Sequence[Job], make_scorer: Callable[[], Scorer], workers: int, threads: int
) -> Iterator[tuple[Job, Outcome]]:
    # spawned, not forked: torch's and OpenCV's threads do not survive a fork
    pool = ProcessPoolExecutor(
        workers, get_context('spawn'), initializer=_start, initargs=(make_scorer, threads)
    )
    try:
        with _environment(dict.fromkeys(_THREAD_VARIABLES, str(threads))):
            futures = {pool.submit(_score, job): job for job in jobs}
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BrokenProcessPool as error:
        raise MtvWorldError(
            f'one of {workers} workers died, most likely of lack of memory; what was scored is '
            'kept: run the command again, with fewer --workers'
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


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


def _start(make_scorer: Callable[[], Scorer], threads: int) -> None:
    """Prepares a worker; what goes wrong is told by its first job."""
    global _scorer
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops the pool
    import cv2

    cv2.setNumThreads(threads)
    try:
        _scorer = make_scorer()
    except MtvWorldError as error:
        _scorer = error


def _score(job: Any) -> Outcome:
    if isinstance(_scorer, MtvWorldError):
        return str(_scorer)
    assert _scorer is not None
    return outcome_of(_scorer, job)


class _Worker:
    """Lives in an actor; what goes wrong while it starts is told by every job."""

    def __init__(self, make_scorer: Callable[[], Scorer]) -> None:
        self._scorer: Scorer | str
        try:
            self._scorer = make_scorer()
        except MtvWorldError as error:
            self._scorer = str(error)

    def score(self, number: int, job: Any) -> tuple[int, Outcome]:
        if isinstance(self._scorer, str):
            return number, self._scorer
        return number, outcome_of(self._scorer, job)


def score_with_ray(
    jobs: Sequence[Job], make_scorer: Callable[[], Scorer], workers: int, address: str = ''
) -> Iterator[tuple[Job, Outcome]]:
    """Yields jobs with their outcome, as they are done.

    Every machine of the cluster needs this package, and checkpoints under the same path.

    Args:
        jobs: what to score.
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
    try:
        actor = ray.remote(num_cpus=1)(_Worker)
        pool = ray.util.ActorPool([actor.remote(make_scorer) for _ in range(workers)])
        numbered = list(enumerate(jobs))
        for number, outcome in pool.map_unordered(lambda a, one: a.score.remote(*one), numbered):
            yield jobs[number], outcome
    except ray.exceptions.RayError as error:
        raise MtvWorldError(
            f'a Ray worker died ({error}); what was scored is kept: run the command again'
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
