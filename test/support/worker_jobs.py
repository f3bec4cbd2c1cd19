"""Jobs for worker processes, in a module that a spawned one can import as well."""

from __future__ import annotations

from dataclasses import dataclass
import os
from pathlib import Path
import signal
import time


def stop_on_three(number: int) -> int:
    """Stand still at job three."""
    if number == 3:
        os.kill(os.getpid(), signal.SIGSTOP)
    return number


def make_stopping() -> object:
    """Make what stands still."""
    return stop_on_three


@dataclass
class LongJobs:
    """Notes its process in a folder and takes a minute a job."""

    folder: Path

    def __call__(self) -> object:
        """Make what runs a job."""
        return self._run

    def _run(self, number: int) -> None:
        (self.folder / str(os.getpid())).touch()
        time.sleep(60)


def held_back() -> tuple[bool, bool]:
    """Whether this process holds SIGINT back, and whether it ignores it."""
    held = signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])
    return held, signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def make_held_back() -> object:
    """Make what says so."""
    return held_back
