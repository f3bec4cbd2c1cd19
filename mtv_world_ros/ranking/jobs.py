"""What one policy reached in one episode: really, and as imagined."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import isfinite, nan
from typing import Any

from mtv_world_ros.data_types import SuccessEstimate

#: probability from which an estimate counts as a success
THRESHOLD = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """A success estimate as it is kept.

    Attributes:
        probability: NaN = abstains.
        interval: (low, high).
        jaccard: (V, O) J of the objects with where they should be; NaN where not known.
        reasons: what it rests on, or why it abstains.
    """

    probability: float
    interval: tuple[float, float]
    jaccard: tuple[tuple[float, ...], ...]
    reasons: tuple[str, ...]

    @classmethod
    def of(cls, estimate: SuccessEstimate | None) -> Judged:
        """Returns an estimate in plain values; None = the policy gave no answer to judge."""
        if estimate is None:
            reasons = ('abstains: the policy gave no answer',)
            return cls(probability=nan, interval=(nan, nan), jaccard=(), reasons=reasons)
        return cls(
            probability=float(estimate.probability),
            interval=estimate.interval,
            jaccard=tuple(tuple(map(float, row)) for row in estimate.jaccard),
            reasons=estimate.reasons,
        )

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Judged:
        """Reads what `Result.as_json` wrote."""
        low, high = map(_number, values['interval'])
        return cls(
            probability=_number(values['probability']),
            interval=(low, high),
            jaccard=tuple(tuple(map(_number, row)) for row in values['jaccard']),
            reasons=tuple(values['reasons']),
        )

    @property
    def success(self) -> float:
        """1 or 0 by `THRESHOLD`; NaN where it abstains."""
        return float(self.probability >= THRESHOLD) if isfinite(self.probability) else nan


def _number(value: float | None) -> float:
    return nan if value is None else float(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """One policy on one episode.

    Attributes:
        policy: its name.
        task: name of the task.
        index: of the episode within the task.
        seed: of the episode, the policy and the imagination's noise.
        ever: the simulator's predicate held at some time.
        final: it held at the end; this is what counts as success.
        imagined: the estimate at the end of the imagined episode.
        seen: the same estimator on the simulator's own frames: what is wrong with it is not the
            world model's fault.
        num_chunks: answers executed in the simulator.
        num_imagined: answers executed in imagination.
        is_over: the policy ended the episode before the limit, in both.
        seconds: time by stage [s].
    """

    policy: str
    task: str
    index: int
    seed: int
    ever: bool
    final: bool
    imagined: Judged
    seen: Judged
    num_chunks: int
    num_imagined: int
    is_over: bool
    seconds: Mapping[str, float]

    def as_json(self) -> dict[str, Any]:
        """Returns plain values."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Result:
        """Reads what `as_json` returned, NaN as null."""
        judged = {key: Judged.from_json(values[key]) for key in ('imagined', 'seen')}
        return cls(**{**values, **judged})
