"""Probability that the task succeeds, from masks and foreseen motions; may abstain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from math import exp, isfinite, isnan, nan
from typing import NamedTuple

import numpy as np

from mtv_world_ros.core.data_types import (
    CameraModel,
    FloatArray,
    FutureEvidence,
    SuccessEstimate,
)
from mtv_world_ros.core.errors import CannotTell, ConfigError
from mtv_world_ros.core.estimate_words import cannot_tell
from mtv_world_ros.physics.foreseen_motions import ForeseenMotions
from mtv_world_ros.success.calibration import Calibration, DOUBTS, weighed
from mtv_world_ros.success.doubts import shrunk
from mtv_world_ros.success.evidence import (
    clipped,
    Evidence,
    gather,
    LIMITS,
    MAX_MARGIN,
    view_mean,
)
from mtv_world_ros.success.fitted_to import Setting
from mtv_world_ros.success.footage_memory import Footage, FootageMemory, remember
from mtv_world_ros.success.foreseen import (
    foreseen_ends,
    foreseen_feature,
    ForeseenEnds,
    picture_gap,
    PictureGap,
)
from mtv_world_ros.success.relations import Margin
from mtv_world_ros.success.share_fit import ShareEstimate, ShareFit
from mtv_world_ros.success.situation import grippers_open, grippers_released
from mtv_world_ros.success.task import load_tasks, match_task, object_called, TaskSpec
from mtv_world_ros.success.trust import fitted_here, not_fitted_here, odd_sizes, OtherCell
from mtv_world_ros.success.views import Views
from mtv_world_ros.vision.segmenters.segmenter import Segmenter

#: an estimate from here on is called a success. A false success costs more than a false failure,
#: so that more than an even chance is required
SUCCESS_FROM = 0.75
#: an estimate below this is called a failure; between the two, the verdict is open
FAILURE_BELOW = 0.5


def verdict(probability: float, interval: tuple[float, float] = (nan, nan)) -> float:
    """Return 1 = a success, 0 = a failure, NaN = open, or the estimator abstained.

    The verdict is open if the probability is between `FAILURE_BELOW` and `SUCCESS_FROM`, or if
    the interval reaches the opposite verdict.

    Args:
        probability: probability of success; NaN = abstained.
        interval: interval of the probability; NaN = not known.
    """
    low, high = interval
    if probability >= SUCCESS_FROM:
        return nan if low < FAILURE_BELOW else 1.0
    if probability < FAILURE_BELOW:
        return nan if high >= SUCCESS_FROM else 0.0
    return nan


def verdict_word(probability: float, interval: tuple[float, float] = (nan, nan)) -> str:
    """Return `success`, `failure`, `open`, or `abstains` where the probability is NaN."""
    if isnan(probability):
        return 'abstains'
    return {1.0: 'success', 0.0: 'failure'}.get(verdict(probability, interval), 'open')


__all__ = ['JudgedChunk', 'SuccessEstimator', 'load_tasks']

#: objection to calibrations of earlier versions
_COUNTED_TWICE = (
    'the fit of this checkpoint counts frames as evidence, too, although motion was drawn into '
    'them (run mtv-world fit success again)'
)
#: remark on an estimate without imagined frames
_AHEAD = 'foreseen: without imagined frames, which can only widen it'
_SHARE = 'the share of simulated futures that succeed'
_STATED = 'a logistic with stated weights, given the world model'
#: largest probability of a task that cannot be done yet: a gripper that has to be open is closed,
#: or an object that has to move has not moved
UNDONE_PROBABILITY = 0.1


#: logit per unit of a feature, used where no calibration holds; see `evidence.FEATURES` and
#: `calibration.weighed`
STATED_WEIGHTS = {'margin': 1.5, 'goal': 1.0, 'grasp': 8.0, 'carry': 0.5}


def stated_probability(features: Mapping[str, float]) -> float:
    """Return the logistic of the features by `STATED_WEIGHTS`; NaN features do not count."""
    terms = [weight * weighed(features, name) for name, weight in STATED_WEIGHTS.items()]
    return 1.0 / (1.0 + exp(-sum(term for term in terms if isfinite(term))))


def capped(probability: float, features: Mapping[str, float]) -> float:
    """Return the probability, small where a gripper is still closed or nothing has moved."""
    closed = features.get('released', nan) == 0.0
    # a rollout may begin where the task is all but done: then the margin is small
    left = features.get('moved', nan) == 0.0 and features.get('margin', nan) <= -MAX_MARGIN
    if isfinite(features.get('foreseen', nan)):
        left = False  # simulated motion tells; frames show the motion that was drawn
    return min(probability, UNDONE_PROBABILITY) if closed or left else probability


#: reason against an estimate while a gripper has not let go, by `TaskSpec.gripper`
_STILL_CLOSED = {
    'open': 'a gripper is still closed (a task with `gripper: released` allows it away from what '
    'it moved, one with `gripper: any` everywhere)',
    'released': 'a gripper is still closed at what it moved (`gripper: any` allows that)',
}


def estimate_of_futures(
    fit: ShareFit, features: Mapping[str, float], *, is_fitted: bool = True
) -> ShareEstimate:
    """Return the probability of success from the features of simulated futures.

    Frames count where they contradict the drawn motion: the estimate is then less sure. Futures
    whose simulation was lost may have succeeded or failed: the interval holds both.

    Args:
        fit: fit of the share of futures that succeed.
        features: features of an estimate: `foreseen`, `futures`, `lost`, `released` and
            `picture_gap`.
        is_fitted: contact parameters were fitted in this robot cell.
    """
    share, number = (1 + features['foreseen']) / 2, features['futures']
    probability, low, high = fit.estimate(share, number, is_fitted=is_fitted)
    if features.get('picture_gap', nan) > fit.max_picture_gap_m:
        probability, (low, high) = shrunk(probability, (low, high))
    if features.get('released', nan) == 0.0:
        low, probability = 0.0, min(probability, UNDONE_PROBABILITY)
    num_lost = features.get('lost', 0.0)
    if num_lost:
        total = number + num_lost
        for num_done in (share * number, share * number + num_lost):
            whole = {**features, 'foreseen': 2 * num_done / total - 1, 'futures': total, 'lost': 0}
            side = estimate_of_futures(fit, whole, is_fitted=is_fitted)
            low, high = min(low, side.low), max(high, side.high)
    return ShareEstimate(probability, low, max(high, probability))


class _FutureVerdict(NamedTuple):
    """Estimate of simulated futures."""

    fit: ShareFit
    with_pictures: ShareEstimate
    alone: FutureEvidence
    trust: str
    is_calibrated: bool


class JudgedChunk(NamedTuple):
    """The estimate after a chunk, and the memory for the next chunk."""

    estimate: SuccessEstimate
    memory: FootageMemory


class SuccessEstimator:
    """Estimates the success of rollouts of known tasks."""

    def __init__(
        self,
        tasks: Sequence[TaskSpec] = (),
        task: str | None = None,
        calibration: Calibration | None = None,
        segmenter: Segmenter | None = None,
        setting: Setting | None = None,
    ) -> None:
        """Set the tasks that may be judged.

        Args:
            tasks: tasks that an instruction may match.
            task: name of the one to judge; default: the one the instruction matches. Where the
                instruction names no objects for it, they take the task's placeholders in order.
            calibration: fitted weights, used where they hold.
            segmenter: finds the masks.
            setting: robot and foresight in use; None = those of the calibration.

        Raises:
            ConfigError: `task` is not among `tasks`.
        """
        names = [known.name for known in tasks]
        if task is not None and task not in names:
            raise ConfigError.unknown(
                'task',
                task,
                sorted(names),
                is_not=' is not known',
                listed='; known are',
                advice=' (add a file to config/tasks)',
            )
        self.tasks = tuple(known for known in tasks if task in (None, known.name))
        self.is_given = task is not None
        self.calibration = calibration
        self.setting = setting
        self.segmenter = '' if segmenter is None else segmenter.name

    def with_calibration(self, calibration: Calibration | None) -> SuccessEstimator:
        """Return an estimator of the same tasks with other fitted weights; None = with none."""
        other = copy(self)
        other.calibration = calibration
        return other

    def for_task(self, task: TaskSpec | None) -> SuccessEstimator:
        """Return an estimator of the task that an episode defines.

        Args:
            task: definition of the task; None = the episode defines none. A task that the
                estimator was given goes before it.
        """
        if task is None or self.is_given:
            return self
        other = copy(self)
        other.tasks = (task,)
        return other

    def estimate(
        self,
        footage: Footage,
        instruction: str = '',
        memory: FootageMemory | None = None,
        foreseen: ForeseenMotions | None = None,
        *,
        is_real: bool = False,
        cell: OtherCell | None = None,
    ) -> JudgedChunk:
        """Return the probability that the task is done at the end of a rollout's chunk.

        `jaccard` holds J of every subject with its goal mask (its first mask of the rollout,
        moved to where the relation wants it), and J of every other object with its first mask.

        Args:
            footage: masks and poses of the chunk.
            instruction: text for the robot; selects the task and its objects.
            memory: memory of the chunks before; None = the chunk is the rollout's first.
            foreseen: motions of the objects up to the chunk's end.
            is_real: whether the frames are real, not imagined.
            cell: the robot cell, where contact was not fitted in it; None = nothing is known.
        """
        memory = remember(memory, footage)
        try:
            task, bound = self._task(instruction, footage.masks.names)
            _check_views(task, footage)
        except CannotTell as reason:
            views = Views(footage=footage, memory=memory, used=())
            return JudgedChunk(_abstains(reason, views, []), memory)
        views = Views(footage=footage, memory=memory, used=task.views)
        subjects = [
            views.names.index(bound[role]) for role in task.movers if bound[role] in views.names
        ]
        starts = memory.points[:, 0]
        ends = None if foreseen is None else foreseen_ends(foreseen, task, bound, starts)
        try:
            evidence = gather(views, task, bound)
        except CannotTell as reason:
            if ends is None:
                return JudgedChunk(_abstains(reason, views, subjects), memory)
            evidence = Evidence.none(reason)
        if ends is None or foreseen is None:
            return JudgedChunk(self._judge(task, evidence, views, subjects, is_real), memory)
        gap = picture_gap(views, foreseen, [bound[role] for role in task.movers])
        cell = _with_sizes(cell, task, bound, foreseen)
        judged = self._judge_futures(task, evidence, views, subjects, ends, gap, cell)
        return JudgedChunk(judged, memory)

    def foresee(
        self, foreseen: ForeseenMotions, instruction: str, memory: FootageMemory | None = None
    ) -> ForeseenEnds | None:
        """Return the outcome of the task at the end of motions; None = not known.

        Args:
            foreseen: motions since the objects were found.
            instruction: text for the robot; selects the task and its objects.
            memory: memory of the rollout; None = the rollout begins where they were found.
        """
        try:
            task, bound = self._task(instruction, foreseen.names)
        except CannotTell:
            return None
        starts = foreseen.points[0, 0] if memory is None else memory.points[:, 0]
        return foreseen_ends(foreseen, task, bound, starts)

    def ahead(
        self,
        foreseen: ForeseenMotions,
        instruction: str,
        memory: FootageMemory | None,
        cameras: Sequence[CameraModel],
        *,
        knows_grippers: bool = True,
        cell: OtherCell | None = None,
    ) -> SuccessEstimate | None:
        """Return the estimate at the end of motions before frames are imagined.

        The estimate with the frames has an interval that holds this one.

        Args:
            foreseen: motions since the objects were found.
            instruction: text for the robot; selects the task and its objects.
            memory: memory of the rollout; None = the rollout begins where they were found.
            cameras: cameras of the start frame.
            knows_grippers: whether the openings of grippers are known.
            cell: see `estimate`.

        Returns:
            The estimate, whose Jaccard indices are NaN; None = motions do not tell.
        """
        ends = self.foresee(foreseen, instruction, memory)
        if ends is None:
            return None
        task, bound = self._task(instruction, foreseen.names)
        features = {
            'foreseen': foreseen_feature(ends),
            'futures': ends.num_effective,
            'lost': float(ends.num_lost),
            'picture_gap': nan,
            'released': 1.0 if knows_grippers else nan,  # futures have it in their outcomes
        }
        cell = _with_sizes(cell, task, bound, foreseen)
        used = [camera for camera in cameras if not task.views or camera.view in task.views]
        said = self._futures(task, ends, features, used, cell)
        return SuccessEstimate(
            probability=said.alone.probability,
            interval=said.alone.interval,
            jaccard=np.full((len(cameras), len(foreseen.names)), nan),
            reasons=(ends.text, _AHEAD, said.trust),
            features=features,
            is_calibrated=said.is_calibrated,
            futures=said.alone,
        )

    def _task(self, instruction: str, names: tuple[str, ...]) -> tuple[TaskSpec, dict[str, str]]:
        """Return the task and its objects; a given task takes the objects in their order."""
        matched = match_task(self.tasks, instruction)
        if matched is not None:
            task, said = matched
            called = {role: object_called(name, names) for role, name in said.items()}
            return task, {role: called[role] or name for role, name in said.items()}
        if self.is_given and len(names) == len(self.tasks[0].roles):
            return self.tasks[0], dict(zip(self.tasks[0].roles, names, strict=True))
        known = '; '.join(task.instruction for task in self.tasks) or 'none'
        raise CannotTell(
            f"'{instruction}' is no known task ('mtv-world task' drafts one; known: {known})"
        )

    def _judge_futures(
        self,
        task: TaskSpec,
        evidence: Evidence,
        views: Views,
        subjects: Sequence[int],
        ends: ForeseenEnds,
        gap: PictureGap | None,
        cell: OtherCell,
    ) -> SuccessEstimate:
        """Return the estimate of simulated futures, which decide alone."""
        features = {
            **evidence.features,
            'foreseen': foreseen_feature(ends),
            'futures': ends.num_effective,
            'lost': float(ends.num_lost),
            'picture_gap': nan if gap is None else gap.distance_m,
            'released': _released(task, views, subjects),
        }
        cameras = [camera for camera in views.footage.cameras if camera.view in views.used]
        said = self._futures(task, ends, features, cameras, cell)
        reasons = [ends.text]
        if gap is not None and gap.distance_m > said.fit.max_picture_gap_m:
            reasons.append(gap.text)
        reasons += self._shown(task, evidence, views)
        reasons += self._gripper_reasons(task, views, features)
        reasons.append(said.trust)
        found = said.with_pictures
        numbers = (found.low, found.probability, found.high)
        judged = _estimate(numbers, evidence, views, reasons, features, said.is_calibrated)
        return replace(judged, futures=said.alone)

    def _futures(
        self,
        task: TaskSpec,
        ends: ForeseenEnds,
        features: Mapping[str, float],
        cameras: Sequence[CameraModel],
        cell: OtherCell,
    ) -> _FutureVerdict:
        """Return the estimate of simulated futures and the trust in it.

        Args:
            task: task that is judged.
            ends: outcomes of the futures.
            features: see `estimate_of_futures`.
            cameras: cameras whose views the task uses.
            cell: the robot cell, where contact was not fitted in it.
        """
        fit, elsewhere = ShareFit(), self._elsewhere(cameras, True)
        objection = self._objection(task)
        if not objection and self.calibration is not None:
            if self.calibration.futures is None:
                objection = _COUNTED_TWICE
            else:
                fit = self.calibration.futures
        trust = self._trust(objection, elsewhere, is_real=False, stated=_SHARE)
        if not ends.is_fitted:
            # the fit is to futures of a known place; those of a prior are wider
            fit = ShareFit(max_picture_gap_m=fit.max_picture_gap_m)
            unknown = self.calibration is None or self.setting is None
            trust = cell.sentence(None if unknown else objection or elsewhere or cell.sizes)
        is_unchecked = self._is_release_unknown(task, features)
        alone = self._of_futures(fit, {**features, 'picture_gap': nan}, ends, is_unchecked)
        return _FutureVerdict(
            fit=fit,
            with_pictures=self._of_futures(fit, features, ends, is_unchecked),
            alone=FutureEvidence(
                outcomes=ends.outcomes,
                probability=alone.probability,
                interval=(alone.low, alone.high),
                is_fitted=ends.is_fitted,
                share=ends.share,
            ),
            trust=trust,
            is_calibrated=not (objection or elsewhere) and ends.is_fitted,
        )

    def _of_futures(
        self,
        fit: ShareFit,
        features: Mapping[str, float],
        ends: ForeseenEnds,
        is_unchecked: bool,
    ) -> ShareEstimate:
        """Return the estimate by a fit; where it is not that of the calibration, at least as wide.

        Args:
            fit: fit of the share of futures that is used.
            features: see `estimate_of_futures`.
            ends: outcomes of the futures.
            is_unchecked: it is not known whether grippers let go.
        """
        found = estimate_of_futures(fit, features, is_fitted=ends.is_fitted)
        known = None if self.calibration is None else self.calibration.futures
        if known is not None and known is not fit:
            fitted = estimate_of_futures(known, features)
            found = found._replace(
                low=min(found.low, fitted.low), high=max(found.high, fitted.high)
            )
        return found._replace(low=0.0) if is_unchecked else found

    @staticmethod
    def _is_release_unknown(task: TaskSpec, features: Mapping[str, float]) -> bool:
        """Return True if a task asks for grippers that let go, and whether they did is unknown."""
        return task.gripper != 'any' and isnan(features['released'])

    def _judge(
        self,
        task: TaskSpec,
        evidence: Evidence,
        views: Views,
        subjects: Sequence[int],
        is_real: bool,
    ) -> SuccessEstimate:
        """Return the estimate of frames."""
        features, spread = dict(evidence.features), 1.96 * evidence.sigma
        features['foreseen'] = nan
        features['released'] = _released(task, views, subjects)
        objection = self._objection(task)
        weights = None
        if self.calibration is not None and not objection:
            weights = self.calibration.given(is_real)
        counted = dict(features)
        if is_real and weights is None:  # what was really seen needs no grasp that explains it
            counted |= dict.fromkeys(DOUBTS, nan)
        probability = weights.probability if weights else stated_probability
        unknown = evidence.unknown
        if is_real and weights is None:
            unknown -= DOUBTS
        worst = counted | {name: LIMITS[name][0] for name in unknown}
        best = counted | {name: LIMITS[name][1] for name in unknown}
        low, middle, high = (
            capped(probability({**given, 'margin': clipped(features['margin'] + shift)}), given)
            for given, shift in ((worst, -spread), (counted, 0.0), (best, spread))
        )
        if features['released'] == 0.0 or self._is_release_unknown(task, features):
            low = 0.0
        reasons = self._shown(task, evidence, views)
        reasons += self._gripper_reasons(task, views, features)
        cameras = [camera for camera in views.footage.cameras if camera.view in views.used]
        elsewhere = self._elsewhere(cameras, False) if weights else ''
        reasons.append(self._trust(objection, elsewhere, is_real=is_real, stated=_STATED))
        is_calibrated = not (objection or elsewhere)
        return _estimate((low, middle, high), evidence, views, reasons, features, is_calibrated)

    @staticmethod
    def _shown(task: TaskSpec, evidence: Evidence, views: Views) -> list[str]:
        """Return what the frames show, in words."""
        reasons = []
        if evidence.worst is not None:
            margin = _margin_text(evidence.worst, 1.96 * evidence.sigma, task)
            reasons.append(f'{task.name}: {margin}')
        for item, values in evidence.goal_jaccard.items():
            goal, start = view_mean(values), view_mean(views.start_jaccard(item))
            reasons.append(f'J with the goal mask {goal:.2f}, with the start mask {start:.2f}')
        return reasons + list(evidence.notes)

    @staticmethod
    def _gripper_reasons(task: TaskSpec, views: Views, features: Mapping[str, float]) -> list[str]:
        """Return doubts about the grippers, in words."""
        if SuccessEstimator._is_release_unknown(task, features):
            return ['gripper not checked: a success cannot be told (`gripper: any` allows that)']
        if features['released'] == 0.0:
            return [_STILL_CLOSED[task.gripper]]
        return []

    def _objection(self, task: TaskSpec) -> str:
        """Return the reason why no weights of a fit are used; empty if they are."""
        if self.calibration is None:
            return 'there is no fit (run mtv-world fit success)'
        return self.calibration.objection(task.name, self.segmenter)

    def _elsewhere(self, cameras: Sequence[CameraModel], is_foreseen: bool) -> str:
        """Return the difference from the setting of the fit; empty if the settings are equal."""
        if self.calibration is None or self.setting is None:
            return ''
        return self.calibration.elsewhere(self.setting, cameras, is_foreseen=is_foreseen)

    def _trust(self, objection: str, elsewhere: str, *, is_real: bool, stated: str) -> str:
        """Return the sentence about the trust in an estimate.

        Args:
            objection: why no weights of a fit are used; empty = they are.
            elsewhere: how the setting differs from that of the fit; empty = it does not.
            is_real: whether the frames are real.
            stated: what the estimate is where no weights of a fit are used.
        """
        calibration = self.calibration
        if objection or calibration is None:
            return not_fitted_here(f'{objection}, so this is {stated}')
        given = 'frames that were seen' if is_real else 'the world model'
        optimism = '' if is_real else calibration.optimism
        text = (
            f'weights of {calibration.num_episodes} episodes of {len(calibration.tasks)} tasks, '
            f'given {given}'
        ) + (f', {optimism}' if optimism else '')
        return not_fitted_here(f'{elsewhere}, with {text}') if elsewhere else fitted_here(text)


def _released(task: TaskSpec, views: Views, subjects: Sequence[int]) -> float:
    """Return 1 if the grippers have let go as required, else 0.

    NaN = not known or not required.
    """
    footage = views.footage
    if footage.openings is None or task.gripper == 'any':
        return nan
    if task.gripper == 'open':
        return float(grippers_open(footage.openings)[-1])
    if footage.tools is None:  # a closed gripper may be away from what it moved
        return 1.0 if grippers_open(footage.openings)[-1] else nan
    points = views.memory.points[subjects, -1:]
    return float(grippers_released(footage.openings[:, -1:], footage.tools[:, -1:], points)[-1])


def _check_views(task: TaskSpec, footage: Footage) -> None:
    """Refuse a task that needs views which do not exist."""
    known = [camera.view for camera in footage.cameras]
    missing = [view for view in task.views if view not in known]
    if missing:
        raise CannotTell(f'task {task.name} looks at the views {missing}; there are {known}')


def _abstains(reason: CannotTell, views: Views, subjects: Sequence[int]) -> SuccessEstimate:
    return SuccessEstimate(
        probability=nan,
        interval=(nan, nan),
        jaccard=_jaccard(views, {}, subjects),
        reasons=(cannot_tell(reason),),
    )


def _with_sizes(
    cell: OtherCell | None,
    task: TaskSpec,
    bound: Mapping[str, str],
    foreseen: ForeseenMotions,
) -> OtherCell:
    """Return the robot cell with how the sizes of the objects in it differ from usual ones."""
    items = {role: foreseen.names.index(name) for role, name in bound.items()}
    sizes = odd_sizes(foreseen.sizes, items, task.sizes_m)
    return replace(cell or OtherCell(), sizes=sizes)


def _estimate(
    numbers: tuple[float, float, float],
    evidence: Evidence,
    views: Views,
    reasons: Sequence[str],
    features: Mapping[str, float],
    is_calibrated: bool,
) -> SuccessEstimate:
    """Return an estimate with the Jaccard indices of its evidence.

    Args:
        numbers: low end of the 95 % interval, probability, high end.
        evidence: margins and Jaccard indices in the views.
        views: masks and memory that the evidence is from.
        reasons: evidence and doubts in words, one sentence each.
        features: numbers by name that the probability was computed from.
        is_calibrated: whether weights that were fitted here were used.
    """
    low, probability, high = numbers
    return SuccessEstimate(
        probability=probability,
        interval=(low, high),
        jaccard=_jaccard(views, evidence.goal_jaccard, list(evidence.goal_jaccard)),
        reasons=tuple(reasons),
        features=dict(features),
        is_calibrated=is_calibrated,
    )


def _jaccard(views: Views, goals: Mapping[int, FloatArray], subjects: Sequence[int]) -> FloatArray:
    """Return (V, O): the subjects' J with their goal masks, every other's with its first mask."""
    num_views = len(views.footage.cameras)
    scores = [views.start_jaccard(item) for item in range(len(views.names))]
    for item in subjects:
        scores[item] = goals.get(item, np.full(num_views, np.nan))
    return np.stack(scores, axis=1) if scores else np.zeros((num_views, 0))


def _margin_text(margin: Margin, spread: float, task: TaskSpec) -> str:
    """Return the condition nearest to failing, in words; `spread` in units of its softness."""
    held = 'held' if margin.end >= 0 else 'missed'
    if margin.unit != 'm':
        return f"'{margin.condition}' {held} by {abs(margin.end):.2g} {margin.unit}"
    known = 1000 * spread * (margin.soft or task.softness_m)
    away = 1000 * abs(margin.end)
    return f"'{margin.condition}' {held} by {away:.0f} mm, known to {known:.0f} mm"
