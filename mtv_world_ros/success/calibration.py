"""Fit that `mtv-world fit success` stores with a checkpoint: logistic and trusted horizon."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import json
from math import exp, isfinite, isnan, nan
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self

from pydantic import Field, model_validator, WrapValidator

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.config import ListOf, Model, Number, Schema, Seconds
from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.errors import CheckpointError, ConfigError
from mtv_world_ros.core.files import write_whole
from mtv_world_ros.success.fitted_to import FittedTo, Setting
from mtv_world_ros.success.share_fit import ShareFit

CALIBRATION = 'success_calibration.json'
HORIZON = 'horizon.json'
#: end of the names of files that were fitted to rollouts without foreseen object motion, in the
#: folder of a checkpoint that can foresee it
PICTURES = '_pictures'
#: features that only speak against success: how a moved object was grasped and carried. An object
#: that never moves needs no grasp, which is no sign of success.
DOUBTS = frozenset({'grasp', 'carry'})


def _or_nan(value: Any, validate: Any) -> float:
    return value if isinstance(value, float) and isnan(value) else validate(value)


#: of Jaccard indices; NaN = not known
_Known = Annotated[float, Field(ge=-1, le=1), WrapValidator(_or_nan)]


def weighed(features: Mapping[str, float], name: str) -> float:
    """Return a feature's value for the logistic; NaN = unknown.

    Doubts count only if negative.
    """
    value = features.get(name, nan)
    return min(value, 0.0) if name in DOUBTS else value


class Weights(Schema):
    """Logistic regression on F standardised features.

    Attributes:
        features: names of the F features.
        means: (F,) mean of each feature; takes the place of a feature that is NaN.
        scales: (F,) standard deviation of each feature.
        weights: (F,) change of the log odds per standard deviation.
        bias: log odds of an episode whose features are all at their mean.
    """

    features: ListOf[str]
    means: ListOf[Number]
    scales: ListOf[Number]
    weights: ListOf[Number]
    bias: Number

    @model_validator(mode='after')
    def _are_equally_many(self) -> Self:
        lengths = {len(self.means), len(self.scales), len(self.weights), len(self.features)}
        if len(lengths) != 1 or not self.features:
            raise ValueError('features, means, scales and weights are not equally many')
        if min(self.scales) <= 0:
            raise ValueError('a scale is not positive')
        return self

    def probability(self, features: Mapping[str, float]) -> float:
        """Return the probability of success; features that are NaN count as the mean."""
        logit = self.bias
        for name, mean, scale, weight in zip(
            self.features, self.means, self.scales, self.weights, strict=True
        ):
            value = weighed(features, name)
            logit += weight * (value - mean) / scale if isfinite(value) else 0.0
        return 1.0 / (1.0 + exp(-max(min(logit, 50.0), -50.0)))


class Calibration(Weights):
    """Calibration of the success estimate, fitted by `mtv-world fit success`.

    The weights are those of imagined frames. They are not used where object motion is simulated
    and drawn into the control: the frames show what was drawn, and are no second witness.

    Attributes:
        futures: fit for rollouts with simulated object motion, where the share of futures that
            succeed decides; None = older file, or rollouts without simulated motion.
        observed: weights for frames of the same episodes that were really seen; None = those of
            imagined frames.
        unforeseen: weights for imagined frames without foreseen motion, as of a rollout that
            begins in mid-episode; None = those of frames with foreseen motion.
        segmenter: name of the segmenter whose masks were fitted on.
        tasks: names of the tasks that were fitted on.
        num_episodes: number of episodes that were fitted on.
        num_seeds: number of rollouts of each episode.
        l2: strength of the penalty on the difference from `estimator.STATED_WEIGHTS`.
        scores: scores before and after the fit, the latter on tasks that were left out of it.
        made: command, date, machine.
        fitted_to: robot, cameras and foresight of these episodes; None = it does not say, as
            those of before 0.2.0, whose foresight was another.
    """

    futures: ShareFit | None = None
    observed: Weights | None = None
    unforeseen: Weights | None = None
    segmenter: str
    tasks: ListOf[str]
    num_episodes: int
    num_seeds: int = 1
    l2: Number = 1.0
    scores: Mapping[str, Mapping[str, Any]] = {}
    made: Mapping[str, str] = {}
    fitted_to: FittedTo | None = None

    def given(self, is_real: bool) -> Weights:
        """Return the weights for real frames, or for imagined ones without simulated motion."""
        if is_real:
            return self.observed or self
        return self if self.is_of_pictures else self.unforeseen or self

    @property
    def is_of_pictures(self) -> bool:
        """True if the weights were fitted to rollouts without foreseen object motion."""
        return self.fitted_to is not None and not self.fitted_to.foresight

    @property
    def optimism(self) -> str:
        """Share of failures that the fit's judgements of pictures alone call a success, in words.

        Each task is left out of the fit that judges it. Empty where motion is foreseen, or where
        the file does not say.
        """
        rate = self.scores.get('after', {}).get('false_success_rate')
        if not self.is_of_pictures or rate is None or not isfinite(rate):
            return ''
        return (
            f'{rate:.0%} of the failures that it judged of tasks left out of the fit were called '
            'a success'
        )

    def objection(self, task: str, segmenter: str) -> str:
        """Return why the weights do not hold for a task and segmenter; empty = they hold."""
        if segmenter != self.segmenter:
            return f"fitted with the segmenter '{self.segmenter}', not with '{segmenter}'"
        if task not in self.tasks:
            return f"fitted on {len(self.tasks)} tasks without '{task}'"
        return ''

    def elsewhere(
        self, setting: Setting, cameras: Sequence[CameraModel], *, is_foreseen: bool
    ) -> str:
        """Return how the setting differs from that of the fit; empty = it does not.

        Its weights are used all the same: stated ones know less. Arguments as in
        `FittedTo.objection`.
        """
        if self.fitted_to is not None:
            if not (is_foreseen or self.is_of_pictures or self.unforeseen):
                return 'fitted to rollouts with foreseen object motion'
            return self.fitted_to.objection(setting, cameras, is_foreseen=is_foreseen)
        if not is_foreseen:
            return ''
        version = self.made.get('versions', 'an unknown version').split(',')[0]
        return f'fitted with the foresight of {version}'


class HorizonCurve(Schema):
    """Mean J of moving objects over time, in episodes imagined from their first frame.

    Attributes:
        period_s: period between frames [s]; frame k is `(k + 1) * period_s` ahead.
        values: (T,) mean J.
        lower: (T,) lower end of the 95 % interval over episodes; 0 where too few reach it.
        segmenter: name of the segmenter whose masks were fitted on.
        num_episodes: number of episodes of the curve.
        made: command, date, machine.
    """

    period_s: Seconds
    values: ListOf[_Known]
    lower: ListOf[_Known]
    segmenter: str
    num_episodes: int
    made: Mapping[str, str] = {}

    @model_validator(mode='after')
    def _are_equally_long(self) -> Self:
        if len(self.values) != len(self.lower):
            raise ValueError('values and lower differ in length')
        return self

    def trusted_seconds(self, level: float) -> float:
        """Return the time until which J is expected to stay at least `level` [s].

        By the lower bound, at every frame up to it; 0 = not even at the first. The curve's end
        is the most that is known.
        """
        num_trusted = 0
        for value in self.lower:
            if not (isfinite(value) and value >= level):
                break
            num_trusted += 1
        return num_trusted * self.period_s


#: in a checkpoint's folder
_FILES: dict[type[Schema], str] = {Calibration: CALIBRATION, HorizonCurve: HORIZON}
#: names of all files that fits write, of both kinds of rollouts
FIT_FILES = tuple(
    str(Path(name).with_stem(Path(name).stem + end))
    for name in _FILES.values()
    for end in ('', PICTURES)
)


def fit_path(folder: Path, kind: type[Schema], *, of_pictures: bool = False) -> Path:
    """Return the file of a `Calibration` or `HorizonCurve` in a checkpoint's folder.

    Args:
        folder: folder of the checkpoint.
        kind: `Calibration` or `HorizonCurve`.
        of_pictures: the fit to rollouts without foreseen object motion, of a checkpoint that can
            foresee it.
    """
    path = Path(folder) / _FILES[kind]
    return path.with_stem(path.stem + PICTURES) if of_pictures else path


def save_fit(folder: Path, fit: Calibration | HorizonCurve, *, of_pictures: bool = False) -> Path:
    """Write a fit into a checkpoint; return the file. Arguments as in `fit_path`.

    Raises:
        CheckpointError: the folder cannot be written to.
    """
    path = fit_path(folder, type(fit), of_pictures=of_pictures)
    try:
        write_whole(path, json.dumps(fit.model_dump(), indent=1) + '\n')
    except OSError as error:
        what = 'calibration' if isinstance(fit, Calibration) else 'horizon'
        raise CheckpointError(
            f"the {what} cannot be stored in the checkpoint '{path.parent}' ({error}); copy the "
            'checkpoint to a folder of your own and calibrate that one'
        ) from error
    return path


class Fits(NamedTuple):
    """Fit of a checkpoint to rollouts of one kind; None = not fitted."""

    calibration: Calibration | None = None
    horizon: HorizonCurve | None = None


def load_fits(folder: Path, *, of_pictures: bool = False) -> Fits:
    """Return the fits of a checkpoint to rollouts of one kind. Arguments as in `fit_path`.

    Before the release of 0.2.0, `calibrate --no-foresight` wrote its fits to the files of fits
    with foresight.

    Raises:
        CheckpointError: as in `load_fit`.
    """
    found = Fits(
        load_fit(folder, Calibration, of_pictures=of_pictures),
        load_fit(folder, HorizonCurve, of_pictures=of_pictures),
    )
    if of_pictures and found.calibration is None:
        older = load_fits(folder)
        if older.calibration is not None and older.calibration.is_of_pictures:
            return older
    return found


def load_fit(folder: Path, kind: type[Model], *, of_pictures: bool = False) -> Model | None:
    """Return the `Calibration` or `HorizonCurve` of a checkpoint; None = it has none.

    Arguments as in `fit_path`.

    Raises:
        CheckpointError: the file is not what `mtv-world fit success` writes.
    """
    path = fit_path(folder, kind, of_pictures=of_pictures)
    if not path.is_file():
        return None
    try:
        return kind(**read_json(path))
    except (OSError, ValueError, TypeError, ConfigError) as error:
        raise CheckpointError(
            f"'{path}' cannot be used: {error}; run 'mtv-world fit success {path.parent} DATASET "
            "--out DIR' again, or delete the file"
        ) from error
