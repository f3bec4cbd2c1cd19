"""Processes: signals that end this one, nodes beside it, workers that run its jobs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
import importlib
import multiprocessing
from multiprocessing import resource_tracker
import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import threading
import time
from types import FrameType
from typing import Any, Protocol, TypeVar

from mtv_world_ros.errors import ConfigError, MtvWorldError

#: a stopped command tidies up for this long [s]
_TIDY_S = 5.0
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
#: tells a node whose child it is: it ends with that process, however that ends
PARENT_VARIABLE = 'MTV_WORLD_PARENT'
_STOP_S = 30.0
#: a process that stands still (SIGSTOP) for longer is given up [s]
STILL_S = 5.0
#: who looks no oftener than this may have stood still as well [s]
_LONGEST_GAP_S = 2.0
#: between two looks of a pool at its workers, and of a worker at its parent [s]
_LOOK_S = 0.5
_TAIL_BYTES = 4000
#: libraries that start threads read these when they are loaded
_THREAD_VARIABLES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')

#: scores as plain values, or why there are none
Outcome = dict[str, Any] | str
#: runs one job
Run = Callable[..., Any]
Job = TypeVar('Job')
#: of this process, if it is a worker
_run: Run | None = None


class Stopped(KeyboardInterrupt):
    """A signal asks the process to stop.

    Attributes:
        signum: its number.
    """

    def __init__(self, signum: int) -> None:
        super().__init__()
        self.signum = signum


class Starting:
    """Ends the process at once on a signal, whatever it imports or makes, until `is_over`.

    Args:
        name: of the program, for the line on stderr.
    """

    def __init__(self, name: str) -> None:
        self._name, self.is_over = name, False

    def __call__(self, signum: int, _: FrameType | None) -> None:
        """Handles the signal."""
        if not self.is_over:
            text = f'{self._name}: stopped while starting ({signal.Signals(signum).name})\n'
            os.write(2, text.encode())
            os._exit(128 + signum)


def end_on_signals(name: str) -> Starting:
    """Lets SIGINT and SIGTERM end this process while it starts; ignored ones stay ignored."""
    starting = Starting(name)
    for number in _SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, starting)
    return starting


@contextmanager
def ended_by_signals(name: str) -> Iterator[None]:
    """Within it SIGINT and SIGTERM end the process, if this is its main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    end_on_signals(name)
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None:  # None: it was not installed from Python
                signal.signal(number, handler)


