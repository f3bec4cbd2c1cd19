"""How far ahead to trust the imagination: J against the horizon, kept with a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
import json
from math import isfinite
from pathlib import Path
from typing import Any

from mtv_world_ros.errors import CheckpointError

HORIZON = 'horizon.json'


@dataclass(frozen=True, slots=True, kw_only=True)
class HorizonCurve:
    """Mean J of the objects that move, of episodes imagined as a whole from their first frame.

    Attributes:
        period_s: between frames [s]; frame k is `(k + 1) * period_s` ahead.
        values: (T,) mean J.
        lower: (T,) 2.5 percentile over resampled episodes.
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
    """Writes it into a checkpoint, beside its name first.

    Raises:
        CheckpointError: the folder cannot be written to.
    """
    path = Path(folder) / HORIZON
    beside = path.with_name(f'.{path.name}.part')
    try:
        beside.write_text(json.dumps(asdict(curve), indent=1) + '\n', encoding='utf-8')
        beside.replace(path)
    except OSError as error:
        raise CheckpointError(
            f"the horizon cannot be stored in the checkpoint '{folder}' ({error}); copy the "
            'checkpoint to a folder of your own and calibrate that one'
        ) from error
    return path


def load_horizon(folder: Path) -> HorizonCurve | None:
    """Returns the curve of a checkpoint; None = it has none.

    Raises:
        CheckpointError: the file is not what `mtv-world calibrate` writes.
    """
    path = Path(folder) / HORIZON
    if not path.is_file():
        return None
    try:
        values = json.loads(path.read_text(encoding='utf-8'))
        read: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in values.items()
        }
        found = HorizonCurve(**read)
        if not found.period_s > 0 or len(found.values) != len(found.lower):
            raise ValueError('the period is not positive, or the curves differ in length')
    except (OSError, ValueError, TypeError) as error:
        raise CheckpointError(
            f"'{path}' cannot be used: {error}; run 'mtv-world calibrate {folder} DATASET --out "
            "DIR' again, or delete the file"
        ) from error
    return found
