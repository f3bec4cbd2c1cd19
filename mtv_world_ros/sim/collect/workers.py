"""Processes that make episodes, and the lock that keeps two of them out of one data set."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import fcntl
import multiprocessing
import os
from pathlib import Path
import signal
import threading

from mtv_world_ros.errors import SimulatorError
from mtv_world_ros.sim.collect.episode_maker import CollectConfig, EpisodeMaker, Spent
from mtv_world_ros.sim.collect.jobs import Job

LOCK_FILE = '.lock'
_maker: EpisodeMaker | None = None


@contextmanager
def made(
    jobs: list[Job], workers: int, config: CollectConfig
) -> Iterator[Iterator[tuple[Job, Spent]]]:
    """Yields the finished jobs, in any order; spawned processes where more than one works."""
    if workers == 1 or not jobs:
        maker = EpisodeMaker(config)
        yield ((job, maker.make(job)) for job in jobs)
        return
    context = multiprocessing.get_context('spawn')
    with context.Pool(workers, _start_worker, (config,)) as pool:
        yield pool.imap_unordered(_make, jobs)


def _start_worker(config: CollectConfig) -> None:
    global _maker
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _maker = EpisodeMaker(config)


def _end_with_parent() -> None:
    """A killed command must not go on writing: the same command may have been started again."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _make(job: Job) -> tuple[Job, Spent]:
    assert _maker is not None
    return job, _maker.make(job)


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Holds the data set's lock, which ends with the process however that ends.

    Raises:
        SimulatorError: another process collects into the folder, or it cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        stream = (out / LOCK_FILE).open('a')
    except OSError as error:
        raise SimulatorError(
            f"cannot write into '{out}': {error}; choose another --out"
        ) from error
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise SimulatorError(
                f"another `collect` is writing into '{out}'; wait for it, or choose another --out"
            ) from error
        except OSError:
            pass  # a file system without locks
        yield