@contextmanager
def stopped_by_sigterm() -> Iterator[None]:
    """Within it SIGTERM raises `Stopped`, as SIGINT does KeyboardInterrupt: the command tidies up.

    What still tidies up after `_TIDY_S` is ended, and at once at a second SIGTERM. Where SIGTERM
    has a handler, that stays.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return

    timer = threading.Timer(_TIDY_S, _give_up_tidying)
    timer.daemon = True

    def stop(signum: int, _: FrameType | None) -> None:
        signal.signal(signum, signal.SIG_DFL)
        timer.start()
        raise Stopped(signum)

    signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        timer.cancel()
        if signal.getsignal(signal.SIGTERM) is stop:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _give_up_tidying() -> None:
    text = f'mtv-world: stopped (SIGTERM); it was not tidied up within {_TIDY_S:g} s\n'
    os.write(2, text.encode())
    os._exit(128 + signal.SIGTERM)


def private_domain() -> dict[str, str]:
    """The environment with a ROS domain of its own, unless one is set."""
    environment = dict(os.environ)
    environment.setdefault('ROS_DOMAIN_ID', str(random.SystemRandom().randint(1, 100)))
    environment.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    return environment


def module_command(name: str, *arguments: str) -> list[str]:
    """Command that runs a module of `mtv_world_ros.ros`."""
    return [sys.executable, '-m', f'mtv_world_ros.ros.{name}', *arguments]


def ros_arguments(
    parameters: Mapping[str, object], remaps: Mapping[str, str] | None = None
) -> list[str]:
    """Command-line arguments that set parameters (empty texts are left out) and rename topics."""
    flags = ['--ros-args']
    for name, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        flags += ['-p', f'{name}:={text}'] if text else []
    for name, other in (remaps or {}).items():
        flags += ['-r', f'{name}:={other}']
    return flags


def start_process(
    name: str, command: Sequence[str], logs: Path, environment: Mapping[str, str] | None = None
) -> subprocess.Popen[bytes]:
    """Starts a node in a session of its own; it writes to `logs/<name>.log`.

    To be called from the main thread: the node ends with the thread that started it.
    """
    parent = {PARENT_VARIABLE: str(os.getpid())}
    with (logs / f'{name}.log').open('wb') as log:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**(os.environ if environment is None else environment), **parent},
            start_new_session=True,
        )


def last_line(log: Path, otherwise: str) -> str:
    """Returns what a process wrote last into its log; `otherwise` where it wrote nothing."""
    tail = log.read_bytes()[-_TAIL_BYTES:].decode(errors='replace')
    lines = [line.strip() for line in tail.splitlines() if line.strip()]
    return lines[-1] if lines else otherwise


def how_it_ended(name: str, process: subprocess.Popen[bytes], logs: Path) -> str:
    """Returns with which status a process of `start_process` ended, and what it said last."""
    text = last_line(logs / f'{name}.log', 'its log is empty')
    return f"'{name}' ended with status {process.returncode}: {text} (logs are in '{logs}')"


class StandStill:
    """Tells processes that somebody stopped (SIGSTOP) from those that are at work.

    What waits for a process looks here, many times a second: one that stands still never ends.
    """

    def __init__(self) -> None:
        self._since: dict[int, float] = {}
        self._looked_s = 0.0

    def find(self, pids: Iterable[int]) -> int | None:
        """Returns the number of a process that has stood still for `STILL_S`, or None."""
        now_s = time.monotonic()
        if now_s - self._looked_s > _LONGEST_GAP_S:  # a terminal stopped this process as well
            self._since.clear()
        self._looked_s = now_s
        self._since = {pid: self._since.get(pid, now_s) for pid in pids if _is_stopped(pid)}
        still = (pid for pid, since_s in self._since.items() if now_s - since_s > STILL_S)
        return next(still, None)

    def said(self, processes: Mapping[str, subprocess.Popen[bytes]]) -> str:
        """Says which of named processes has stood still for `STILL_S`; empty = none."""
        found = self.find(process.pid for process in processes.values())
        names = [name for name, process in processes.items() if process.pid == found]
        return f"'{names[0]}' was stopped and stood still for {STILL_S:g} s" if names else ''


def _is_stopped(pid: int) -> bool:
    try:
        text = Path(f'/proc/{pid}/stat').read_text()
    except OSError:  # it ended, or the system has no such files
        return False
    return text.rpartition(')')[2].split()[0] == 'T'


def stop_process(process: subprocess.Popen[bytes] | None) -> None:
    """Ends a node with SIGINT and waits for it; kills it where that does not help."""
    if process is None or process.poll() is not None:
        return
    process.send_signal(signal.SIGINT)
    with suppress(ProcessLookupError):
        process.send_signal(signal.SIGCONT)  # one that stands still hears nothing
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


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
            f'for {STILL_S:g} s is ended, too); what is done is kept: run the command again, with '
            'fewer --workers'
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


class WorkerPool(ProcessPoolExecutor):
    """Processes whose `run_job` runs jobs; they end with this process, however that ends.

    One that stands still (SIGSTOP) is killed: the pool breaks, and nobody waits on. So is one that
    the SIGTERM of a broken pool does not end, e.g. as it was forked with another's handler.

    Args:
        make_run: makes what runs a job, once in every process.
        workers: processes.
        threads: of OpenCV in each of them.
        method: `spawn`, or `fork`, where nothing is copied or pickled.
    """

    def __init__(
        self, make_run: Callable[[], Run], workers: int, threads: int = 1, method: str = 'spawn'
    ) -> None:
        arguments = (make_run, threads, os.getpid())
        super().__init__(workers, multiprocessing.get_context(method), _start_worker, arguments)
        self._closed = threading.Event()
        threading.Thread(target=self._kill_still, daemon=True).start()

    def submit(self, *job: Any, **options: Any) -> Future[Any]:
        """Starts processes; none of them gets a Ctrl-C that it does not ignore yet."""
        resource_tracker.ensure_running()  # which lets SIGINT through
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return super().submit(*job, **options)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def kill(self) -> None:
        """Ends the processes in the middle of a job."""
        for worker in list((self._processes or {}).values()):
            worker.kill()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Ends the processes."""
        super().shutdown(wait, cancel_futures=cancel_futures)
        self._closed.set()

    def _kill_still(self) -> None:
        still, broken_s = StandStill(), float('inf')
        while not self._closed.wait(_LOOK_S):
            workers = dict(self._processes or {})
            found = still.find(workers)
            if self._broken:
                broken_s = min(broken_s, time.monotonic())
            for pid, worker in workers.items():
                if pid == found or time.monotonic() > broken_s + STILL_S:
                    worker.kill()


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


def _start_worker(make_run: Callable[[], Run], threads: int, parent: int) -> None:
    """Prepares a worker; an error is raised by every job."""
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
    """A killed command must not go on writing: the same command may have been started again."""
    while os.getppid() == parent:
        time.sleep(_LOOK_S)
    os._exit(1)


def _raising(error: MtvWorldError) -> Run:
    def run(job: Any) -> Any:
        raise error

    return run


def run_job(*job: Any) -> Any:
    """Runs a job in a worker of a `WorkerPool`."""
    assert _run is not None
    return _run(*job)


class _Scoring:
    """Runs a scorer, and says why where a job has no scores.

    Args:
        make_scorer: makes it.
        is_late: in another process, where what goes wrong meanwhile is told by every job.
    """

    def __init__(self, make_scorer: Callable[[], Scorer], is_late: bool = True) -> None:
        try:
            self._score: Run = make_scorer().score
        except MtvWorldError as error:
            if not is_late:
                raise
            self._score = _raising(error)

    def __call__(self, job: Any) -> Outcome:
        from mtv_world_ros.files import plain  # yaml: signals are handled before it is imported

        try:
            return plain(self._score(job).as_json())
        except MtvWorldError as error:
            return str(error)

    def numbered(self, number: int, job: Any) -> tuple[int, Outcome]:
        return number, self(job)


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
    make_run = partial(_Scoring, make_scorer, is_late=several)
    yield from run_all(jobs, make_run, workers, threads)


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
        actor = ray.remote(num_cpus=1)(_Scoring)
        pool = ray.util.ActorPool([actor.remote(make_scorer) for _ in range(workers)])
        numbered = list(enumerate(jobs))
        done = pool.map_unordered(lambda a, one: a.numbered.remote(*one), numbered)
        yield from ((jobs[number], outcome) for number, outcome in done)
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
