"""Pool of worker processes that end with this process, however that ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
import multiprocessing
from multiprocessing import resource_tracker
import os
import signal
import threading
import time
from typing import Any

from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.core.processes import STOPPED_S, StoppedProcesses

#: between two looks of a pool at its workers, and of a worker at its parent [s]
_LOOK_S = 0.5
#: libraries that start threads read these when they are loaded
_THREAD_VARIABLES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')

#: runs one job
Run = Callable[..., Any]
#: of this process, if it is a worker
_run: Run | None = None


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
def thread_limit(threads: int) -> Iterator[None]:
    """Limit the threads of the libraries of processes that start within the block."""
    with _environment(dict.fromkeys(_THREAD_VARIABLES, str(threads))):
        yield


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
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
    _run = made_run(make_run, threads)


def _end_with(parent: int) -> None:
    """End with the parent: a killed command must not go on writing, it may be started again."""
    while os.getppid() == parent:
        time.sleep(_LOOK_S)
    os._exit(1)


def made_run(make_run: Callable[[], Run], threads: int) -> Run:
    """Return the function of a worker that runs a job; an error of making it is raised by each.

    Args:
        make_run: factory of the function.
        threads: number of OpenCV's threads.
    """
    import cv2

    # 1 would wait for threads that a fork left behind; 0 is one thread, too
    cv2.setNumThreads(threads if threads > 1 else 0)
    try:
        return make_run()
    except MtvWorldError as error:
        return raising(error)


def raising(error: MtvWorldError) -> Run:
    """Return a function of a job that raises an error."""

    def run(job: Any) -> Any:
        raise error

    return run


def run_job(*job: Any) -> Any:
    """Run a job in a worker of a `WorkerPool`."""
    assert _run is not None
    return _run(*job)
