"""Fits the success estimate to episodes of known outcome, and scores it on left-out tasks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite, nan
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import ConfigError, MtvWorldError
from mtv_world_ros.evaluation.metrics.success_agreement import agreement, Judgement
from mtv_world_ros.evaluation.results import EpisodeResult
from mtv_world_ros.success.calibration import Calibration, weighed, Weights
from mtv_world_ros.success.doubts import NEAR_M
from mtv_world_ros.success.estimator import (
    capped,
    estimate_of_futures,
    STATED_WEIGHTS,
)
from mtv_world_ros.success.evidence import FEATURES
from mtv_world_ros.success.share_fit import share_logit, ShareEstimate, ShareFit

#: minimum number of episodes of known outcome
MIN_EPISODES = 8
#: maximum absolute bias of a fitted logistic; with equal labels it would be infinite
MAX_BIAS = 30.0
#: judgements with the stated weights, before the fit
BEFORE = 'before'
#: judgements by a fit without the task of the judged episode
AFTER = 'after'
#: judgements by a fit without the fault kind of the judged episode
AFTER_KINDS = 'after_kinds'
#: judgements by a fit without the simulated physics of the judged episode
AFTER_PHYSICS = 'after_physics'
#: judgements by the fit to all episodes: too good, because it contains the judged episode
FITTED = 'fitted'
#: judgements of recorded frames, by a fit to recorded frames
OBSERVED = 'observed'
#: judgements with only the last chunk imagined and no simulated motion, by a fit of their own
UNFORESEEN = 'unforeseen'
#: judgements with only the last chunk imagined
RESUMED = 'resumed'
#: fraction of episodes whose imagined frames are farther from the drawn motion than the limit
CONTRADICTING_FRACTION = 0.025
#: baseline: every episode is called a success
ALWAYS = 'always success'


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """An imagined episode of known outcome.

    Attributes:
        episode: name of the episode.
        task: name of the task.
        success: the true outcome.
        features: features of the estimate by seed; empty where it abstained.
        before: probabilities by seed with the stated weights; NaN = abstained.
        reasons: reasons of the first seed's estimate.
        kinds: faults of the policy that acted; empty = none, or not a scripted policy.
        physics: name of the simulated physics; empty = a real recording, or not stated.
        observed: features of the estimate on the recorded frames; empty where it abstained, or
            they were not judged.
        resumed: features of the estimate if only the last chunk is imagined.
    """

    episode: str
    task: str
    success: bool
    features: tuple[Mapping[str, float], ...]
    before: tuple[float, ...]
    reasons: tuple[str, ...]
    kinds: tuple[str, ...] = ()
    physics: str = ''
    observed: Mapping[str, float] = field(default_factory=dict)
    resumed: Mapping[str, float] = field(default_factory=dict)

    @property
    def as_observed(self) -> Sample:
        """Copy of the sample with recorded frames in place of imagined ones."""
        return replace(self, features=(self.observed,))

    @property
    def as_resumed(self) -> Sample:
        """Copy of the sample in which only the last chunk is imagined."""
        return replace(self, features=(self.resumed,))

    @property
    def as_unforeseen(self) -> Sample:
        """Copy of the sample judged by pictures alone; no features where they give no verdict."""
        is_judged = isfinite(self.resumed.get('margin', nan))
        return replace(self, features=({**self.resumed, 'foreseen': nan} if is_judged else {},))


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibrated:
    """Fitted calibration with the judgements of its samples.

    Attributes:
        calibration: fitted to all samples.
        samples: episodes of known outcome.
        judgements: a judgement of each sample, by the names above. `AFTER` leaves each task out
            of the fit that judges it, `AFTER_KINDS` each fault kind (of episodes without a fault
            their task), `AFTER_PHYSICS` each simulated physics. `OBSERVED` is that of the recorded
            frames and `UNFORESEEN` that with all but the last chunk seen and nothing foreseen,
            each by a fit of its own. `RESUMED`: with all but the last chunk seen. `FITTED`: on
            what it was fitted to, thus too good.
    """

    calibration: Calibration
    samples: tuple[Sample, ...]
    judgements: Mapping[str, tuple[Judgement, ...]]


def samples_of(
    runs: Sequence[Sequence[EpisodeResult]],
    kinds: Mapping[str, tuple[str, ...]] | None = None,
    physics: Mapping[str, str] | None = None,
) -> list[Sample]:
    """Return the samples of scored episodes whose outcome is known.

    Args:
        runs: runs of the same episodes, one run a seed.
        kinds: faults of the policies that acted, by episode; episodes may be missing.
        physics: names of the simulated physics, by episode; episodes may be missing.
    """
    known_kinds, known_physics = kinds or {}, physics or {}
    by_name = [{result.episode: result for result in run} for run in runs]
    samples = []
    for name, first in sorted(by_name[0].items()):
        found = [run[name] for run in by_name if name in run]
        if first.outcome in ('success', 'failure'):
            samples.append(
                Sample(
                    episode=name,
                    task=first.task,
                    success=first.outcome == 'success',
                    features=tuple(result.features for result in found),
                    before=tuple(result.probability for result in found),
                    reasons=first.reasons,
                    kinds=known_kinds.get(name, ()),
                    physics=known_physics.get(name, ''),
                    observed=first.observed,
                    resumed=first.resumed,
                )
            )
    return samples


def calibrate(
    samples: Sequence[Sample],
    *,
    segmenter: str,
    l2: float = 1.0,
    made: Mapping[str, str] | None = None,
) -> Calibrated:
    """Fit the calibration to imagined episodes of known outcome, and judge it.

    Args:
        samples: imagined episodes of known outcome.
        segmenter: name of the segmenter that found the masks.
        l2: strength of the penalty.
        made: command, date and machine, by heading.

    Raises:
        ConfigError: too few episodes, or all of one outcome.
    """
    _check(samples)
    fitted = _fit(samples, segmenter, l2)
    groups = [{s.task} for s in samples]
    fits = _fits_without(samples, groups, segmenter, l2)
    judgements = {
        BEFORE: tuple(_judged(s, _before(s)) for s in samples),
        AFTER: _judged_by(fits, samples),
        FITTED: tuple(_judged(s, _estimate(fitted, s)) for s in samples),
        ALWAYS: tuple(_judged(s, ShareEstimate(1.0, nan, nan)) for s in samples),
    }
    if any(sample.kinds for sample in samples):
        groups = [set(s.kinds) or {f'no fault, {s.task}'} for s in samples]
        fits = _fits_without(samples, groups, segmenter, l2)
        judgements[AFTER_KINDS] = _judged_by(fits, samples)
    if len({sample.physics for sample in samples}) > 1:
        places = [{s.physics} for s in samples]
        judgements[AFTER_PHYSICS] = _judged_by(
            _fits_without(samples, places, segmenter, l2), samples
        )
    special: dict[str, Any] = {}
    for name, others in (
        (OBSERVED, [sample.as_observed for sample in samples]),
        (UNFORESEEN, [sample.as_unforeseen for sample in samples]),
    ):
        if _tells(others):
            special[name] = Weights(**_weights(others, l2))
            of_others = _fits_without(others, groups, segmenter, l2)
            judgements[name] = _judged_by(of_others, others)
    if UNFORESEEN in judgements:
        resumed = _judged_by(fits, [sample.as_resumed for sample in samples])
        judgements[RESUMED] = tuple(
            one if isfinite(sample.resumed.get('foreseen', nan)) else other
            for sample, one, other in zip(samples, resumed, judgements[UNFORESEEN], strict=True)
        )
    scores = {name: agreement(found) for name, found in judgements.items()}
    calibration = Calibration(**fitted, **special, scores=scores, made=dict(made or {}))
    return Calibrated(calibration=calibration, samples=tuple(samples), judgements=judgements)


def _check(samples: Sequence[Sample]) -> None:
    usable = [sample for sample in samples if any(sample.features)]
    if not _tells(samples):
        raise ConfigError(
            f'{len(samples)} episodes have a known outcome, of which {len(usable)} could be '
            f'judged, {sum(s.success for s in usable)} of them successes; a calibration needs at '
            f'least {MIN_EPISODES} and both outcomes: collect some with --failures-of-ten 5'
        )


def _tells(samples: Sequence[Sample]) -> bool:
    """Return True if there are enough judged episodes, with both outcomes."""
    outcomes = [sample.success for sample in samples if any(sample.features)]
    return len(outcomes) >= MIN_EPISODES and len(set(outcomes)) == 2


def _fits_without(
    samples: Sequence[Sample], groups: Sequence[set[str]], segmenter: str, l2: float
) -> list[dict[str, Any] | None]:
    """Return for each sample the fit to those of other groups; None = of one outcome."""
    fits: dict[frozenset[str], dict[str, Any] | None] = {}
    for left_out in set(map(frozenset, groups)):
        others = [
            sample
            for sample, group in zip(samples, groups, strict=True)
            if not group & left_out and any(sample.features)
        ]
        enough = len({sample.success for sample in others}) == 2
        fits[left_out] = _fit(others, segmenter, l2) if enough else None
    return [fits[frozenset(group)] for group in groups]


def _judged_by(
    fits: Sequence[dict[str, Any] | None], samples: Sequence[Sample]
) -> tuple[Judgement, ...]:
    """Return each sample judged by a fit of its own."""
    return tuple(
        _judged(sample, _NO_ESTIMATE if fit is None else _estimate(fit, sample))
        for fit, sample in zip(fits, samples, strict=True)
    )


def _fit(samples: Sequence[Sample], segmenter: str, l2: float) -> dict[str, Any]:
    """Return the fields of `Calibration`."""
    futures = fit_futures(samples, l2)
    return {
        **_weights(samples, l2),
        'futures': futures,
        'segmenter': segmenter,
        'tasks': tuple(sorted({sample.task for sample in samples})),
        'num_episodes': len(samples),
        'num_seeds': max(len(sample.before) for sample in samples),
        'l2': l2,
    }


def fit_futures(samples: Sequence[Sample], l2: float) -> ShareFit | None:
    """Fit the estimate to the share of successful futures; None = too few samples have one."""
    # rollouts of several seeds are of one episode with one outcome: one row, not several
    means = [
        (float(np.mean(known)), sample.success)
        for sample in samples
        if (known := [o for o in map(share_logit, sample.features) if isfinite(o)])
    ]
    odds = np.array([mean for mean, _ in means])
    labels = np.array([success for _, success in means], np.bool_)
    if len(odds) < MIN_EPISODES or len(set(labels.tolist())) < 2:
        return None
    scale = max(float(odds.std()), 1e-6)
    rows = odds[:, None] / scale
    # where few episodes tell, the share stays as it is: a slope of 1
    logistic = fit_logistic(rows, labels, l2=l2, prior=np.array([scale]), non_negative=True)
    likely = logistic.probability(rows)
    design = np.column_stack([np.ones(len(rows)), rows])
    curvature = (design.T * (likely * (1 - likely))) @ design + np.diag([1e-6, l2])
    covariance = np.linalg.inv(curvature)
    gaps = np.array([f.get('picture_gap', nan) for sample in samples for f in sample.features])
    gaps = gaps[np.isfinite(gaps)]
    limit = float(np.quantile(gaps, 1 - CONTRADICTING_FRACTION)) if len(gaps) else 0.0
    return ShareFit(
        bias=logistic.bias,
        slope=float(logistic.weights[0]) / scale,
        covariance=(
            float(covariance[0, 0]),
            float(covariance[0, 1]) / scale,
            float(covariance[1, 1]) / scale**2,
        ),
        num_episodes=len(odds),
        max_picture_gap_m=max(limit, NEAR_M),
    )


def _weights(samples: Sequence[Sample], l2: float) -> dict[str, Any]:
    """Return the fields of `Weights`."""
    rows, labels = _design(samples)
    with np.errstate(invalid='ignore'):
        known = np.isfinite(rows)
        counts = np.maximum(known.sum(0), 1)
        means = np.where(known, rows, 0.0).sum(0) / counts
        spread = np.sqrt((np.where(known, rows - means, 0.0) ** 2).sum(0) / counts)
    scales = np.where(spread > 1e-6, spread, 1.0)
    standard = np.where(known, (rows - means) / scales, 0.0)
    # imagination rarely shows what failed, as an object left behind: there, what was stated holds
    prior = scales * [STATED_WEIGHTS.get(name, 0.0) for name in FEATURES]
    logistic = fit_logistic(standard, labels, l2=l2, prior=prior, non_negative=True)
    return {
        'features': FEATURES,
        'means': tuple(means.tolist()),
        'scales': tuple(scales.tolist()),
        'weights': tuple(logistic.weights.tolist()),
        'bias': logistic.bias,
    }


def _design(samples: Sequence[Sample]) -> tuple[FloatArray, BoolArray]:
    """Return (N, F) features, NaN where one says nothing, and (N,) outcomes.

    Abstentions are left out.
    """
    pairs = [(f, sample.success) for sample in samples for f in sample.features if f]
    rows = [[weighed(features, name) for name in FEATURES] for features, _ in pairs]
    return np.array(rows, np.float64), np.array([success for _, success in pairs], np.bool_)


_NO_ESTIMATE = ShareEstimate(nan, nan, nan)


def _estimate(fit: dict[str, Any], sample: Sample) -> ShareEstimate:
    """Return the mean estimate of a sample over the seeds with a verdict."""
    calibration = Calibration(**fit)
    return _mean_of([_one_estimate(calibration, features) for features in sample.features])


def _one_estimate(calibration: Calibration, features: Mapping[str, float]) -> ShareEstimate:
    if not features:
        return _NO_ESTIMATE
    if isfinite(share_logit(features)) and calibration.futures is not None:
        return estimate_of_futures(calibration.futures, features)
    return ShareEstimate(capped(calibration.probability(features), features), nan, nan)


def _before(sample: Sample) -> ShareEstimate:
    """Return the mean estimate with the stated weights, or of the share of futures itself."""
    return _mean_of([ShareEstimate(probability, nan, nan) for probability in sample.before])


def _mean_of(estimates: Sequence[ShareEstimate]) -> ShareEstimate:
    """Return the mean over the seeds with a verdict; NaN if half of the seeds or more abstain."""
    known = [one for one in estimates if isfinite(one.probability)]
    if 2 * len(known) <= len(estimates):
        return _NO_ESTIMATE
    return ShareEstimate(*np.mean(known, axis=0).tolist())


def _judged(sample: Sample, estimate: ShareEstimate) -> Judgement:
    outcome = 'success' if sample.success else 'failure'
    return Judgement(
        probability=estimate.probability,
        outcome=outcome,
        interval=(estimate.low, estimate.high),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Logistic:
    """P(true) = 1 / (1 + exp(-(weights x + bias))): weights (F,), bias within +-`MAX_BIAS`."""

    weights: FloatArray
    bias: float

    def probability(self, features: FloatArray) -> FloatArray:
        """Return the probabilities (N,) of features (N, F)."""
        return expit(features @ self.weights + self.bias)


def fit_logistic(
    features: FloatArray,
    labels: BoolArray,
    *,
    l2: float = 1.0,
    prior: FloatArray | None = None,
    non_negative: bool = False,
) -> Logistic:
    """Minimise -log likelihood + l2 / 2 * |weights - prior|^2 (scikit-learn's with C = 1 / l2).

    The bias is not penalised.

    Args:
        features: (N, F) features of the samples.
        labels: (N,) outcomes of the samples, 0 or 1.
        l2: strength of the penalty; positive, so that there is one minimum.
        prior: (F,) prior mean of the weights; None = zero.
        non_negative: whether no weight may be below 0, for features that grow with the
            probability.

    Raises:
        ConfigError: there are no rows, or `l2` is not positive.
        MtvWorldError: the minimum was not reached.
    """
    if not len(features) or l2 <= 0:
        raise ConfigError(
            f'a logistic is fitted to {len(features)} episodes with l2 = {l2}; it needs at least '
            'one episode and a positive l2'
        )
    num = features.shape[1]
    centre = np.zeros(num) if prior is None else np.asarray(prior, np.float64)

    def loss(theta: FloatArray) -> tuple[float, FloatArray]:
        logits, away = features @ theta[:-1] + theta[-1], theta[:-1] - centre
        value = np.logaddexp(0, logits).sum() - logits[labels].sum() + l2 / 2 * away @ away
        slope = expit(logits) - labels
        return float(value), np.append(slope @ features + l2 * away, slope.sum())

    start = np.append(np.maximum(centre, 0.0) if non_negative else centre, 0.0)
    bounds = [(0.0 if non_negative else None, None)] * num + [(-MAX_BIAS, MAX_BIAS)]
    # stops at the gradient alone: the value is flat near the minimum
    options = {'ftol': 0.0, 'gtol': 1e-9, 'maxiter': 10_000, 'maxfun': 100_000, 'maxcor': 30}
    theta = minimize(loss, start, jac=True, method='L-BFGS-B', bounds=bounds, options=options).x
    left = _slope_within(theta, loss(theta)[1], bounds)
    if left > 1e-4 * max(1.0, l2, float(np.abs(features).sum(0).max(initial=0))):
        raise MtvWorldError(
            f'the logistic fit to {len(features)} episodes did not reach its minimum (gradient '
            f'{left:.2g}, l2 {l2:g}); leave out episodes with extreme margins'
        )
    return Logistic(weights=theta[:-1], bias=float(theta[-1]))


def _slope_within(
    theta: FloatArray, gradient: FloatArray, bounds: Sequence[tuple[float | None, float | None]]
) -> float:
    """Return largest slope along which `theta` could still go down without leaving its bounds."""
    low, high = np.array(bounds, np.float64).T  # None becomes NaN: no bound
    blocked = ((theta <= low) & (gradient > 0)) | ((theta >= high) & (gradient < 0))
    return float(np.abs(np.where(blocked, 0.0, gradient)).max())
