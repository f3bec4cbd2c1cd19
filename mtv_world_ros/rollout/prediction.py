"""One imagined chunk with its intermediate results; the mean over several seeds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite, nan, sqrt
import time
from types import MappingProxyType

import numpy as np

from mtv_world_ros.core.data_types import (
    FloatArray,
    MultiViewVideo,
    ObjectMasks,
    Observation,
    SuccessEstimate,
)
from mtv_world_ros.core.estimate_words import cannot_tell, without_state
from mtv_world_ros.physics.episode_objects import ObjectForesight
from mtv_world_ros.success.calibration import HorizonCurve

#: 97.5 % quantiles of Student's t for 1 ... 9 degrees of freedom; 2 bounds it from there on
_T = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262)


class StageClock:
    """Durations of a chunk's stages: `seconds` by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """End a stage, which began at the end of the one before."""
        now = time.perf_counter()
        self.seconds[stage] = now - self._last
        self._last = now


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """One imagined chunk and its intermediate results.

    Attributes:
        start: the observation that the chunk starts from, at the model's size.
        video: the T predicted frames, frame k after command k; its times count from `stamp_ns`.
        seed: seed of the noise.
        positions: (T, J) commanded at these times [rad or m].
        trajectory_video: 1 + T frames of the drawn plan, frame 0 at the chunk's start; the model's
            control input where that is a video.
        start_masks: object masks of the chunk's start frame (T = 1).
        masks: object masks of the predicted frames.
        success: the estimate at the end of this chunk.
        stamp_ns: stamp of the rollout's observation [ns].
        chunk: index of this chunk in its rollout.
        num_chunks: chunks of the rollout.
        imagined_seconds: time from the last real frame to the last predicted one [s].
        horizon: measured J by horizon; None = not measured.
        segmenter: name of what found the masks.
        num_inference_steps: denoising steps of the chunk.
        foreseen: (K, 1 + T, O, 3) centres of the objects in each future at the chunk's start and
            at its frames [m]; None = nothing was foreseen.
        objects: the objects and their foreseen motion until the chunk's end.
        in_view: (V,) share of the states in which the view shows a tool.
        seconds: time spent by stage [s].
    """

    start: Observation
    video: MultiViewVideo
    seed: int
    positions: FloatArray
    trajectory_video: MultiViewVideo
    start_masks: ObjectMasks
    masks: ObjectMasks
    success: SuccessEstimate
    stamp_ns: int
    chunk: int
    num_chunks: int
    imagined_seconds: float
    horizon: HorizonCurve | None = None
    segmenter: str = ''
    num_inference_steps: int = 0
    foreseen: FloatArray | None = None
    objects: ObjectForesight | None = None
    in_view: FloatArray
    seconds: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))

    def trusted_seconds(self, level: float) -> float:
        """Return up to which time after the last real frame J is expected to be `level` [s].

        NaN = not measured for this checkpoint and segmenter.
        """
        if self.horizon is None or self.horizon.segmenter != self.segmenter:
            return nan
        return self.horizon.trusted_seconds(level)


def mean_of_seeds(predictions: Sequence[Prediction]) -> Prediction:
    """Return the first of a chunk's predictions with the mean estimate and the time of all."""
    if len(predictions) == 1:
        return predictions[0]
    seconds: Counter[str] = Counter()
    for prediction in predictions:
        seconds.update(prediction.seconds)
    return replace(
        predictions[0],
        success=mean_estimate([prediction.success for prediction in predictions]),
        seconds=MappingProxyType(dict(seconds)),
    )


def mean_estimate(estimates: Sequence[SuccessEstimate]) -> SuccessEstimate:
    """Return the mean over rollouts that differ in their seeds alone.

    `spread` is their standard deviation. The interval holds Student's interval of the mean, which
    bounds the mean of many rollouts of this world model, and the mean interval of one rollout:
    noise of the world model alone says nothing of what else is unknown. The mean abstains if most
    rollouts do. J and features are those of the first rollout.
    """
    first = estimates[0]
    known = [e.probability for e in estimates if isfinite(e.probability)]
    num = len(estimates)
    if num == 1:
        return first
    if 2 * len(known) <= num:
        reasons = next(e.reasons for e in estimates if not isfinite(e.probability))
        why = without_state(reasons[0])
        text = cannot_tell(f'{num - len(known)} of {num} seeds cannot: {why}')
        return replace(
            first,
            probability=nan,
            interval=(nan, nan),
            reasons=(text, *reasons[1:]),
            num_seeds=num,
            spread=nan,
        )
    mean = float(np.mean(known))
    spread = float(np.std(known, ddof=1)) if len(known) > 1 else nan
    degrees = len(known) - 1
    quantile = _T[degrees - 1] if 0 < degrees <= len(_T) else 2.262
    half = quantile * spread / sqrt(len(known)) if degrees else 1.0
    text = (
        f'mean of {len(known)} of {num} seeds, spread {spread:.2f}; '
        'the interval holds that of the mean, given the world model, and that of one seed'
    )
    ends = [e.interval for e in estimates if isfinite(e.probability)]
    own_low, own_high = np.mean(ends, axis=0).tolist()
    interval = (max(min(mean - half, own_low), 0.0), min(max(mean + half, own_high), 1.0))
    return replace(
        first,
        probability=mean,
        interval=interval,
        reasons=(text, *first.reasons),
        num_seeds=num,
        spread=spread,
    )
