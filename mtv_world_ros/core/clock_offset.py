"""Offset of a clock against the monotonic clock, read so that a pause is taken for no step."""

from __future__ import annotations

from collections.abc import Callable
import time
from typing import NamedTuple

#: readings until one is not interrupted
_NUM_READINGS = 5
#: duration of a reading that was not interrupted [ns]
_PROMPT_NS = 1_000_000


class Offset(NamedTuple):
    """Offset of a clock and its largest error.

    Attributes:
        value_ns: time of the clock minus monotonic time [ns].
        error_ns: largest error of the value [ns].
    """

    value_ns: int
    error_ns: int

    def step_ns(self, before: Offset, least_ns: int) -> int:
        """Return the step since an earlier offset [ns]; 0 if the errors, or drift, explain it.

        Args:
            before: earlier offset.
            least_ns: smaller steps are drift [ns].
        """
        step_ns = self.value_ns - before.value_ns
        return step_ns if abs(step_ns) > least_ns + self.error_ns + before.error_ns else 0


def read_offset(
    now_ns: Callable[[], int] | None = None, monotonic_ns: Callable[[], int] | None = None
) -> Offset:
    """Read a clock between two readings of the monotonic clock.

    A process that does not run in between gets a large error, and reads again.

    Args:
        now_ns: clock [ns]; None = the system clock.
        monotonic_ns: clock that never steps [ns]; None = the system's.
    """
    now_ns, monotonic_ns = now_ns or time.time_ns, monotonic_ns or time.monotonic_ns
    best: Offset | None = None
    for _ in range(_NUM_READINGS):
        before_ns, read_ns, after_ns = monotonic_ns(), now_ns(), monotonic_ns()
        found = Offset(read_ns - (before_ns + after_ns) // 2, (after_ns - before_ns + 1) // 2)
        best = found if best is None or found.error_ns < best.error_ns else best
        if best.error_ns <= _PROMPT_NS:
            break
    assert best is not None
    return best
