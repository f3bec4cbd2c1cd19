"""SIGINT and SIGTERM end a process with one line and the status of the signal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import os
import signal
import threading
from types import FrameType

#: a stopped command tidies up for this long [s]
_TIDY_S = 5.0
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


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

    timer = threading.Timer(_TIDY_S, os._exit, (128 + signal.SIGTERM,))
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
