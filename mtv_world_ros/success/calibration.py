"""What `mtv-world calibrate` keeps with a checkpoint: the fitted logistic, the trusted horizon."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
import json
from math import exp, isfinite, nan
from pathlib import Path
from typing import Any, TypeVar

from mtv_world_ros.bounded_input import read_json
from mtv_world_ros.errors import CheckpointError, nearest
from mtv_world_ros.files import write_whole

CALIBRATION = 'success_calibration.json'
HORIZON = 'horizon.json'
#: features that only speak against success: how a moved object was grasped and carried. An object
#: that never moves needs no grasp, which is no sign of success.
DOUBTS = frozenset({'grasp', 'carry'})

Record = TypeVar('Record')


def weighed(features: Mapping[str, float], name: str) -> float:
    """Returns a feature's value for the logistic: doubts count only if negative; NaN = unknown."""
    value = features.get(name, nan)
    return min(value, 0.0) if name in DOUBTS else value


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """What `mtv-world calibrate` found: F features, standardised, weighed and added up.

    Attributes:
        features: F names.
        means: F, subtracted; what takes the place of a feature that says nothing.
        scales: F, divided by.
        weights: F, logit per scale.
        bias: logit of an episode whose features are all at their mean.
        segmenter: that found the masks.
        tasks: that it was fitted on.
        num_episodes: that it was fitted on.
        num_seeds: rollouts of each.
        l2: strength of the pull towards the stated weights (`EstimatorConfig`).
        scores: before and after, the latter on tasks that were left out of the fit.
        made: command, date, machine.
    """

    features: tuple[str, ...]
    means: tuple[float, ...]
    scales: tuple[float, ...]
    weights: tuple[float, ...]
    bias: float
    segmenter: str
    tasks: tuple[str, ...]
    num_episodes: int
    num_seeds: int = 1
    l2: float = 1.0
    scores: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    made: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        lengths = {len(self.means), len(self.scales), len(self.weights), len(self.features)}
        numbers = [*self.means, *self.scales, *self.weights, self.bias]
        if len(lengths) != 1 or not self.features:
            raise ValueError('features, means, scales and weights are not equally many')
        if not all(isfinite(number) for number in numbers) or min(self.scales) <= 0:
            raise ValueError('a number is not finite, or a scale is not positive')

    def probability(self, features: Mapping[str, float]) -> float:
        """Returns the probability of success; features that are NaN count as the mean."""
        logit = self.bias
        for name, mean, scale, weight in zip(
            self.features, self.means, self.scales, self.weights, strict=True
        ):
            value = weighed(features, name)
            logit += weight * (value - mean) / scale if isfinite(value) else 0.0
        return 1.0 / (1.0 + exp(-max(min(logit, 50.0), -50.0)))

    def objection(self, task: str, segmenter: str) -> str:
        """Returns why it does not apply to a task and a segmenter; empty = it applies."""
        if segmenter != self.segmenter:
            return f"uncalibrated for the segmenter '{segmenter}' (fitted with '{self.segmenter}')"
        if task not in self.tasks:
            return f"uncalibrated for the task '{task}' (fitted on {len(self.tasks)} others)"
        return ''


def save_calibration(folder: Path, calibration: Calibration) -> Path:
    """Writes it into a checkpoint.

    Raises:
        CheckpointError: the folder cannot be written to.
    """
    return _save(Path(folder) / CALIBRATION, calibration, 'calibration')


def load_calibration(folder: Path) -> Calibration | None:
    """Returns the calibration of a checkpoint; None = it has none.

    Raises:
        CheckpointError: the file is not what `mtv-world calibrate` writes.
    """
    return _load(Path(folder) / CALIBRATION, Calibration)


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
        """Returns the time until which J is expected to stay at least `level` [s].

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
    return _save(Path(folder) / HORIZON, curve, 'horizon')


def load_horizon(folder: Path) -> HorizonCurve | None:
    """Returns the curve of a checkpoint; None = it has none.

    Raises:
        CheckpointError: the file is not what `mtv-world calibrate` writes.
    """
    return _load(Path(folder) / HORIZON, HorizonCurve)


def _save(path: Path, record: Any, what: str) -> Path:
    """Writes a dataclass into a checkpoint.

    Args:
        path: the file.
        record: the dataclass.
        what: what it is, for the error's text.

    Raises:
        CheckpointError: the folder cannot be written to.
    """
    try:
        write_whole(path, json.dumps(asdict(record), indent=1) + '\n')
    except OSError as error:
        raise CheckpointError(
            f"the {what} cannot be stored in the checkpoint '{path.parent}' ({error}); copy the "
            'checkpoint to a folder of your own and calibrate that one'
        ) from error
    return path


def _load(path: Path, kind: type[Record]) -> Record | None:
    """Returns a dataclass of a checkpoint, its lists as tuples; None = there is no such file.

    Args:
        path: the file.
        kind: the dataclass; it raises ValueError where its values do not fit each other.

    Raises:
        CheckpointError: the file is not what `mtv-world calibrate` writes.
    """
    if not path.is_file():
        return None
    try:
        values = read_json(path)
        _check_keys(values, kind)
        return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})
    except (OSError, ValueError, TypeError) as error:
        raise CheckpointError(
            f"'{path}' cannot be used: {error}; run 'mtv-world calibrate {path.parent} DATASET "
            "--out DIR' again, or delete the file"
        ) from error


def _check_keys(values: Any, kind: Any) -> None:
    known = [item.name for item in fields(kind)]
    if not isinstance(values, dict):
        raise ValueError('expected keys and values')
    for key in values:
        if key not in known:
            raise ValueError(f"unknown key '{key}'{nearest(key, known)}")
