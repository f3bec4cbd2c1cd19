"""The main path: an observation and a joint trajectory in, imagined video and estimate out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, TYPE_CHECKING

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.control.control import Control, ControlInputs, ControlScene
from mtv_world_ros.control.mark_leaks import find_leaks, leak_remarks, without_leaks
from mtv_world_ros.control.trajectory_video import TrajectoryVideo, TrajectoryVideoConfig
from mtv_world_ros.core.data_types import (
    ByteArray,
    FloatArray,
    History,
    JointTrajectory,
    MultiViewVideo,
    ObjectMasks,
    Observation,
    WorldModelSpec,
)
from mtv_world_ros.core.errors import CheckpointError, ConfigError, RolloutPreempted
from mtv_world_ros.model.checkpoint import BUNDLED, Checkpoint
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.plan import ChunkPlan, Plan
from mtv_world_ros.rollout.assembly import asked_describer
from mtv_world_ros.rollout.judge import ChunkStart, ImaginedChunk, Judge, SeenChunk
from mtv_world_ros.rollout.options import DEFAULT_OPTIONS, RolloutOptions
from mtv_world_ros.rollout.plan_comparison import plans_to_compare
from mtv_world_ros.rollout.prediction import Prediction, StageClock
from mtv_world_ros.rollout.rollout import ObservedChunk, Rollout
from mtv_world_ros.rollout.scene_memory import SceneKeeper, SceneMemory
from mtv_world_ros.rollout.state import RolloutState
from mtv_world_ros.rollout.success_judge import SuccessJudge
from mtv_world_ros.success.comparison import Comparison
from mtv_world_ros.success.task import TaskSpec
from mtv_world_ros.success.trust import with_notes
from mtv_world_ros.vision.describers.describer import Describer, name_objects
from mtv_world_ros.vision.segmenters.choose import choose_segmenter
from mtv_world_ros.vision.segmenters.segmenter import Segmenter

#: names that `Pipeline` had until the judge became a part of its own -> where they are
_MOVED = {
    'estimator': 'judge.estimator',
    'object_motion': 'judge.object_motion',
    'horizon': 'judge.horizon',
    'camera_checker': 'judge.camera_checker',
    'grounds': 'judge.grounds',
    'checks_place': 'judge.checks_place',
    'picture_fits': 'judge.picture_fits',
    'is_fitted_at': 'judge.is_fitted_at',
}


class WorldModel(Protocol):
    """Predict one chunk of frames."""

    @property
    def spec(self) -> WorldModelSpec:
        """Frame size, rate and views of the model."""
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
    """Draws a plan, predicts frames and segments them; a judge says how the task ends.

    It has no state: `begin` returns a rollout, which has.

    Attributes:
        robot: joints, limits and tools.
        world_model: predicts chunks.
        segmenter: finds the objects' masks.
        judge: simulates object motion, and turns it and masks into a verdict.
        control: way in which the plan enters the model; must be that of the model's training.
        objects: names of the objects; empty = the describer's.
        describer: names the objects of an episode's first frame; None = the instruction's words.
        drawing: draws the plan for people where the control itself is no video.
        scene_keeper: keeps the background of rollouts as real frames showed it; None = the model
            draws it anew in each chunk.
        checkpoint: checkpoint that the model was loaded from; None = made otherwise.
    """

    robot: RobotModel
    world_model: WorldModel
    segmenter: Segmenter
    judge: Judge
    control: Control
    objects: tuple[str, ...] = ()
    describer: Describer | None = None
    drawing: TrajectoryVideo = TrajectoryVideo(config=TrajectoryVideoConfig())
    scene_keeper: SceneKeeper | None = None
    checkpoint: Checkpoint | None = None

    if not TYPE_CHECKING:

        def __new__(cls, **values: Any) -> Pipeline:
            """Raise for a field that is no longer of the pipeline, with its place."""
            moved = next((name for name in values if name in _MOVED), None)
            if moved is not None:
                raise TypeError(
                    f"a pipeline has no field '{moved}': it is {_MOVED[moved]} now; give "
                    f'judge=replace(pipeline.judge, {moved}=...)'
                )
            return object.__new__(cls)

        def __getattr__(self, name: str) -> Any:
            """Raise for a name that is no longer of the pipeline, with its place."""
            text = f"'Pipeline' object has no attribute '{name}'"
            if name in _MOVED:
                text += f': it is {_MOVED[name]} now'
            raise AttributeError(text)

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

        opened = Checkpoint.open(checkpoint).with_adapter(adapter)
        model = opened.load_robot(robot)
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
        finds = choose_segmenter(segmenter, device=device)
        judge = SuccessJudge.load(
            opened,
            model,
            finds,
            task=task,
            foresees=control.shows_objects,
            foresight=foresight,
            calibrated=calibrated,
            camera_check=camera_check,
            num_threads=num_threads,
        )
        return cls(
            robot=model,
            world_model=world_model,
            segmenter=finds,
            judge=judge,
            control=control,
            objects=objects,
            describer=asked_describer(describer),
            scene_keeper=SceneKeeper.of(model) if opened.card.scene_memory else None,
            checkpoint=opened,
        )

    @property
    def spec(self) -> WorldModelSpec:
        """The world model's frame size, rate and views."""
        return self.world_model.spec

    def with_robot(self, robot: RobotModel) -> Pipeline:
        """Return the pipeline for a robot of the same joints and tools, e.g. a calibrated one."""
        return replace(
            self,
            robot=robot,
            judge=self.judge.with_robot(robot),
            scene_keeper=self.scene_keeper and self.scene_keeper.with_robot(robot),
        )

    def without_foresight(self) -> Pipeline:
        """Return the pipeline without foreseen object motion: the imagined frames alone decide.

        Trajectory videos show what else the model was trained with. A model that was trained with
        the masks of the first frame gets them, which is the paper's method; one that was trained
        with foreseen objects (`rendering.object_motion`) gets no objects.
        """
        judge = self.judge.without_foresight()
        return self if judge is self.judge else replace(self, judge=judge)

    def begin(
        self, observation: Observation, options: RolloutOptions = DEFAULT_OPTIONS
    ) -> Rollout:
        """Return an episode that begins at an observation (V views, any image size).

        Args:
            observation: observation that the rollout begins at.
            options: instruction, objects, seed and other options of the rollout.

        Raises:
            ObservationError: the views are not the model's.
        """
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
        evidence = state.evidence
        if evidence.objects.model is None:
            raise ConfigError(
                'plans are compared in simulated object motion, and this pipeline foresees none: '
                'use a checkpoint with object_motion (mtv-world fit contact) and foresight=True'
            )
        start = state.observation
        checked = plans_to_compare(plans, self.robot, start, options.limits, self.spec.fps)
        first_frame = evidence.objects.first.frames[0]
        options = replace(options, objects=self.name_objects(options, lambda: first_frame))
        masks = self.find(state, options)
        return self.judge.compare(evidence, checked, start, masks, self.spec, options)

    def _state_at(self, observation: Observation) -> RolloutState:
        """Return the state of an episode that begins at an observation, with checked cameras."""
        evidence = self.judge.begin(
            observation, segmenter=self.segmenter, foresees=self.control.shows_objects
        )
        return RolloutState.at(evidence.objects.first, self.spec, evidence)

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
        clock.lap('start masks')
        chunk_start = ChunkStart(
            plan=plan, observation=start, masks=start_masks, num_imagined=state.num_imagined
        )
        evidence = self.judge.foresee(state.evidence, chunk_start, options)
        if options.on_foreseen is not None:
            options.on_foreseen(plan, self.judge.ahead(evidence, chunk_start, motion, options))
            if options.should_stop():
                raise RolloutPreempted('stopped before frames were imagined')
        scene = ControlScene(
            motion=motion,
            times=plan.times,
            start_frames=start.frames,
            masks=start_masks.masks[:, :, 0],
            objects=evidence.objects.pictures(plan, motion),
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
        frames, leak_notes = self._without_marks(frames, control, scene)
        motion = motion.first(plan.num_frames + 1)
        background = state.scene
        if self.scene_keeper is not None and options.objects:
            frames, background = self._kept(state, scene, motion, drawn, frames, options)
        masks = self.follow(state, start_masks, frames, options)
        clock.lap('masks')
        imagined = ImaginedChunk(
            motion=motion, masks=masks, is_in_view=control.video is None or bool(in_view.any())
        )
        success, foreseen, evidence = self.judge.judge(evidence, chunk_start, imagined, options)
        success = with_notes(success, leak_notes)
        clock.lap('success')
        times = plan.times[1 : plan.num_frames + 1]
        stamp_ns = plan.stamp_ns + round(float(times[-1]) * 1e9)
        state = state.after(
            frames,
            motion.positions[-1],
            stamp_ns,
            self.spec.num_history,
            evidence,
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
            horizon=self.judge.horizon,
            segmenter=self.segmenter.name,
            num_inference_steps=num_steps,
            foreseen=None if foreseen is None else foreseen.at_frames(plan),
            objects=evidence.objects,
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
        seen = SeenChunk(
            motion=motion,
            start_masks=start_masks,
            masks=masks,
            frames=frames,
            period_s=1 / self.spec.fps,
            commands=commands,
        )
        success, _, evidence = self.judge.see(state.evidence, seen, options)
        stamp_ns = state.observation.stamp_ns + round(frames.shape[1] / self.spec.fps * 1e9)
        after = state.after(
            frames,
            positions[-1],
            stamp_ns,
            self.spec.num_history,
            evidence,
            background,
            masks,
        )
        return ObservedChunk(start_masks=start_masks, masks=masks, success=success), after

    def _without_marks(
        self, frames: ByteArray, control: ControlInputs, scene: ControlScene
    ) -> tuple[ByteArray, tuple[str, ...]]:
        """Return imagined frames without colours of the drawn marks, and a remark on them."""
        if control.video is None or not isinstance(self.control, TrajectoryVideo):
            return frames, ()
        last = 1 + frames.shape[1]
        leaks = find_leaks(
            frames,
            control.video[:, 1:last],
            scene.start_frames,
            None if scene.objects is None else scene.objects[:, :last],
            len(self.robot.tools),
        )
        return without_leaks(frames, leaks), leak_remarks(leaks)

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
