"""The judge of this package: simulated futures, masks, calibration, and doubts about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite, nan

import numpy as np

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.core.data_types import (
    BoolArray,
    ObjectMasks,
    Observation,
    SuccessEstimate,
    WorldModelSpec,
)
from mtv_world_ros.core.processes import threads_each
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.physics.episode_objects import Majority, ObjectForesight
from mtv_world_ros.physics.foreseen_motions import ForeseenMotions
from mtv_world_ros.physics.grasp_attempts import attempts_line, foreseen_attempts
from mtv_world_ros.physics.object_motion import ObjectMotionModel
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.plan import Plan
from mtv_world_ros.robot.shape import load_shape
from mtv_world_ros.rollout.judge import (
    ChunkStart,
    ImaginedChunk,
    Judgement,
    JudgeState,
    SeenChunk,
)
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.plan_comparison import foreseen_outcomes
from mtv_world_ros.success.calibration import Fits, HorizonCurve, load_fits
from mtv_world_ros.success.comparison import Comparison
from mtv_world_ros.success.doubts import Grounds, widened
from mtv_world_ros.success.estimator import SuccessEstimator, verdict_word
from mtv_world_ros.success.fitted_to import Setting
from mtv_world_ros.success.footage_memory import footage_of, FootageMemory
from mtv_world_ros.success.own_tasks import bundled_tasks, chosen_task
from mtv_world_ros.success.task import TaskSpec
from mtv_world_ros.success.trust import OtherCell, with_notes, without_verdict
from mtv_world_ros.vision.camera_check import CameraCheck, CameraChecker
from mtv_world_ros.vision.frame_check import check_frames, check_stretch, frame_doubt, lost_objects
from mtv_world_ros.vision.segmenters.segmenter import Segmenter

#: reason against an estimate if the plan is drawn outside of all views
_UNSEEN = 'no view shows a tool at any time'
#: reason against an estimate of imagined frames in place of foreseen motions
_UNPLACED = 'no motion is foreseen from the frames that this plan starts from'


@dataclass(frozen=True, slots=True, kw_only=True)
class SuccessJudge:
    """Judges by the share of simulated futures, or else by masks of the imagined frames.

    Attributes:
        robot: joints, limits and tools.
        estimator: estimates the task from evidence, with its calibration.
        object_motion: foresees object motions; None = the imagined frames alone decide.
        horizon: measured J by horizon; None = not measured.
        camera_checker: compares real frames with the arm's outline; None = no check.
        grounds: reasons for which estimates that are not calibrated abstain.
        checks_place: futures are drawn from a wide prior where contact parameters were not fitted
            in the robot cell of the observation; False for fits, which state a bare estimate.
        picture_fits: fits to rollouts without foreseen object motion, for `without_foresight`;
            None = the estimate stays as it is, e.g. bare.
    """

    robot: RobotModel
    estimator: SuccessEstimator
    object_motion: ObjectMotionModel | None = None
    horizon: HorizonCurve | None = None
    camera_checker: CameraChecker | None = None
    grounds: Grounds = Grounds()
    checks_place: bool = False
    picture_fits: Fits | None = None

    @classmethod
    def of(
        cls, robot: RobotModel, segmenter: Segmenter, task: str | TaskSpec | None = None
    ) -> SuccessJudge:
        """Return the judge of a robot without calibration and object motion.

        Args:
            robot: robot that acts.
            segmenter: finds the masks.
            task: see `Pipeline.load`.

        Raises:
            ConfigError: no such task, or its file is wrong.
        """
        return cls(
            robot=robot,
            estimator=SuccessEstimator(*_tasks(task), segmenter=segmenter),
        )

    @classmethod
    def load(
        cls,
        checkpoint: Checkpoint,
        robot: RobotModel,
        segmenter: Segmenter,
        *,
        task: str | TaskSpec | None = None,
        foresees: bool,
        foresight: bool = True,
        calibrated: bool = True,
        camera_check: bool = True,
        num_threads: int = 0,
    ) -> SuccessJudge:
        """Return the judge with the fits and the physics of a checkpoint.

        Args:
            checkpoint: checkpoint of the world model.
            robot: robot that acts.
            segmenter: finds the masks.
            task: see `Pipeline.load`, as the other arguments.
            foresees: whether the control of the checkpoint shows simulated object motion.
            foresight: simulate it, where the checkpoint has the physics.
            calibrated: use fits, and abstain where an estimate rests on nothing.
            camera_check: compare the first frames with the arm's outline.
            num_threads: threads that simulate; 0 = all cores but one, of two both.

        Raises:
            CheckpointError, ConfigError: a file cannot be used.
        """
        from mtv_world_ros.physics.checkpoint_files import load_foresight

        folder, motion = checkpoint.object_motion, None
        foresees = foresees and folder is not None
        if foresight and foresees and folder is not None:
            motion = load_foresight(folder, robot, num_threads or threads_each(1))
        fits = load_fits(checkpoint.folder, of_pictures=foresees and not foresight)
        calibration = fits.calibration if calibrated else None
        judge = cls(
            robot=robot,
            estimator=SuccessEstimator(
                *_tasks(task),
                calibration=calibration,
                segmenter=segmenter,
                setting=Setting.of(robot, checkpoint.object_motion_digest),
            ),
            object_motion=motion,
            horizon=fits.horizon,
            camera_checker=CameraChecker(robot, load_shape(robot)) if camera_check else None,
        )
        if not calibrated:  # to be fitted, or compared: the bare estimate
            return judge
        doubt = motion.settings.doubt if motion else ''
        return replace(
            judge,
            grounds=Grounds.of(doubt, calibration is not None),
            checks_place=True,
            picture_fits=load_fits(checkpoint.folder, of_pictures=True) if motion else None,
        )

    def with_robot(self, robot: RobotModel) -> SuccessJudge:
        """Return the judge for a robot of the same joints and tools, e.g. a calibrated one."""
        motion, checker = self.object_motion, self.camera_checker
        return replace(
            self,
            robot=robot,
            camera_checker=None if checker is None else checker.with_robot(robot),
            object_motion=None if motion is None else motion.with_robot(robot),
        )

    def for_task(self, task: TaskSpec | None) -> SuccessJudge:
        """Return the judge of the task that an episode defines; None = it defines none."""
        return replace(self, estimator=self.estimator.for_task(task))

    def without_camera_check(self) -> SuccessJudge:
        """Return the judge of observations whose cameras were checked before."""
        return replace(self, camera_checker=None)

    def without_foresight(self) -> SuccessJudge:
        """Return the judge without simulated object motion, with the fits to such rollouts."""
        if self.object_motion is None:
            return self
        fits = self.picture_fits
        if fits is None:
            return replace(self, object_motion=None)
        return replace(
            self,
            object_motion=None,
            estimator=self.estimator.with_calibration(fits.calibration),
            horizon=fits.horizon,
            grounds=Grounds.of('', fits.calibration is not None),
        )

    def is_fitted_at(self, place: str) -> bool:
        """Return True if futures are drawn as they were fitted, in a robot cell.

        Args:
            place: name of the robot cell; empty = not stated.
        """
        model = self.object_motion
        return model is None or not self.checks_place or model.at_place(place) is model

    def begin(
        self, observation: Observation, *, segmenter: Segmenter, foresees: bool
    ) -> JudgeState:
        """Return the evidence at an episode's first observation, with checked cameras."""
        checker = self.camera_checker
        check = CameraCheck() if checker is None else checker.check(observation)
        observation = check.corrected_observation(observation)
        model = self.object_motion if foresees else None
        if model is not None and self.checks_place:
            model = model.at_place(observation.place)
        objects = ObjectForesight(
            model=model,
            segmenter=segmenter,
            robot=self.robot,
            first=observation,
            source=observation,
        )
        return JudgeState(objects=objects, camera_check=check)

    def foresee(self, state: JudgeState, start: ChunkStart, options: RolloutOptions) -> JudgeState:
        """Return the evidence with the object motion of a chunk; see `Judge.foresee`."""
        objects = state.objects
        if not start.num_imagined and objects.source is not objects.first:
            state = replace(state, frame_doubt=self._frame_doubt(state, start.masks))
        if options.contact.is_confirmed:
            objects = objects.as_fitted()
        objects = objects.foresee(
            start.plan,
            start.observation,
            options.objects,
            start.masks,
            self._majority(state, options),
            state.is_begun(start.num_imagined),
            options.should_stop,
        )
        return replace(state, objects=objects)

    def ahead(
        self, state: JudgeState, start: ChunkStart, motion: Motion, options: RolloutOptions
    ) -> SuccessEstimate | None:
        """Return the verdict before frames are imagined; see `Judge.ahead`."""
        objects = state.objects
        foreseen = objects.motions(start.plan, state.is_begun(start.num_imagined))
        if foreseen is None:
            return None
        estimate = self.estimator.for_task(options.task).ahead(
            foreseen,
            options.instruction,
            state.memory,
            start.observation.cameras,
            knows_grippers=motion.openings is not None,
            cell=_other_cell(objects),
        )
        if estimate is None:
            return None
        estimate = self._doubted(self.grounds.bear(estimate), state, options, is_foreseen=True)
        estimate = with_notes(estimate, objects.reasons)
        return without_verdict(estimate, state.frame_doubt or objects.refusal)

    def judge(
        self, state: JudgeState, start: ChunkStart, chunk: ImaginedChunk, options: RolloutOptions
    ) -> Judgement:
        """Return the verdict after imagined frames; see `Judge.judge`."""
        objects = state.objects
        foreseen = objects.motions(start.plan, state.is_begun(start.num_imagined))
        estimate, memory = self._estimated(
            state, chunk.motion, start.masks, chunk.masks, options, foreseen
        )
        unseen = () if chunk.is_in_view else (_UNSEEN,)
        chained = '' if foreseen is None else attempts_line(foreseen_attempts(foreseen))
        told = [chained] if chained else []
        estimate = with_notes(estimate, (*told, *objects.reasons, *unseen))
        is_foreseen = isfinite(estimate.features.get('foreseen', nan))
        is_untold = objects.starts_later or isfinite(estimate.probability)
        unplaced = _UNPLACED if objects.model and not is_foreseen and is_untold else ''
        estimate = without_verdict(estimate, state.frame_doubt or objects.refusal or unplaced)
        return Judgement(estimate, foreseen, replace(state, memory=memory))

    def see(self, state: JudgeState, chunk: SeenChunk, options: RolloutOptions) -> Judgement:
        """Return the verdict after real frames; see `Judge.see`."""
        positions = chunk.motion.positions
        estimate, memory = self._estimated(
            state, chunk.motion, chunk.start_masks, chunk.masks, options, is_real=True
        )
        views = [camera.view for camera in chunk.motion.cameras]
        doubts, still = check_stretch(
            chunk.frames, positions[1:], chunk.period_s, views, state.still
        )
        estimate = without_verdict(estimate, '; '.join(doubts))
        state = replace(
            state,
            objects=state.objects.watched(
                chunk.motion,
                chunk.masks.names,
                np.concatenate([chunk.start_masks.masks, chunk.masks.masks], axis=2),
                chunk.period_s,
                chunk.commands,
            ),
            memory=memory,
            observed_doubts=doubts,
            still=still,
        )
        return Judgement(estimate, None, state)

    def compare(
        self,
        state: JudgeState,
        plans: Sequence[Plan],
        observation: Observation,
        masks: ObjectMasks,
        spec: WorldModelSpec,
        options: RolloutOptions,
    ) -> Comparison:
        """Return which of several plans of one scene is better; see `Judge.compare`."""
        estimator = self.estimator.for_task(options.task)
        objects = state.objects.as_fitted() if options.contact.is_confirmed else state.objects
        found = [
            foreseen_outcomes(objects, plan, observation, masks, spec, estimator, options)
            for plan in plans
        ]
        reason = state.camera_check.refusal
        if len({key for _, key, _ in found}) > 1:
            reason = reason or 'the futures of the plans are not common'
        return Comparison.of(
            [outcomes for outcomes, _, _ in found],
            reason=reason,
            is_fitted=all(is_fitted for _, _, is_fitted in found),
        )

    def _estimated(
        self,
        state: JudgeState,
        motion: Motion,
        start_masks: ObjectMasks,
        masks: ObjectMasks,
        options: RolloutOptions,
        foreseen: ForeseenMotions | None = None,
        *,
        is_real: bool = False,
    ) -> tuple[SuccessEstimate, FootageMemory]:
        """Return the estimate after a chunk of 1 + T states, and what it remembers."""
        footage = footage_of(motion, start_masks, masks)
        judged = self.estimator.for_task(options.task).estimate(
            footage,
            options.instruction,
            state.memory,
            foreseen,
            is_real=is_real,
            cell=_other_cell(state.objects),
        )
        estimate = judged.estimate if is_real else self.grounds.bear(judged.estimate)
        is_foreseen = foreseen is not None
        estimate = self._doubted(estimate, state, options, is_foreseen=is_foreseen)
        return estimate, judged.memory

    @staticmethod
    def _doubted(
        estimate: SuccessEstimate,
        state: JudgeState,
        options: RolloutOptions,
        *,
        is_foreseen: bool,
    ) -> SuccessEstimate:
        """Return an estimate with the doubts about cameras and physics."""
        check = state.camera_check
        estimate = without_verdict(with_notes(estimate, check.notes), check.refusal)
        if options.doubt:
            estimate = widened(estimate, options.doubt)
        if is_foreseen and options.contact.text:
            is_open = verdict_word(estimate.probability, estimate.interval) == 'open'
            word = 'open: ' if is_open and not options.contact.is_confirmed else ''
            estimate = with_notes(estimate, (f'{word}{options.contact.text}',))
        return estimate

    def _frame_doubt(self, state: JudgeState, start_masks: ObjectMasks) -> str:
        """Return why the real frames that a later plan starts from allow no verdict."""
        objects = state.objects
        reasons = check_frames(
            objects.source, objects.first, state.camera_check, self.camera_checker
        )
        reasons = tuple(dict.fromkeys([*reasons, *state.observed_doubts]))
        return frame_doubt(reasons, lost_objects(start_masks))

    def _majority(self, state: JudgeState, options: RolloutOptions) -> Majority:
        """Return the rule that selects futures of majority outcome, for pictures and estimate."""

        def majority(motions: ForeseenMotions) -> BoolArray | None:
            estimator = self.estimator.for_task(options.task)
            ends = estimator.foresee(motions, options.instruction, state.memory)
            return None if ends is None else ends.is_majority

        return majority


def _other_cell(objects: ObjectForesight) -> OtherCell | None:
    """Return the robot cell of an episode if contact was not fitted in it."""
    model = objects.model
    if model is None or model.is_fitted:
        return None
    origin = model.settings.fitted
    return OtherCell(
        here=objects.first.place,
        fitted='' if origin is None else origin.place or '',
        doubt=model.settings.doubt,
    )


def _tasks(task: str | TaskSpec | None) -> tuple[tuple[TaskSpec, ...], str | None]:
    """Return the known tasks, and the name of the one to judge; None = each that matches.

    A task of the user's own is one more.
    """
    known = bundled_tasks()
    given = task if isinstance(task, TaskSpec) else chosen_task(task, ())
    if given is None:
        return known, None
    return (*(spec for spec in known if spec.name != given.name), given), given.name
