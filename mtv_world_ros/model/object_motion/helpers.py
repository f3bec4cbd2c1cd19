"""Processes that compute beside this one: the engine's steps hold the interpreter.

Both sides are here: `Helpers` gives work, `main` does it in a process of its own, which ends with
the line between them, however this process ends. The main module is not imported again, as
processes of `multiprocessing` would: whoever loads a pipeline need not guard it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
import logging
from multiprocessing import Pipe
from multiprocessing.connection import Connection
import signal
import subprocess
import sys
from threading import Lock
from typing import Any, TypeVar

Job = TypeVar('Job')
Answer = TypeVar('Answer')
#: what each job gives, or what one of them raised
Answers = list[Any] | Exception

logger = logging.getLogger(__name__)


class Helpers:
    """Started by `start` or the first call; each helps from when it is ready on.

    Args:
        count: processes beside this one.
    """

    def __init__(self, count: int) -> None:
        self._count, self._lock = count, Lock()
        self._starting: list[_Helper] | None = None
        self._ready: list[_Helper] = []

    def start(self, function: Callable[..., Any]) -> None:
        """Lets the helpers import what a function needs, so that they are ready when jobs come."""
        self.map(function, ())

    def map(self, function: Callable[[Job], Answer], jobs: Sequence[Job]) -> list[Answer]:
        """Returns what a function gives for each job, in their order.

        This process does its share, and that of a helper that died.

        Args:
            function: it, the jobs and what it gives or raises can be pickled.
            jobs: any number of them.
        """
        with self._lock:
            self._gather(function)
            sides = 1 + len(self._ready)
            shares = [jobs[number::sides] for number in range(sides)]
            for helper, share in zip(self._ready, shares[1:], strict=True):
                helper.give(function, share)
            answers = [_answers(function, shares[0])]
            for helper, share in zip(list(self._ready), shares[1:], strict=True):
                answer = helper.answer()
                if answer is None:
                    logger.warning('a process that computes motions died; this one goes on alone')
                    self._ready.remove(helper)
                    answer = _answers(function, share)
                answers.append(answer)
        found: list[Any] = [None] * len(jobs)
        for number, answer in enumerate(answers):
            if isinstance(answer, Exception):
                raise answer
            found[number::sides] = answer
        return found

    def _gather(self, function: Callable[[Any], Any]) -> None:
        """Starts helpers at first, and finds out which are ready by now."""
        if self._starting is None:
            self._starting = [_Helper(function) for _ in range(self._count)]
        for helper in [one for one in self._starting if one.line.poll()]:
            self._starting.remove(helper)
            if helper.answer() is not None:
                self._ready.append(helper)


class _Helper:
    """One process; the answer to no jobs tells that it has imported what the function needs."""

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self.line, end = Pipe()
        with end:
            number = end.fileno()
            self.process = subprocess.Popen(
                [sys.executable, '-m', __name__, str(number)],
                stdin=subprocess.DEVNULL,
                pass_fds=[number],
            )
        self.give(function, ())

    def give(self, function: Callable[[Any], Any], jobs: Sequence[Any]) -> None:
        with suppress(OSError):  # it has died: there will be no answer
            self.line.send((function, jobs))

    def answer(self) -> Answers | None:
        """Waits for what the jobs give; None = it has died."""
        try:
            return self.line.recv()
        except (EOFError, OSError):
            return None


def _answers(function: Callable[[Any], Any], jobs: Sequence[Any]) -> Answers:
    try:
        return [function(job) for job in jobs]
    except Exception as error:  # whatever it is, the caller is told
        return error


def main() -> None:
    """Computes what comes in until the other side is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other side ends it
    with Connection(int(sys.argv[1])) as line, suppress(EOFError, OSError):
        while True:
            function, jobs = line.recv()
            line.send(_answers(function, jobs))


if __name__ == '__main__':
    main()
