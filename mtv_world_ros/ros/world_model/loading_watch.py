"""Loading of a node: what it waits for is said, and the last plan that comes meanwhile is kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from threading import Event, Thread
import time
from types import TracebackType
from typing import Self

from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from trajectory_msgs.msg import JointTrajectory

#: interval at which a node says what it waits for [s]
SAY_EVERY_S = 5.0


class LoadingWatch:
    """Subscription that keeps the last plan while a node loads, and a thread that says so.

    A context manager around the loading. The middleware stores the plan: no callback runs.

    Args:
        node: node that loads.
        what: what is loaded, in words.
        say: called with a text at once and every `SAY_EVERY_S`; from a thread of its own.
    """

    def __init__(self, node: Node, what: str, say: Callable[[str], None]) -> None:
        self._node, self._what, self._say = node, what, say
        self._is_over = Event()
        self._thread = Thread(target=self._repeat, name='loading watch', daemon=True)
        self._since_s = time.monotonic()

    def __enter__(self) -> Self:
        self._plans = self._node.create_subscription(
            JointTrajectory,
            'joint_trajectory',
            lambda _: None,
            QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE),
            raw=True,
        )
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._is_over.set()
        self._thread.join()
        self._node.destroy_subscription(self._plans)

    def take(self) -> tuple[bytes, dict[str, int]] | None:
        """Return the last received plan, serialised, with rclpy's information; None = none."""
        with self._plans.handle:
            return self._plans.handle.take_message(JointTrajectory, True)

    def _repeat(self) -> None:
        while True:
            seconds = time.monotonic() - self._since_s
            self._say(f'loading {self._what} for {seconds:.0f} s; the last plan is kept')
            if self._is_over.wait(SAY_EVERY_S):
                return


class WaitingLog:
    """Log lines on the inputs that a node waits for.

    The first plan is waited for in a line at once and every `SAY_EVERY_S`; after that a line
    comes when an input is lost.

    Args:
        logger: logger of the node.
    """

    def __init__(self, logger: RcutilsLogger) -> None:
        self._logger = logger
        self._said: tuple[str, ...] = ()
        self._said_s = -SAY_EVERY_S

    def update(self, missing: Sequence[str], has_begun: bool) -> None:
        """Log what is missing if it is due.

        Args:
            missing: inputs that are missing, as text.
            has_begun: whether a plan was taken already.
        """
        now_s = time.monotonic()
        # ages in the texts grow: what counts is how many inputs are missing, and that they are
        is_due = now_s - self._said_s >= SAY_EVERY_S
        is_news = len(missing) > len(self._said)
        if missing and (is_news or (is_due and not has_begun)):
            self._logger.info(f'waits for: {"; ".join(missing)}')
            self._said_s = now_s
        self._said = tuple(missing)
