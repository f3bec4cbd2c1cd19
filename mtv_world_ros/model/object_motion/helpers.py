"""Processes that compute beside this one: the engine's steps hold the interpreter.

Both sides are here: `Helpers` gives work, `main` does it in a process of its own, which ends with
the line between them, however this process ends. The main module is not imported again, as
processes of `multiprocessing` would: whoever loads a pipeline need not guard it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
import logging
from multiprocessing import Pipe
from multiprocessing.connection import Connection
import signal
import subprocess
import sys
from threading import Lock, Thread
from typing import Any, Generic, TypeVar

Answer = TypeVar('Answer')
#: what no process has given yet
_UNDONE = object()

logger = logging.getLogger(__name__)


class Helpers:
    """Started by `start` or the first call; each helps from when it is ready on.

    Args:
        count: processes beside this one; with none it does all itself.
    """

    def __init__(self, count: int) -> None:
        self._count, self._lock = count, Lock()
        self._starting: list[_Helper] | None = None
        self._ready: list[_Helper] = []

    def start(self, function: Callable[..., Any]) -> None:
        """Lets the helpers import what a function needs, so that they are ready when jobs come."""
        self.begin(function, ())

    def begin(
        self, function: Callable[..., Answer], jobs: Sequence[tuple[Any, ...]]
    ) -> Work[Answer]:
        """Lets the helpers begin, each with one job after the other, while this process goes on.

        Args:
            function: it, what it is given and what it gives or raises can be pickled.
            jobs: the arguments of each call, any number of them.
        """
        with self._lock:
            if self._starting is None:
                self._starting = [_Helper(function) for _ in range(self._count)]
            for helper in [one for one in self._starting if one.line.poll()]:
                self._starting.remove(helper)
                helper.answer()
                self._ready.append(helper)
            self._ready = [helper for helper in self._ready if helper.lives]
            return Work(function, jobs, self._ready)


class Work(Generic[Answer]):
    """Jobs that helpers have begun with; see `Helpers.begin`."""

    def __init__(
        self,
        function: Callable[..., Answer],
        jobs: Sequence[tuple[Any, ...]],
        helpers: Sequence[_Helper],
    ) -> None:
        self._function, self._jobs = function, jobs
        self._found: list[Any] = [_UNDONE] * len(jobs)
        self._left = deque(range(len(jobs)))
        self._feeders = [
            Thread(target=self._feed, args=(helper,), daemon=True)
            for helper in helpers[: len(jobs)]
        ]
        for feeder in self._feeders:
            feeder.start()

    def finish(self) -> list[Answer]:
        """Returns what the function gives for each job, in their order.

        This process does what is left, and what a helper died of.
        """
        with suppress(IndexError):  # none is left
            while True:
                self._do(self._left.popleft())
        for feeder in self._feeders:
            feeder.join()
        for number, answer in enumerate(self._found):
            if answer is _UNDONE:
                self._do(number)
            if isinstance(self._found[number], Exception):
                raise self._found[number]
        return self._found

    def _do(self, number: int) -> None:
        self._found[number] = _answer(self._function, self._jobs[number])

    def _feed(self, helper: _Helper) -> None:
        with suppress(IndexError), helper.lock:
            while helper.lives:
                number = self._left.popleft()
                helper.give(self._function, self._jobs[number])
                self._found[number] = helper.answer()


class _Helper:
    """One process; its first answer tells that it has imported what the function needs."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.line, end = Pipe()
        self.lock, self.lives = Lock(), True
        with end:
            number = end.fileno()
            self.process = subprocess.Popen(
                [sys.executable, '-m', __name__, str(number)],
                stdin=subprocess.DEVNULL,
                pass_fds=[number],
            )
        self.give(function, None)

    def give(self, function: Callable[..., Any], job: tuple[Any, ...] | None) -> None:
        with suppress(OSError):  # it has died: there will be no answer
            self.line.send((function, job))

    def answer(self) -> Any:
        """Waits for what a call gives, or raised; `_UNDONE` = it has died."""
        try:
            return self.line.recv()
        except (EOFError, OSError):
            logger.warning('a process that computes motions died; the others go on')
            self.lives = False
            return _UNDONE


def _answer(function: Callable[..., Any], job: tuple[Any, ...]) -> Any:
    try:
        return function(*job)
    except Exception as error:  # whatever it is, the caller is told
        return error


def main() -> None:
    """Computes what comes in until the other side is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other side ends it
    with Connection(int(sys.argv[1])) as line, suppress(EOFError, OSError):
        while True:
            function, job = line.recv()
            line.send(None if job is None else _answer(function, job))


if __name__ == '__main__':
    main()
