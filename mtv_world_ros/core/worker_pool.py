"""Jobs of a command: run in worker processes or on a Ray cluster, and which results are kept."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
import importlib
import multiprocessing
from multiprocessing import resource_tracker
import os
from pathlib import Path
import signal
import tempfile
import threading
import time
from typing import Any, Protocol, TypeVar

from tqdm import tqdm

from mtv_world_ros.core.errors import ConfigError, MtvWorldError
from mtv_world_ros.core.files import plain
from mtv_world_ros.core.processes import STOPPED_S, StoppedProcesses

#: between two looks of a pool at its workers, and of a worker at its parent [s]
_LOOK_S = 0.5
#: a job that was running when this many actors of a Ray cluster died is not tried again
MAX_LOST_ACTORS = 3
#: variable that keeps a cluster which Ray starts by itself on the loopback address, if it is 0; by
#: itself Ray does so on Windows and macOS alone
_RAY_NETWORK = 'RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER'
#: libraries that start threads read these when they are loaded
_THREAD_VARIABLES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')

#: scores as plain values, or why there are none
Outcome = dict[str, Any] | str
#: runs one job
Run = Callable[..., Any]
Job = TypeVar('Job')
#: of this process, if it is a worker
_run: Run | None = None


class Scores(Protocol):
    """Result of a job, or the reason why it failed."""

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        ...


class Scorer(Protocol):
    """Scores one job after the other."""

    def score(self, job: Any) -> Scores:
        """Return a job's scores; raise MtvWorldError where there are none."""
        ...


