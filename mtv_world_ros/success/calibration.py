"""A fitted logistic of the estimate's features, kept with the checkpoint that it is for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import exp, isfinite, nan
from pathlib import Path
from typing import Any

from mtv_world_ros.success.checkpoint_record import load_record, save_record

CALIBRATION = 'success_calibration.json'
#: features that only speak against success: how what moved was grasped and carried. An object
#: that stays where it was is grasped by nobody and still not a success.
DOUBTS = frozenset({'grasp', 'carry'})


def weighed(features: Mapping[str, float], name: str) -> float:
    """Returns a feature as it is weighed: of doubts only negative values; NaN = says nothing."""
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
        """Returns why it does not hold for a task and a segmenter; empty = it does."""
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
    return save_record(Path(folder) / CALIBRATION, calibration, 'calibration')


def load_calibration(folder: Path) -> Calibration | None:
    """Returns the calibration of a checkpoint; None = it has none.

    Raises:
        CheckpointError: the file is not what `mtv-world calibrate` writes.
    """
    return load_record(Path(folder) / CALIBRATION, Calibration)
