"""Stamped samples in the order of their stamps, and the clock that they are compared with."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from operator import itemgetter
import time
from typing import Generic, TypeVar

from rclpy.clock import ROSClock
from rclpy.node import Node

from mtv_world_ros.core.clock_offset import Offset, read_offset
from mtv_world_ros.ros.messages.conversions import NANO

Value = TypeVar('Value')
#: a sample that is older than the newest by more begins the stream anew [s]
RESTART_S = 1.0
#: a change of the system clock against the monotonic clock that is a step, not a drift [s]
STEP_S = 0.1
_STEP_NS = round(STEP_S * NANO)


class NodeTime:
    """Time of a node, and steps of the system clock that rclpy does not tell.

    Args:
        now_ns: the node's time [ns]; 0 = there is none yet.
        is_simulated: whether it comes from `/clock`; rclpy tells of jumps of that clock.
        monotonic_ns: clock that never steps [ns].
    """

    def __init__(
        self,
        now_ns: Callable[[], int],
        is_simulated: Callable[[], bool],
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.now_ns, self.is_simulated = now_ns, is_simulated
        self._monotonic_ns = monotonic_ns
        self._offset: Offset | None = None

    @classmethod
    def of(cls, node: Node) -> NodeTime:
        """Return the time of a node."""
        clock = node.get_clock()

        def is_simulated() -> bool:
            return isinstance(clock, ROSClock) and clock.ros_time_is_active

        return cls(lambda: clock.now().nanoseconds, is_simulated)

    def step_s(self) -> float:
        """Return the step of the system clock since the last call [s]; 0 = none.

        A step counts once two readings agree on it.
        """
        if self.is_simulated():
            self._offset = None
            return 0.0
        offset, before = self._read(), self._offset
        if before is None or not offset.step_ns(before, _STEP_NS):
            self._offset = offset
            return 0.0
        again = self._read()
        if again.step_ns(offset, _STEP_NS) or not again.step_ns(before, _STEP_NS):
            return 0.0
        self._offset = again
        return again.step_ns(before, _STEP_NS) / NANO

    def _read(self) -> Offset:
        return read_offset(self.now_ns, self._monotonic_ns)


class Samples(Generic[Value]):
    """The newest samples of a stream, by stamp; each stamp once.

    Samples that arrive out of order take their place. One that is older than the newest by more
    than `RESTART_S` begins the stream anew, unless the newest is recent by the node's time.

    Attributes:
        refusal: reason why the last sample was refused; empty if it was taken.

    Args:
        length: number of samples that are kept.
    """

    def __init__(self, length: int) -> None:
        self._items: deque[tuple[int, Value]] = deque(maxlen=length)
        self.refusal = ''
        self._is_fresh = False

    def __bool__(self) -> bool:
        return bool(self._items)

    @property
    def newest(self) -> tuple[int, Value]:
        """Stamp [ns] and value of the newest sample."""
        return self._items[-1]

    @property
    def stamps(self) -> list[int]:
        """Stamps [ns], oldest first."""
        return [stamp for stamp, _ in self._items]

    def nearest(self, stamp_ns: int) -> tuple[int, Value]:
        """Return stamp and value of the sample nearest to a time [ns]."""
        return min(self._items, key=lambda sample: abs(sample[0] - stamp_ns))

    def add(self, stamp_ns: int, value: Value) -> None:
        """Take a sample; one with the stamp of another replaces it."""
        items = self._items
        if items and not self._is_fresh and items[-1][0] - stamp_ns > RESTART_S * NANO:
            items.clear()
        if not items or stamp_ns > items[-1][0]:
            items.append((stamp_ns, value))
            return
        place = bisect_left(items, stamp_ns, key=itemgetter(0))
        if items[place][0] == stamp_ns:
            items[place] = (stamp_ns, value)
        elif place or len(items) < (items.maxlen or 0):
            if len(items) == items.maxlen:
                items.popleft()
                place -= 1
            items.insert(place, (stamp_ns, value))

    def refuse_reason(self, stamp_ns: int, now_ns: int, limit_s: float) -> str:
        """Return the reason why a sample is refused; empty = it can be taken.

        Samples from the future would stay the newest. What was stored from there, before the clock
        was set back, is dropped. An old sample does not displace a fresh one.
        """
        limit_ns = round(limit_s * NANO)
        while self._items and self._items[-1][0] > now_ns + limit_ns:
            self._items.pop()
        if stamp_ns > now_ns + limit_ns:
            return f'is stamped {(stamp_ns - now_ns) / NANO:.3f} s in the future'
        is_late = stamp_ns < now_ns - limit_ns
        self._is_fresh = bool(self._items) and self._items[-1][0] >= now_ns - limit_ns
        if is_late and self._is_fresh:
            return f'is {(now_ns - stamp_ns) / NANO:.3f} s old; there are newer ones'
        return ''

    def clear(self) -> None:
        """Drop all samples."""
        self._items.clear()
        self.refusal, self._is_fresh = '', False
