"""A thread that calls the policy, so that a slow one does not block the node."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from queue import SimpleQueue
from threading import Thread
import time
import traceback

from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.errors import MtvWorldError

#: a policy that hangs is left behind after this long [s]
_CLOSE_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyAnswer:
    """Answer of the policy to one request.

    Attributes:
        ticket: ticket of the question.
        trajectory: the commands; None where the episode is over, or the question was a reset.
        error: reason why there is no answer; empty if there is one.
        seconds: duration of the policy's answer [s].
    """

    ticket: int
    trajectory: JointTrajectory | None
    error: str
    seconds: float


class Actor:
    """Calls the policy in a thread, one question after the other.

    Args:
        notify: called from the thread whenever `take` has something new.
    """

    def __init__(self, notify: Callable[[], None]) -> None:
        self._notify = notify
        self._questions: SimpleQueue[tuple[int, Callable[[], JointTrajectory | None]] | None] = (
            SimpleQueue()
        )
        self._answers: SimpleQueue[PolicyAnswer] = SimpleQueue()
        # a daemon: what a policy does when the node ends is not known
        self._thread = Thread(target=self._run, name='policy', daemon=True)
        self._thread.start()

    def ask(self, ticket: int, question: Callable[[], JointTrajectory | None]) -> None:
        """Queue a request; requests are answered in order."""
        self._questions.put((ticket, question))

    def take(self) -> list[PolicyAnswer]:
        """Return the answers since the last call, in order."""
        return [self._answers.get() for _ in range(self._answers.qsize())]

    def close(self) -> None:
        """End the thread, unless the policy hangs."""
        self._questions.put(None)
        self._thread.join(_CLOSE_S)

    def _run(self) -> None:
        while (asked := self._questions.get()) is not None:
            ticket, question = asked
            begin, trajectory, error = time.monotonic(), None, ''
            try:
                trajectory = question()
            except MtvWorldError as raised:
                error = str(raised)
            except Exception:  # a policy may be anybody's code
                error = traceback.format_exc(limit=-3)
            seconds = time.monotonic() - begin
            answer = PolicyAnswer(
                ticket=ticket, trajectory=trajectory, error=error, seconds=seconds
            )
            self._answers.put(answer)
            self._notify()
