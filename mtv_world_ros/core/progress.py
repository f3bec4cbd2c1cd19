"""Progress of long work with the time left: a bar in a terminal, lines elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
import math
import sys
import threading
import time
from typing import Any
import weakref

from tqdm import tqdm

#: time between two lines where stderr is no terminal [s]
LINE_S = 30.0
#: name of the thread that prints them
THREAD = 'progress'
#: time after which the bar's clock is drawn again, also when nothing was finished [s]
_CLOCK_S = 1.0


class Progress(tqdm):
    """Progress bar on stderr; where that is no terminal, a line every `LINE_S`.

    Nothing is printed for work that ends within `LINE_S` there.

    Args:
        iterable: items to work on; None = `update` counts.
        unit: singular of an item's name, e.g. 'episode'.
        is_shown: False prints nothing.
        line_s: time between two lines [s].
        options: other options of tqdm: `desc`, `total`, `initial`.

    Attributes:
        num_shown: number of progresses that were shown in this process.
    """

    num_shown = 0

    def __init__(
        self,
        iterable: Any = None,
        *,
        unit: str = 'item',
        is_shown: bool = True,
        line_s: float = LINE_S,
        **options: Any,
    ) -> None:
        self._is_bar = sys.stderr.isatty()
        self._name = unit
        super().__init__(
            iterable,
            unit=f' {unit}s',
            file=sys.stderr,
            disable=not is_shown,
            delay=0 if self._is_bar else math.inf,  # tqdm itself draws nothing before the delay
            **options,
        )
        self._begun_s, self._begun_n = time.monotonic(), self.n
        self._closed = threading.Event()
        if is_shown:
            Progress.num_shown += 1
            period = _CLOCK_S if self._is_bar else line_s
            arguments = (weakref.ref(self), self._closed, period)
            threading.Thread(target=_tick, args=arguments, name=THREAD, daemon=True).start()

    def __iter__(self) -> Iterator[Any]:
        with self:
            for item in self.iterable:
                yield item
                self.update()

    def display(self, *what: Any, **how: Any) -> Any:
        """Draw the bar, in a terminal."""
        return super().display(*what, **how) if self._is_bar else None

    def clear(self, *what: Any, **how: Any) -> None:
        """Wipe the bar, in a terminal."""
        if self._is_bar:
            super().clear(*what, **how)

    def close(self) -> None:
        """End the progress; the bar stays."""
        with suppress(AttributeError):  # the constructor was interrupted
            self._closed.set()
        super().close()

    def line(self) -> str:
        """Return how much is done, since when, and the time left."""
        text = f'{self.n} of {self.total}' if self.total else f'{self.n}'
        seconds, done = time.monotonic() - self._begun_s, self.n - self._begun_n
        text += f' {self._name}s after {duration(seconds)}'
        if self.total and done > 0:
            text += f', {duration(seconds / done * (self.total - self.n))} left'
        elif self.total:
            text += ', the time left is known after the next one'
        ends = [f'{self.desc.removesuffix(": ")}: ' if self.desc else '', self.postfix or '']
        return f'{ends[0]}{text}{"; " if ends[1] else ""}{ends[1]}'

    def tick(self) -> None:
        """Draw the bar's clock, or print a line."""
        if self._is_bar:
            self.refresh()
        else:
            sys.stderr.write(f'{self.line()}\n')
            sys.stderr.flush()


def duration(seconds: float) -> str:
    """Return a time in words, e.g. '45 s', '12 min', '3 h 20 min'."""
    if seconds < 99.5:
        return f'{seconds:.0f} s'
    minutes = round(seconds / 60)
    return f'{minutes} min' if minutes < 100 else f'{minutes // 60} h {minutes % 60} min'


def _tick(bar: weakref.ref[Progress], closed: threading.Event, period: float) -> None:
    while not closed.wait(period):
        shown = bar()
        if shown is None:
            return
        with suppress(OSError, ValueError):  # stderr was closed
            shown.tick()
        del shown
