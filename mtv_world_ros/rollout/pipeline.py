"""The main path: an observation and a joint trajectory in, imagined video and estimate out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite, nan
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.control.control import Control, ControlInputs, ControlScene
from mtv_world_ros.control.registry import create_control
from mtv_world_ros.control.trajectory_video import TrajectoryVideo, TrajectoryVideoConfig
from mtv_world_ros.core.data_types import (
    BoolArray,
    ByteArray,
    FloatArray,
    History,
    JointTrajectory,
    MultiViewVideo,
    ObjectMasks,
    Observation,
    WorldModelSpec,
)
from mtv_world_ros.core.errors import CheckpointError, ConfigError
from mtv_world_ros.core.processes import threads_each
from mtv_world_ros.model.card import CheckpointCard
from mtv_world_ros.model.checkpoint import BUNDLED, Checkpoint, control_options
from mtv_world_ros.physics.episode_objects import Majority, ObjectForesight
from mtv_world_ros.physics.foreseen_motions import ForeseenMotions
from mtv_world_ros.physics.object_motion import ObjectMotionModel
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.plan import ChunkPlan, Plan
from mtv_world_ros.robot.shape import load_shape
from mtv_world_ros.rollout.assembly import asked_describer
from mtv_world_ros.rollout.options import DEFAULT_OPTIONS, RolloutOptions, with_keywords
from mtv_world_ros.rollout.plan_comparison import foreseen_outcomes, plans_to_compare
from mtv_world_ros.rollout.prediction import Prediction, StageClock
from mtv_world_ros.rollout.rollout import ObservedChunk, Rollout
from mtv_world_ros.rollout.scene_memory import SceneKeeper, SceneMemory
from mtv_world_ros.rollout.state import RolloutState
from mtv_world_ros.success.calibration import Calibration, Fits, HorizonCurve, load_fits
from mtv_world_ros.success.comparison import Comparison
from mtv_world_ros.success.doubts import doubted, Grounds, widened
from mtv_world_ros.success.estimator import JudgedChunk, SuccessEstimator, verdict_word
from mtv_world_ros.success.fitted_to import Setting
from mtv_world_ros.success.own_tasks import bundled_tasks, chosen_task
from mtv_world_ros.success.rollout_memory import footage_of
from mtv_world_ros.success.task import TaskSpec
from mtv_world_ros.vision.camera_check import CameraCheck, CameraChecker
from mtv_world_ros.vision.describers.describer import Describer, name_objects
from mtv_world_ros.vision.frame_check import check_frames, check_stretch, frame_doubt, lost_objects
from mtv_world_ros.vision.segmenters.choose import choose_segmenter
from mtv_world_ros.vision.segmenters.segmenter import Segmenter

#: reason against an estimate if the plan is drawn outside of all views
_UNSEEN = 'no view shows a tool at any time'
#: reason against an estimate of imagined frames in place of foreseen motions
_UNPLACED = 'no motion is foreseen from the frames that this plan starts from'


class WorldModel(Protocol):
    """Predict one chunk of frames."""

    @property
    def spec(self) -> WorldModelSpec:
        """Its frame size, rate and views."""
        ...

    def predict(
        self,
        start_frame: ByteArray,
        control: ControlInputs,
        *,
        positions: FloatArray,
        seed: int,
        num_inference_steps: int,
        should_stop: Callable[[], bool],
        history: History | None = None,
    ) -> ByteArray:
        """Return (V, T, H, W, 3) uint8 RGB predicted frames.

        Args:
            start_frame: (V, H, W, 3) uint8 RGB, the frame the chunk starts from.
            control: the plan as the model takes it, T commands.
            positions: (1 + T, J) the plan itself, for models that take no drawing, such as a
                simulator: row 0 where the robot stands, row k command k [rad or m].
            seed: seed of the noise.
            num_inference_steps: denoising steps a chunk.
            should_stop: asked between steps.
            history: the frames before the start frame; None = the episode begins there.

        Raises:
            RolloutPreempted: `should_stop` said so.
            ModelMemoryError: the device ran out of memory.
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Pipeline:
    """The main path around a world model; it has no state: `begin` returns a rollout, which has.

    Attributes:
        robot: joints, limits and tools.
        world_model: predicts chunks.
        segmenter: finds the objects' masks.
        estimator: judges the outcome.
        control: way in which the plan enters the model; must be that of the model's training.
        objects: names of the objects; empty = the describer's.
        describer: names the objects of an episode's first frame; None = the instruction's words.
        horizon: measured J by horizon; None = not measured.
        object_motion: foresees object motions, for controls that show them; None = the imagined
            frames alone decide.
        camera_checker: compares the first frames with the arm's outline; None = no check.
        grounds: reasons for which estimates that are not calibrated abstain.
        drawing: draws the plan for people where the control itself is no video.
        checks_place: futures are drawn from a wide prior where contact parameters were not fitted
            in the robot cell of the observation; False for fits, which state a bare estimate.
        picture_fits: fits to rollouts without foreseen object motion, for `without_foresight`;
            None = the estimate stays as it is, e.g. bare.
        scene_keeper: keeps the background of rollouts as real frames showed it; None = the model
            draws it anew in each chunk.
        checkpoint: checkpoint that the model was loaded from; None = made otherwise.
    """

    robot: RobotModel
    world_model: WorldModel
    segmenter: Segmenter
    estimator: SuccessEstimator
    control: Control
    objects: tuple[str, ...] = ()
    describer: Describer | None = None
    horizon: HorizonCurve | None = None
    object_motion: ObjectMotionModel | None = None
    camera_checker: CameraChecker | None = None
    grounds: Grounds = Grounds()
    drawing: TrajectoryVideo = TrajectoryVideo(config=TrajectoryVideoConfig())
    checks_place: bool = False
    picture_fits: Fits | None = None
    scene_keeper: SceneKeeper | None = None
    checkpoint: Checkpoint | None = None

    @classmethod
    def load(
        cls,
        checkpoint: Checkpoint | str | Path = BUNDLED,
        *,
        robot: str | Path | None = None,
        objects: tuple[str, ...] = (),
        task: str | TaskSpec | None = None,
        device: str = 'cpu',
        dtype: str = 'auto',
        num_threads: int = 0,
        segmenter: str = 'auto',
        describer: str | Path | None = None,
        serving: str = '',
        calibrated: bool = True,
        adapter: Path | None = None,
        foresight: bool = True,
        camera_check: bool = True,
    ) -> Pipeline:
        """Return the pipeline around the world model of a checkpoint.

        Args:
            checkpoint: folder, or `bundled`.
            robot: YAML file or name of a bundled robot; default: the one in the checkpoint.
            objects: names of the objects; empty = the describer's.
            task: the task to judge, by name, as YAML file or as its definition; default: the one
                that the episode defines, else the one that the instruction matches.
            device: `cpu`, `cuda`, ...
            dtype: `float32`, `bfloat16`, or `auto` (bfloat16 where the processor has it).
            num_threads: threads of the model on a CPU; 0 = all cores but one, of two both. As many
                processes, or one a core, compute motions of rigid bodies.
            segmenter: name, `module:Class` or file of examples; see `choose_segmenter`.
            describer: YAML file of what names the objects of the first real frame; empty = the
                words of the instruction.
            serving: options for speed and memory, e.g. `compile=true`; see `ServingOptions`.
            calibrated: use the checkpoint's calibration of the success estimate, where it has one,
                and abstain where an estimate rests on nothing; False = the bare estimate.
            adapter: LoRA adapter to use in place of the checkpoint's own.
            foresight: foresee where objects go, where the checkpoint can; False = the imagined
                frames alone decide, see `Pipeline.without_foresight`.
            camera_check: compare the first pictures of an episode with the arm's outline, correct
                small errors of the calibration and refuse a verdict on large ones.

        Raises:
            CheckpointError, ConfigError, RobotError: see their messages.
        """
        from mtv_world_ros.model.loading import load_world_model
        from mtv_world_ros.physics.checkpoint_files import load_foresight

        opened = Checkpoint.open(checkpoint).with_adapter(adapter)
        model, motion = opened.load_robot(robot), None
        control = opened.load_control(model)
        world_model = load_world_model(
            opened,
            device=device,
            dtype=dtype,
            num_threads=num_threads,
            serving=serving,
            layout=control.layout,
        )
        _check_inputs(opened.card.control, control, world_model.transformer.config)
        foresees = control.shows_objects and opened.object_motion is not None
        if foresight and foresees and opened.object_motion is not None:
            threads = num_threads or threads_each(1)
            motion = load_foresight(opened.object_motion, model, threads)
        fits = load_fits(opened.folder, of_pictures=foresees and not foresight)
        calibration = fits.calibration if calibrated else None
        pipeline = cls.assemble(
            opened.card,
            world_model,
            robot=model,
            control=control,
            objects=objects,
            task=task,
            segmenter=choose_segmenter(segmenter, device=device),
            describer=asked_describer(describer),
            calibration=calibration,
            horizon=fits.horizon,
            object_motion=motion,
            camera_checker=CameraChecker(model, load_shape(model)) if camera_check else None,
            setting=Setting.of(model, opened.object_motion_digest),
        )
        pipeline = replace(pipeline, checkpoint=opened)
        if not calibrated:  # to be fitted, or compared: the bare estimate
            return pipeline
        doubt = motion.settings.doubt if motion else ''
        return replace(
            pipeline,
            grounds=Grounds.of(doubt, calibration is not None),
            checks_place=True,
            picture_fits=load_fits(opened.folder, of_pictures=True) if motion else None,
        )

    @classmethod
    def assemble(
        cls,
        card: CheckpointCard,
        world_model: WorldModel,
        *,
        robot: RobotModel,
        control: Control | None = None,
        objects: tuple[str, ...] = (),
        task: str | TaskSpec | None = None,
        segmenter: Segmenter | None = None,
        describer: Describer | None = None,
        calibration: Calibration | None = None,
        horizon: HorizonCurve | None = None,
        object_motion: ObjectMotionModel | None = None,
        camera_checker: CameraChecker | None = None,
        setting: Setting | None = None,
    ) -> Pipeline:
        """Return the pipeline around a world model trained as the card says.

        The control is that of the card; one that is fitted to a training set has to be given.
        """
        segmenter = segmenter or choose_segmenter()
        if control is None:
            control = create_control(card.control, control_options(card, robot))
        return cls(
            robot=robot,
            world_model=world_model,
            segmenter=segmenter,
            estimator=SuccessEstimator(
                *_tasks(task),
                calibration=calibration,
                segmenter=segmenter,
                setting=setting,
            ),
            control=control,
            objects=objects,
            describer=describer,
            horizon=horizon,
            object_motion=object_motion,
            camera_checker=camera_checker,
            scene_keeper=SceneKeeper.of(robot) if card.scene_memory else None,
        )

    @property
    def spec(self) -> WorldModelSpec:
        """The world model's frame size, rate and views."""
        return self.world_model.spec

    def with_robot(self, robot: RobotModel) -> Pipeline:
        """Return the pipeline for a robot of the same joints and tools, e.g. a calibrated one."""
        motion, checker = self.object_motion, self.camera_checker
        return replace(
            self,
            robot=robot,
            camera_checker=None if checker is None else checker.with_robot(robot),
            object_motion=None if motion is None else motion.with_robot(robot),
            scene_keeper=self.scene_keeper and self.scene_keeper.with_robot(robot),
        )

    def without_foresight(self) -> Pipeline:
        """Return the pipeline without foreseen object motion: the imagined frames alone decide.

        Trajectory videos show what else the model was trained with. A model that was trained with
        the masks of the first frame gets them, which is the paper's method; one that was trained
        with foreseen objects (`rendering.object_motion`) gets no objects.
        """
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
        self,
        observation: Observation,
        options: RolloutOptions = DEFAULT_OPTIONS,
        **keywords: Any,
    ) -> Rollout:
        """Return an episode that begins at an observation (V views, any image size).

        Args:
            observation: observation that the rollout begins at.
            options: instruction, objects, seed and other options of the rollout.
            keywords: options one by one, as version 0.1.0 took them; deprecated.

        Raises:
            ObservationError: the views are not the model's.
            TypeError: a keyword is no option.
        """
        options = with_keywords(options, keywords)
        return Rollout(pipeline=self, options=options, _states=(self._state_at(observation),))

    def compare(
        self,
        observation: Observation,
        plans: Sequence[JointTrajectory | Plan],
        options: RolloutOptions = DEFAULT_OPTIONS,
    ) -> Comparison:
        """Return which of several plans of one scene is better, without imagining frames.

        All plans meet the same simulated futures, so that they can often be told apart where no
        single verdict can be given, e.g. where contact was not fitted.

        Args:
            observation: observation that all plans start from.
            plans: two plans or more of one length; times of trajectories count from the
                observation.
            options: instruction, objects and limits.

        Raises:
            ConfigError: this pipeline foresees no object motion, there are fewer than two plans,
                or plans have another length, start or robot.
            PlanError: a trajectory does not fit the robot.
            ObservationError: the views are not the model's.
            DescriptionError: the describer failed.
            RolloutPreempted: `should_stop` of the options said so.
        """
        state = self._state_at(observation)
        if state.objects.model is None:
            raise ConfigError(
                'plans are compared in simulated object motion, and this pipeline foresees none: '
                'use a checkpoint with object_motion (mtv-world fit contact) and foresight=True'
            )
        start = state.observation
        checked = plans_to_compare(plans, self.robot, start, options.limits, self.spec.fps)
        first_frame = state.objects.first.frames[0]
        options = replace(options, objects=self.name_objects(options, lambda: first_frame))
        masks, estimator = self.find(state, options), self.estimator.for_task(options.task)
        objects = state.objects.as_fitted() if options.contact.is_confirmed else state.objects
        found = [
            foreseen_outcomes(objects, plan, start, masks, self.spec, estimator, options)
            for plan in checked
        ]
        reason = state.camera_check.refusal
        if len({key for _, key, _ in found}) > 1:
            reason = reason or 'the futures of the plans are not common'
        return Comparison.of(
            [outcomes for outcomes, _, _ in found],
            reason=reason,
            is_fitted=all(is_fitted for _, _, is_fitted in found),
        )

    def _state_at(self, observation: Observation) -> RolloutState:
        """Return the state of an episode that begins at an observation, with checked cameras."""
        checker = self.camera_checker
        check = CameraCheck() if checker is None else checker.check(observation)
        observation = check.corrected_observation(observation)
        return RolloutState.at(observation, self.spec, self._objects_in(observation), check)

    def name_objects(
        self, options: RolloutOptions, first_frame: Callable[[], ByteArray]
    ) -> tuple[str, ...]:
        """Return the names of the objects of a rollout.

        Args:
            options: options of the rollout; its names come first, then the pipeline's, its
                describer's, those of the recorded episode, those of the instruction.
            first_frame: returns the first real frame (H, W, 3) uint8 RGB, for the describer.

        Raises:
            DescriptionError: the describer failed.
        """
        return name_objects(
            options.instruction,
            given=options.objects or self.objects,
            describer=self.describer,
            first_frame=first_frame,
            stored=options.stored_objects,
        )

    def imagine(
        self, state: RolloutState, plan: ChunkPlan, options: RolloutOptions
    ) -> tuple[Prediction, RolloutState]:
        """Return one chunk of one rollout, stage by stage, and the rollout's state after it."""
        start, clock = state.observation, StageClock()
        num_steps = options.num_inference_steps or self.spec.num_inference_steps
        motion = Motion.of(self.robot, start.cameras, plan.positions, self._links)
        in_view = motion.tools_in_view()
        start_masks = self.find(state, options)
        if state.starts_later:
            state = replace(state, frame_doubt=self._frame_doubt(state, start_masks))
        clock.lap('start masks')
        objects = state.objects
        if options.contact.is_confirmed:
            objects = objects.as_fitted()
        objects = objects.foresee(
            plan,
            start,
            options.objects,
            start_masks,
            self._majority(state, options),
            state.is_begun,
            options.should_stop,
        )
        pictures = objects.pictures(plan, motion)
        scene = ControlScene(
            motion=motion,
            times=plan.times,
            start_frames=start.frames,
            masks=start_masks.masks[:, :, 0],
            objects=pictures,
            seen=state.scene.last if state.scene and state.num_imagined else None,
        )
        clock.lap('object motion')
        control = self.control.make(scene)
        self.control.layout.check(control, type(self.control).__name__)
        drawn = control.video
        if drawn is None:
            drawn = self.drawing.make(scene).video
        assert drawn is not None
        clock.lap('trajectory video')
        frames = self.world_model.predict(
            start.frames,
            control,
            positions=plan.positions,
            seed=options.seed,
            num_inference_steps=num_steps,
            should_stop=options.should_stop,
            history=state.history,
        )[:, : plan.num_frames]
        clock.lap('model')
        motion = motion.first(plan.num_frames + 1)
        background = state.scene
        if self.scene_keeper is not None and options.objects:
            frames, background = self._kept(state, scene, motion, drawn, frames, options)
        masks = self.follow(state, start_masks, frames, options)
        clock.lap('masks')
        foreseen = objects.motions(plan, state.is_begun)
        success, memory = self.judge(state, motion, start_masks, masks, options, foreseen)
        unseen = () if control.video is None or in_view.any() else (_UNSEEN,)
        success = doubted(success, (*objects.reasons, *unseen))
        is_foreseen = isfinite(success.features.get('foreseen', nan))
        unplaced = _UNPLACED if objects.starts_later and not is_foreseen else ''
        success = doubted(success, refusal=state.frame_doubt or objects.refusal or unplaced)
        clock.lap('success')
        times = plan.times[1 : plan.num_frames + 1]
        stamp_ns = plan.stamp_ns + round(float(times[-1]) * 1e9)
        state = state.after(
            frames,
            motion.positions[-1],
            stamp_ns,
            self.spec.num_history,
            memory,
            objects,
            background,
            masks,
        )
        prediction = Prediction(
            start=start,
            video=MultiViewVideo(views=start.views, times=times, frames=frames),
            seed=options.seed,
            positions=motion.positions[1:],
            trajectory_video=MultiViewVideo(views=start.views, times=plan.times, frames=drawn),
            start_masks=start_masks,
            masks=masks,
            success=success,
            stamp_ns=plan.stamp_ns,
            chunk=plan.chunk,
            num_chunks=plan.num_chunks,
            imagined_seconds=state.num_imagined / self.spec.fps,
            horizon=self.horizon,
            segmenter=self.segmenter.name,
            num_inference_steps=num_steps,
            foreseen=None if foreseen is None else foreseen.at_frames(plan),
            objects=objects,
            in_view=in_view,
            seconds=MappingProxyType(clock.seconds),
        )
        return prediction, state

    def observe(
        self,
        state: RolloutState,
        frames: ByteArray,
        positions: FloatArray,
        options: RolloutOptions,
        commands: FloatArray | None = None,
    ) -> tuple[ObservedChunk, RolloutState]:
        """Return masks and estimate of real frames, and the rollout's state after them.

        Args:
            state: state of the rollout before the frames.
            frames: (V, T, H, W, 3) uint8 RGB frames after that state, at the model's size and
                frame rate.
            positions: (1 + T, J) measured joint positions [rad or m]; row 0 at the state.
            options: names of the objects, and the instruction.
            commands: (1 + T, J) commanded at the same times [rad or m]; None = not known.
        """
        start_masks = self.find(state, options)
        masks = self.follow(state, start_masks, frames, options)
        motion = Motion.of(self.robot, state.observation.cameras, positions, self._links)
        background = state.scene
        if self.scene_keeper is not None and options.objects:
            background = self.scene_keeper.seen(background, motion.after_first(), frames, masks)
        success, memory = self.judge(state, motion, start_masks, masks, options, is_real=True)
        doubts = check_stretch(frames, positions[1:], state.observation.views)
        success = doubted(success, refusal='; '.join(doubts))
        stamp_ns = state.observation.stamp_ns + round(frames.shape[1] / self.spec.fps * 1e9)
        after = state.after(
            frames,
            positions[-1],
            stamp_ns,
            self.spec.num_history,
            memory,
            state.objects.watched(positions, 1 / self.spec.fps, commands),
            background,
            masks,
        )
        after = replace(after, observed_doubts=doubts)
        return ObservedChunk(start_masks=start_masks, masks=masks, success=success), after

    def _kept(
        self,
        state: RolloutState,
        scene: ControlScene,
        motion: Motion,
        drawn: ByteArray,
        frames: ByteArray,
        options: RolloutOptions,
    ) -> tuple[ByteArray, SceneMemory]:
        """Return imagined frames with the background of the rollout, and its memory after them."""
        keeper, background, shown = self.scene_keeper, state.scene, slice(1, len(motion.positions))
        assert keeper is not None
        start_masks = self.find(state, options)
        if not state.num_imagined:
            start = state.observation.frames[:, None]
            background = keeper.seen(background, motion.first(1), start, start_masks)
        assert background is not None
        unmarked = self.control.unmarked(scene)
        if unmarked is not None:
            frames = keeper.without_marks(background, frames, drawn[:, shown], unmarked[:, shown])
        masks = self.follow(state, start_masks, frames, options)
        objects = None if scene.objects is None else scene.objects[:, shown]
        return keeper.held(background, motion.after_first(), frames, masks, objects)

    @property
    def _links(self) -> tuple[str, ...]:
        """Names of the links whose poses are needed."""
        keeper = self.scene_keeper
        return tuple(dict.fromkeys([*self.control.links, *(keeper.links if keeper else ())]))

    def find(self, state: RolloutState, options: RolloutOptions) -> ObjectMasks:
        """Return masks of the frame that a chunk starts from (T = 1).

        What a search in that real frame does not find, such as an object that fingers half hide,
        is followed from the frames before.
        """
        frames = state.observation.frames[:, None]
        found, before = self.segmenter.segment(frames, options.objects), state.followed
        if state.num_imagined or before is None or before.masks.names != found.names:
            return found
        if not (before.masks.masks.any((-2, -1)) & ~found.masks.any((-2, -1))).any():
            return found
        followed = self.segmenter.segment(
            frames,
            options.objects,
            first_masks=before.masks.masks[:, :, 0],
            first_frames=before.frames,
        )
        return found.filled_from(followed)

    def follow(
        self,
        state: RolloutState,
        start_masks: ObjectMasks,
        frames: ByteArray,
        options: RolloutOptions,
    ) -> ObjectMasks:
        """Return masks of the frames (V, T, H, W, 3) after the start frame."""
        return self.segmenter.segment(
            frames,
            options.objects,
            first_masks=start_masks.masks[:, :, 0],
            first_frames=state.observation.frames,
        )

    def judge(
        self,
        state: RolloutState,
        motion: Motion,
        start_masks: ObjectMasks,
        masks: ObjectMasks,
        options: RolloutOptions,
        foreseen: ForeseenMotions | None = None,
        *,
        is_real: bool = False,
    ) -> JudgedChunk:
        """Return the estimate after a chunk of 1 + T states, and what it remembers."""
        check, footage = state.camera_check, footage_of(motion, start_masks, masks)
        judged = self.estimator.for_task(options.task).estimate(
            footage, options.instruction, state.memory, foreseen, is_real=is_real
        )
        estimate = judged.estimate if is_real else self.grounds.bear(judged.estimate)
        estimate = doubted(estimate, check.notes, check.refusal)
        if options.doubt:
            estimate = widened(estimate, options.doubt)
        if foreseen is not None and options.contact.text:
            is_open = verdict_word(estimate.probability, estimate.interval) == 'open'
            word = 'open: ' if is_open and not options.contact.is_confirmed else ''
            estimate = doubted(estimate, (f'{word}{options.contact.text}',))
        return judged._replace(estimate=estimate)

    def _frame_doubt(self, state: RolloutState, start_masks: ObjectMasks) -> str:
        """Return why the real frames that a later plan starts from allow no verdict."""
        objects = state.objects
        reasons = check_frames(
            objects.source, objects.first, state.camera_check, self.camera_checker
        )
        reasons = tuple(dict.fromkeys([*reasons, *state.observed_doubts]))
        return frame_doubt(reasons, lost_objects(start_masks))

    def _majority(self, state: RolloutState, options: RolloutOptions) -> Majority:
        """Return the rule that selects futures of majority outcome, for pictures and estimate."""

        def majority(motions: ForeseenMotions) -> BoolArray | None:
            estimator = self.estimator.for_task(options.task)
            ends = estimator.foresee(motions, options.instruction, state.memory)
            return None if ends is None else ends.is_majority

        return majority

    def _objects_in(self, observation: Observation) -> ObjectForesight:
        """Return the objects of an episode that begins at an observation."""
        model = self.object_motion if self.control.shows_objects else None
        if model is not None and self.checks_place:
            model = model.at_place(observation.place)
        return ObjectForesight(
            model=model,
            segmenter=self.segmenter,
            robot=self.robot,
            first=observation,
            source=observation,
        )


def _check_inputs(name: str, control: Control, transformer: Mapping[str, Any]) -> None:
    """Raise if the transformer was not built for the inputs that a control feeds."""
    wanted = control.layout.transformer_arguments()
    for kind in ('context', 'frame'):
        key = f'{kind}_input'
        given, held = wanted.get(key), transformer.get(key)
        if given != (None if held is None else dict(held)):
            fed = f"feeds '{kind}' of {given}" if given else f"does not feed '{kind}'"
            taken = f'takes {dict(held)}' if held else 'takes none'
            raise CheckpointError(
                f"control '{name}' {fed}, the checkpoint's transformer {taken}; the control that "
                'it was trained with stands in world_model.json, as `control`'
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
