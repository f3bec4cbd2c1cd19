"""Recorded messages in the order of their times, and when each is due."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
import heapq

from mtv_world_ros.data.bag.reader import BagMessage
from mtv_world_ros.ros.messages.stamps import NANO

#: recorders write messages this much out of order at most
_WINDOW_NS = 2 * NANO
#: of messages with one time the trajectory comes last: it is planned from the others
_LAST = 'trajectory_msgs/msg/JointTrajectory'


def in_order(messages: Iterable[BagMessage]) -> Iterator[BagMessage]:
    """Yields messages by time, holding two seconds of them; trajectories last among equals."""
    heap: list[tuple[int, bool, int, BagMessage]] = []
    for number, message in enumerate(messages):
        key = (message.stamp_ns, message.msgtype == _LAST, number)
        heapq.heappush(heap, (*key, message))
        while heap and heap[0][0] < message.stamp_ns - _WINDOW_NS:
            yield heapq.heappop(heap)[-1]
    while heap:
        yield heapq.heappop(heap)[-1]


@dataclass(slots=True)
class Timeline:
    """Maps bag time to the clock on the wall.

    Attributes:
        bag_ns: bag time at which playing started [ns].
        wall_ns: wall time at that moment, moved on by every pause [ns].
        rate: seconds of the bag a second.
    """

    bag_ns: int
    wall_ns: int
    rate: float

    def due(self, bag_ns: int) -> int:
        """Wall time at which a bag time is due [ns]."""
        return self.wall_ns + round((bag_ns - self.bag_ns) / self.rate)

    def bag_time(self, wall_ns: int) -> int:
        """Bag time of a wall time [ns]."""
        return self.bag_ns + round((wall_ns - self.wall_ns) * self.rate)

    def pause(self, duration_ns: int) -> None:
        """Moves all that is still to come by a pause."""
        self.wall_ns += duration_ns
