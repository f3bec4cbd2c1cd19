"""How far ahead to trust the imagination: J against the horizon, kept with a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path

from mtv_world_ros.success.checkpoint_record import load_record, save_record

HORIZON = 'horizon.json'


@dataclass(frozen=True, slots=True, kw_only=True)
class HorizonCurve:
    """Mean J of the objects that move, of episodes imagined as a whole from their first frame.

    Attributes:
        period_s: between frames [s]; frame k is `(k + 1) * period_s` ahead.
        values: (T,) mean J.
        lower: (T,) lower end of the 95 % interval over episodes; 0 where too few reach it.
        segmenter: that found the masks.
        num_episodes: behind it.
        made: command, date, machine.
    """

    period_s: float
    values: tuple[float, ...]
    lower: tuple[float, ...]
    segmenter: str
    num_episodes: int
    made: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.period_s > 0 or len(self.values) != len(self.lower):
            raise ValueError('the period is not positive, or the curves differ in length')

    def trusted_seconds(self, level: float) -> float:
        """Returns up to which time J is expected to be at least `level` [s].

        By the lower bound, at every frame up to it; 0 = not even at the first. The curve's end
        is the most that is known.
        """
        num_trusted = 0
        for value in self.lower:
            if not (isfinite(value) and value >= level):
                break
            num_trusted += 1
        return num_trusted * self.period_s


def save_horizon(folder: Path, curve: HorizonCurve) -> Path:
    """Writes it into a checkpoint.

    Raises:
        CheckpointError: the folder cannot be written to.
    """
    return save_record(Path(folder) / HORIZON, curve, 'horizon')


def load_horizon(folder: Path) -> HorizonCurve | None:
    """Returns the curve of a checkpoint; None = it has none.

    Raises:
        CheckpointError: the file is not what `mtv-world calibrate` writes.
    """
    return load_record(Path(folder) / HORIZON, HorizonCurve)