def run_all(
    jobs: Sequence[Job], make_run: Callable[[], Run], workers: int, threads: int = 1
) -> Iterator[tuple[Job, Any]]:
    """Yield jobs with their result, in the order in which they are done.

    Workers are spawned, not forked, since the threads of torch and OpenCV do not survive a fork.
    They end with this process, however that ends.

    Args:
        jobs: arguments of the function, one a call.
        make_run: returns the function that runs a job; called once in every process; has to be
            picklable for more than one.
        workers: processes; 1 = this one.
        threads: threads of each process, where there are several.

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
    pool = WorkerPool(make_run, workers, threads)
    try:
        with _environment(dict.fromkeys(_THREAD_VARIABLES, str(threads))):
            futures = {pool.submit(run_job, job): job for job in jobs}
        for future in as_completed(futures):
            yield futures[future], future.result()
    except (KeyboardInterrupt, GeneratorExit):
        pool.kill()  # a job may take minutes; what is half done is done again
        raise
    except BrokenProcessPool as error:
        raise MtvWorldError(
            f'one of {workers} workers died, most likely of lack of memory (one that is stopped '
            f'for {STOPPED_S:g} s is ended, too); what is done is kept: run the command again, '
            'with fewer --workers'
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


class WorkerPool(ProcessPoolExecutor):
    """Processes whose `run_job` runs jobs; they end with this process, however that ends.

    A stopped process (SIGSTOP) is killed: the pool breaks, and no call waits any longer. A process
    that ignores the SIGTERM of a broken pool, e.g. with a forked signal handler, is killed, too.

    Args:
        make_run: factory of the function that runs a job, called once in every process.
        workers: number of processes.
        threads: number of OpenCV's threads in each process.
        method: start method, `spawn` or `fork`; `fork` copies and pickles nothing.
    """

    def __init__(
        self, make_run: Callable[[], Run], workers: int, threads: int = 1, method: str = 'spawn'
    ) -> None:
        arguments = (make_run, threads, os.getpid())
        super().__init__(workers, multiprocessing.get_context(method), _start_worker, arguments)
        self._closed = threading.Event()
        threading.Thread(target=self._kill_stopped, daemon=True).start()

    def submit(self, *job: Any, **options: Any) -> Future[Any]:
        """Start processes; a Ctrl-C is held back until each ignores it."""
        resource_tracker.ensure_running()  # which lets SIGINT through
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return super().submit(*job, **options)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def kill(self) -> None:
        """End the processes in the middle of a job."""
        for worker in list((self._processes or {}).values()):
            worker.kill()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes."""
        super().shutdown(wait, cancel_futures=cancel_futures)
        self._closed.set()

    def _kill_stopped(self) -> None:
        stopped, broken_s = StoppedProcesses(), float('inf')
        while not self._closed.wait(_LOOK_S):
            workers = dict(self._processes or {})
            found = stopped.find(workers)
            if self._broken:
                broken_s = min(broken_s, time.monotonic())
            for pid, worker in workers.items():
                if pid == found or time.monotonic() > broken_s + STOPPED_S:
                    worker.kill()


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Yield the environment variables as processes that start within it see them."""
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


def _start_worker(make_run: Callable[[], Run], threads: int, parent: int) -> None:
    """Prepare a worker; an error is raised by every job."""
    global _run
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops the pool
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    import cv2

    # 1 would wait for threads that a fork left behind; 0 is one thread, too
    cv2.setNumThreads(threads if threads > 1 else 0)
    try:
        _run = make_run()
    except MtvWorldError as error:
        _run = _raising(error)


def _end_with(parent: int) -> None:
    """End with the parent: a killed command must not go on writing, it may be started again."""
    while os.getppid() == parent:
        time.sleep(_LOOK_S)
    os._exit(1)


def _raising(error: MtvWorldError) -> Run:
    def run(job: Any) -> Any:
        raise error

    return run


def run_job(*job: Any) -> Any:
    """Run a job in a worker of a `WorkerPool`."""
    assert _run is not None
    return _run(*job)


class _Scoring:
    """Runs a scorer; a job without scores gives the reason.

    Args:
        make_scorer: returns the scorer.
        is_late: whether an error of `make_scorer` is the outcome of every job, as in a worker
            process; False = it is raised at once.
    """

    def __init__(self, make_scorer: Callable[[], Scorer], is_late: bool = True) -> None:
        try:
            self._score: Run = make_scorer().score
        except MtvWorldError as error:
            if not is_late:
                raise
            self._score = _raising(error)

    def __call__(self, job: Any) -> Outcome:
        try:
            return plain(self._score(job).as_json())
        except MtvWorldError as error:
            return str(error)

    def start(self) -> None:
        """Return when this process is there and has its scorer."""

    def numbered(self, number: int, job: Any) -> tuple[int, Outcome]:
        return number, self(job)


def score_all(
    jobs: Sequence[Job], make_scorer: Callable[[], Scorer], workers: int, threads: int
) -> Iterator[tuple[Job, Outcome]]:
    """Yield jobs with their scores, or why there are none; see `run_all`.

    Args:
        jobs: jobs to score, in any order.
        make_scorer: returns the scorer; called once in every process; has to be picklable for more
            than one.
        workers: processes; 1 = this one.
        threads: threads of each process, where there are several.
    """
    several = workers > 1 and len(jobs) > 1
    make_run = partial(_Scoring, make_scorer, is_late=several)
    yield from run_all(jobs, make_run, workers, threads)


def score_with_ray(
    jobs: Sequence[Job], make_scorer: Callable[[], Scorer], workers: int, address: str = ''
) -> Iterator[tuple[Job, Outcome]]:
    """Yield jobs with their scores, or why there are none, from actors of a Ray cluster.

    Every machine of the cluster needs this package, and checkpoints under the same path.

    Args:
        jobs: jobs to score, in any order.
        make_scorer: returns the scorer; called once in every actor; has to be picklable.
        workers: actors, of one core each.
        address: address of the cluster; empty = `RAY_ADDRESS`, else a new one on this machine.

    Raises:
        ConfigError: Ray is not installed or cannot be reached, or less than one worker.
        MtvWorldError: all actors died, or several of the same job.
    """
    if workers < 1:
        raise ConfigError(f'workers is {workers}; it must be at least 1')
    if not address and not _is_ray_at_hand():
        os.environ.setdefault(_RAY_NETWORK, '0')
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
        actor = ray.remote(num_cpus=1)(_Scoring)
        actors = [actor.remote(make_scorer) for _ in range(min(workers, len(jobs)))]
        yield from _Actors(ray, actors).run(jobs)
    except ray.exceptions.RayError as error:
        raise MtvWorldError(
            f'Ray failed ({error}); what is done is kept: run the command again'
        ) from error
    finally:
        ray.shutdown()


class _Actors:
    """Actors of a Ray cluster that run jobs; the job of one that dies goes to another.

    An actor gets its first job when it has started: a cluster with fewer cores than actors starts
    the others later, or never.
    """

    def __init__(self, ray: Any, actors: Sequence[Any]) -> None:
        self._ray, self._num_left = ray, len(actors)
        #: what an actor is at: its job's number and the job; None = it starts
        self._calls: dict[Any, tuple[Any, tuple[int, Any] | None]] = {
            actor.start.remote(): (actor, None) for actor in actors
        }
        self._lost: Counter[int] = Counter()

    def run(self, jobs: Sequence[Job]) -> Iterator[tuple[Job, Outcome]]:
        """Yield jobs with their outcome.

        Raises:
            MtvWorldError: no actor is left, or MAX_LOST_ACTORS actors died of one job.
        """
        waiting, num_running, idle = deque(enumerate(jobs)), 0, list[Any]()
        while waiting or num_running:
            while waiting and idle:
                actor, one = idle.pop(), waiting.popleft()
                self._calls[actor.numbered.remote(*one)] = actor, one
                num_running += 1
            (done,), _ = self._ray.wait(list(self._calls))
            actor, one = self._calls.pop(done)
            num_running -= one is not None
            try:
                found = self._ray.get(done)
            except self._ray.exceptions.RayActorError as error:
                self._lose(one, error)
                waiting.extendleft([] if one is None else [one])
                continue
            idle.append(actor)
            if one is not None:
                yield one[1], found[1]

    def _lose(self, one: tuple[int, Any] | None, error: Exception) -> None:
        """Count an actor that died, and say so."""
        self._num_left -= 1
        if one is not None:
            self._lost[one[0]] += 1
        if one is not None and self._lost[one[0]] == MAX_LOST_ACTORS:
            raise MtvWorldError(
                f'{MAX_LOST_ACTORS} Ray workers died of the same job ({error}), most likely of '
                'lack of memory; what is done is kept: run the command again'
            ) from error
        if not self._num_left:
            raise MtvWorldError(
                f'all Ray workers died ({error}); what is done is kept: run the command again'
            ) from error
        tqdm.write(f'a Ray worker died; {self._num_left} go on')


def _is_ray_at_hand() -> bool:
    """True if Ray would use a running cluster: that of `RAY_ADDRESS`, or the last one here."""
    folder = Path(os.environ.get('RAY_TMPDIR') or tempfile.gettempdir())
    return 'RAY_ADDRESS' in os.environ or (folder / 'ray' / 'ray_current_cluster').is_file()


def _ray() -> Any:
    """Import Ray, which is optional and large."""
    try:
        ray = importlib.import_module('ray')
        importlib.import_module('ray.util')
    except ImportError as error:
        raise ConfigError(
            "--ray needs Ray: pip install 'mtv_world_ros[rank]', or leave it out and use --workers"
        ) from error
    return ray
