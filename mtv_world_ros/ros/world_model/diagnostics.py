"""What `/diagnostics` says: counts by reason, ages, latencies, and how bad it is."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np

from mtv_world_ros.ros.messages.rejection import Reason, Rejection

#: chunks that latencies are taken over
_WINDOW = 50
#: a rejection shows as a warning for this long [s]
_WARN_S = 5.0
#: rollouts ended in a row without a chunk that are worth a warning
_STARVED = 5
#: reasons that mean something is broken here and not in what was sent
_ERRORS = (Reason.OUT_OF_MEMORY, Reason.INTERNAL_ERROR)


class Tally:
    """Counts what happens to messages and rollouts; times are of `time.monotonic`."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._rejected: Counter[str] = Counter()
        self._last: tuple[float, Reason, str] | None = None
        self._seconds: dict[str, deque[float]] = {}
        self._fruitless = 0

    def reject(self, error: Rejection, now_s: float) -> None:
        """Counts a refused message or rollout."""
        self._rejected[error.reason] += 1
        self._last = (now_s, error.reason, str(error))

    def end(self, state: str, num_chunks: int) -> None:
        """Counts the end of a rollout."""
        self.counts[f'rollouts_{state}'] += 1
        starved = state == 'preempted' and num_chunks == 0
        self._fruitless = self._fruitless + 1 if starved else 0

    def add_seconds(self, seconds: Mapping[str, float]) -> None:
        """Takes the durations of a chunk [s], by name."""
        for name, value in seconds.items():
            self._seconds.setdefault(name, deque(maxlen=_WINDOW)).append(value)

    def level(self, now_s: float, num_policies: int = 1) -> tuple[bytes, str]:
        """How bad it is, and everything that is wrong.

        Args:
            now_s: now [s].
            num_policies: publishers of trajectories.
        """
        level, texts = DiagnosticStatus.WARN, []
        if self._last is not None and now_s - self._last[0] < _WARN_S:
            _, reason, text = self._last
            level = DiagnosticStatus.ERROR if reason in _ERRORS else level
            texts.append(f'{reason}: {text}')
        if num_policies > 1:
            texts.append(
                f'{num_policies} publishers of joint trajectories: each pre-empts the rollouts of '
                'the others; stop all but one'
            )
        if self._fruitless >= _STARVED:
            texts.append(
                f'the last {self._fruitless} rollouts were pre-empted before their first chunk: '
                'trajectories arrive faster than the model predicts'
            )
        return (level, ' | '.join(texts)) if texts else (DiagnosticStatus.OK, 'ready')

    def values(self, now_s: float) -> dict[str, object]:
        """Keys and values: counts, `rejected.<reason>`, the last rejection, latencies."""
        values: dict[str, object] = dict(self.counts)
        values['rejected'] = sum(self._rejected.values())
        values |= {f'rejected.{reason}': n for reason, n in sorted(self._rejected.items())}
        if self._last is not None:
            when, reason, text = self._last
            values['last_rejection'] = f'{reason}: {text}'
            values['last_rejection_age_s'] = now_s - when
        for name, window in self._seconds.items():
            values[f'{name}.last'] = window[-1]
            values[f'{name}.median'] = float(np.median(window))
            values[f'{name}.max'] = max(window)
        return values
