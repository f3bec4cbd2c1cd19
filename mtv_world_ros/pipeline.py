"""The main path: an observation and a joint trajectory in, imagined video and estimate out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from math import ceil
from types import MappingProxyType
from typing import NamedTuple, Protocol

import numpy as np

from mtv_world_ros.data_types import (
    BoolArray,
    ByteArray,
    CameraModel,
    FloatArray,
    History,
    JointTrajectory,
    MultiViewVideo,
    ObjectMasks,
    Observation,
    SuccessEstimate,
    WorldModelSpec,
)
from mtv_world_ros.errors import RolloutPreempted
from mtv_world_ros.geometry.camera import camera_poses, tools_in_view
from mtv_world_ros.geometry.object_motion import (
    FoundObjects,
    ObjectMotionModel,
    TrackedObjects,
)
from mtv_world_ros.geometry.resample import match_joints, resample
from mtv_world_ros.geometry.robot.model import check_positions, LIMIT_TOLERANCE, RobotModel
from mtv_world_ros.prediction import mean_of_seeds, Prediction, StageClock
from mtv_world_ros.rendering.images import resize_frames
from mtv_world_ros.rendering.trajectory_video import (
    render_trajectory_video,
    TrajectoryVideoConfig,
)
from mtv_world_ros.rollout_state import ChunkPlan, fit_observation, RolloutState
from mtv_world_ros.success.calibration import HorizonCurve
from mtv_world_ros.success.estimator import Judged, SuccessEstimator
from mtv_world_ros.success.foreseen import foreseen_of, ForeseenMotions
from mtv_world_ros.success.rollout_memory import footage_of
from mtv_world_ros.vision.describers.describer import Describer, name_objects
from mtv_world_ros.vision.segmenters.segmenter import Segmenter

#: the seeds of an episode's rollouts lie so far apart that those of their chunks never meet
SEED_STEP = 1_000_003
#: objects are foreseen so far at once, before the first chunk of it is imagined [s]
_FORESEEN_S = 12.0
#: of an estimate for which the model was shown no motion
_UNSEEN = 'no view shows a tool at any time'


class WorldModel(Protocol):
    """Predicts one chunk of frames."""

    @property
    def spec(self) -> WorldModelSpec:
        """What it takes and gives."""
        ...

    def predict(
        self,
        start_frame: ByteArray,
        trajectory_frames: ByteArray,
        *,
        positions: FloatArray,
        seed: int,
        num_inference_steps: int,
        should_stop: Callable[[], bool],
        history: History | None = None,
    ) -> ByteArray:
        """Returns (V, T, H, W, 3) uint8 RGB predicted frames.

        Args:
            start_frame: (V, H, W, 3) uint8 RGB, the frame the chunk starts from.
            trajectory_frames: (V, 1 + T, H, W, 3) uint8 RGB; frame k shows the state after
                command k, frame 0 the start.
            positions: (1 + T, J) what was drawn: row 0 where the robot stands, row k command k
                [rad or m]; for models that take actions as numbers.
            seed: seed of the noise.
            num_inference_steps: denoising steps.
            should_stop: asked between steps.
            history: the frames before the start frame; None = the episode begins there.

        Raises:
            RolloutPreempted: `should_stop` said so.
            ModelMemoryError: the device ran out of memory.
        """
        ...


def _never() -> bool:
    return False


@dataclass(frozen=True, slots=True, kw_only=True)
class Pipeline:
    """What imagines and judges; holds no state: `begin` returns the object that does.

    Attributes:
        robot: joints, limits and tools.
        world_model: predicts chunks.
        segmenter: finds the objects' masks.
        estimator: judges the outcome.
        rendering: how trajectory videos look; must be what the model was trained with.
        object_mask: whether trajectory videos carry the object masks.
        objects: names of the objects; empty = the describer's.
        describer: names the objects of an episode's first frame; None = the instruction's words.
        horizon: how J falls with the horizon, where it was measured.
        object_motion: where objects go, for models whose trajectory videos show that; None = the
            trajectory video shows them where they were.
    """

    robot: RobotModel
    world_model: WorldModel
    segmenter: Segmenter
    estimator: SuccessEstimator
    rendering: TrajectoryVideoConfig
    object_mask: bool = True
    objects: tuple[str, ...] = ()
    describer: Describer | None = None
    horizon: HorizonCurve | None = None
    object_motion: ObjectMotionModel | None = None

    @property
    def spec(self) -> WorldModelSpec:
        """Of the world model."""
        return self.world_model.spec

    def with_robot(self, robot: RobotModel) -> Pipeline:
        """Returns the same for a robot of the same joints and tools, e.g. a calibrated one."""
        motion = self.object_motion
        return replace(
            self,
            robot=robot,
            object_motion=None if motion is None else motion.with_robot(robot),
        )

    def without_foresight(self) -> Pipeline:
        """Returns the paper's way: trails and first masks are drawn, no motion is foreseen."""
        return replace(self, object_motion=None)

    def begin(
        self,
        observation: Observation,
        *,
        instruction: str = '',
        objects: tuple[str, ...] = (),
        seed: int = 0,
        num_seeds: int = 1,
        num_inference_steps: int = 0,
        limit_tolerance: float = LIMIT_TOLERANCE,
        should_stop: Callable[[], bool] = _never,
    ) -> ImaginedEpisode:
        """Returns an episode that begins at an observation (V views, any image size).

        The other arguments are the attributes of `ImaginedEpisode`.

        Raises:
            ObservationError: the views are not the model's.
        """
        return ImaginedEpisode(
            pipeline=self,
            instruction=instruction,
            objects=objects,
            seed=seed,
            num_seeds=num_seeds,
            num_inference_steps=num_inference_steps,
            limit_tolerance=limit_tolerance,
            should_stop=should_stop,
            _rollouts=(RolloutState.at(observation, self.spec),),
        )

    def draw(
        self,
        cameras: tuple[CameraModel, ...],
        positions: FloatArray,
        times: FloatArray,
        start_masks: ObjectMasks,
        objects: ByteArray | None = None,
    ) -> MultiViewVideo:
        """Returns the 1 + T frames of the trajectory video, at the cameras' size.

        Args:
            cameras: V cameras.
            positions: (1 + T, J) [rad or m].
            times: (1 + T,) [s].
            start_masks: of the start frame.
            objects: (V, 1 + T, H, W, 4) of `moved_pictures`, in place of the masks.
        """
        return render_trajectory_video(
            cameras=cameras,
            robot=self.robot,
            positions=positions,
            times=times,
            object_masks=start_masks.masks[:, :, 0] if self.object_mask else None,
            objects=objects,
            config=self.rendering,
        )


class ObservedChunk(NamedTuple):
    """What was found in real frames: masks of the frame before them (T = 1) and of all of them."""

    start_masks: ObjectMasks
    masks: ObjectMasks
    success: SuccessEstimate


@dataclass(slots=True, kw_only=True)
class ImaginedEpisode:
    """An episode in the world model: owns everything that goes from chunk to chunk.

    It has `num_seeds` rollouts of the same plans that differ in their noise; the first one is
    what `observation` and the predictions show, the estimate is the mean of all. The attributes
    may be changed between two calls of `extend`; they hold from then on.

    Attributes:
        pipeline: imagines and judges.
        instruction: what the robot was told; names the objects unless they are given.
        objects: names of the objects; empty = the pipeline's, else its describer's, which is
            asked once for each instruction, else those of the instruction.
        seed: of the noise; chunk k of rollout r uses `seed + k + r * SEED_STEP`.
        num_seeds: rollouts; each takes as long as one.
        num_inference_steps: denoising steps a chunk; 0 = those the model is made for.
        limit_tolerance: joints may exceed their limits by this [rad or m].
        should_stop: asked between denoising steps and between chunks.
        num_chunks: imagined so far.
    """

    pipeline: Pipeline
    instruction: str
    objects: tuple[str, ...]
    seed: int
    num_seeds: int
    num_inference_steps: int
    limit_tolerance: float
    should_stop: Callable[[], bool]
    num_chunks: int = field(default=0, init=False)
    _rollouts: tuple[RolloutState, ...]
    _described: dict[str, tuple[str, ...]] = field(default_factory=dict)
    _whole: dict[tuple[str, ...], FoundObjects] = field(default_factory=dict)

    @property
    def observation(self) -> Observation:
        """Where the episode stands now, at the model's size: its last frame, or its first one."""
        return self._rollouts[0].observation

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects.

        Raises:
            DescriptionError: the describer failed.
        """
        if self.objects or self.pipeline.objects:
            return self.objects or self.pipeline.objects
        if self.instruction not in self._described:
            self._described[self.instruction] = name_objects(
                self.instruction,
                describer=self.pipeline.describer,
                first_frame=lambda: self._rollouts[0].first.frames[0],
            )
        return self._described[self.instruction]

    def extend(self, trajectory: JointTrajectory) -> Iterator[Prediction]:
        """Imagines a trajectory from where the episode stands; yields each chunk once it is ready.

        An error leaves the episode at the end of the last chunk that was completed.

        Args:
            trajectory: times count from the stamp of `observation`.

        Raises:
            TrajectoryError: the trajectory does not fit the robot.
            CalibrationError: a lens' distortion moves a tool out of the middle of the image.
            DescriptionError: the describer failed.
            RolloutPreempted: `should_stop` said so.
            ModelMemoryError: the device ran out of memory.
        """
        plans = self._plan_chunks(trajectory)
        for plan in plans:
            if plan.chunk:
                self._check_stop()
            # rollouts of further seeds branch off from the first one
            states = (self._rollouts + self._rollouts[:1] * self.num_seeds)[: self.num_seeds]
            seeds = (self.seed + self.num_chunks + SEED_STEP * r for r in range(self.num_seeds))
            made = [
                self._imagine_chunk(state, plans[plan.chunk :], seed)
                for state, seed in zip(states, seeds, strict=True)
            ]
            self._rollouts = tuple(state for _, state in made)
            self.num_chunks += 1
            yield mean_of_seeds([prediction for prediction, _ in made])

    def observe(
        self,
        frames: ByteArray,
        positions: FloatArray,
        cameras: tuple[CameraModel, ...] | None = None,
    ) -> ObservedChunk:
        """Takes real frames instead of imagining some; the episode then stands at the last one.

        Args:
            frames: (V, T, H', W', 3) uint8 RGB after `observation`, at the model's frame rate and
                any size.
            positions: (1 + T, J) measured [rad or m]; row 0 where the robot stood before. So a
                gripper that something holds apart is not taken to be open.
            cameras: as they are at the last frame, at the model's size; None = as before.
        """
        spec, state = self.pipeline.spec, self._rollouts[0]
        frames = np.stack([resize_frames(view, spec.width, spec.height) for view in frames])
        start_masks = self._find_start_masks(state)
        masks = self._follow_masks(state, start_masks, frames)
        success, memory = self._judge(state, positions, start_masks, masks, is_real=True)
        stamp_ns = state.observation.stamp_ns + round(frames.shape[1] / spec.fps * 1e9)
        state = state.after(frames, positions[-1], stamp_ns, spec.num_history, memory)
        last = replace(state.observation, cameras=cameras or state.observation.cameras)
        self._rollouts = (replace(state, observation=last, num_imagined=0, source=last),)
        return ObservedChunk(start_masks=start_masks, masks=masks, success=success)

    def branch(self, observation: Observation) -> ImaginedEpisode:
        """Returns an episode that begins at a later real observation and remembers this one.

        What the estimate remembers (grasps, first masks, where objects have been) goes on, and
        what objects look like where nothing hides them; the model's history begins again. This
        episode stays as it is.

        Raises:
            ObservationError: the views are not the model's.
        """
        state, before = RolloutState.at(observation, self.pipeline.spec), self._rollouts[0]
        state = replace(state, memory=before.memory, first=before.first)
        return replace(self, _rollouts=(state,))

    def _plan_chunks(self, trajectory: JointTrajectory) -> list[ChunkPlan]:
        """The trajectory on the model's clock, cut into chunks."""
        robot, spec, start = self.pipeline.robot, self.pipeline.spec, self.observation
        trajectory = match_joints(trajectory, robot, start.positions)
        check_positions(robot, trajectory.positions, tolerance=self.limit_tolerance)
        total = max(1, ceil(float(trajectory.times[-1]) * spec.fps - 1e-6))
        num_chunks = ceil(total / spec.num_frames)
        times = np.arange(num_chunks * spec.num_frames + 1) / spec.fps
        positions = resample(trajectory, start.positions, times)
        return [
            ChunkPlan(
                times=times[first : first + spec.num_frames + 1],
                positions=positions[first : first + spec.num_frames + 1],
                num_frames=min(spec.num_frames, total - first),
                stamp_ns=start.stamp_ns,
                chunk=chunk,
                num_chunks=num_chunks,
                trajectory=trajectory,
                current=start.positions,
            )
            for chunk, first in enumerate(range(0, total, spec.num_frames))
        ]

    def _check_stop(self) -> None:
        if self.should_stop():
            raise RolloutPreempted('stopped between two chunks')

    def _imagine_chunk(
        self, state: RolloutState, plans: Sequence[ChunkPlan], seed: int
    ) -> tuple[Prediction, RolloutState]:
        """One chunk of one rollout, stage by stage, and where the rollout stands then.

        Args:
            state: where it stands.
            plans: what is left of the trajectory, the chunk first.
            seed: of the noise.
        """
        plan = plans[0]
        pipeline, start, clock = self.pipeline, state.observation, StageClock()
        num_steps = self.num_inference_steps or pipeline.spec.num_inference_steps
        shown = [tools_in_view(c, pipeline.robot, plan.positions) for c in start.cameras]
        start_masks = self._find_start_masks(state)
        clock.lap('start masks')
        pictures, ahead = self._move_objects(state, plans, start_masks)
        clock.lap('object motion')
        control = pipeline.draw(start.cameras, plan.positions, plan.times, start_masks, pictures)
        clock.lap('trajectory video')
        frames = pipeline.world_model.predict(
            start.frames,
            control.frames,
            positions=plan.positions,
            seed=seed,
            num_inference_steps=num_steps,
            should_stop=self.should_stop,
            history=state.history,
        )[:, : plan.num_frames]
        clock.lap('model')
        masks = self._follow_masks(state, start_masks, frames)
        clock.lap('masks')
        positions = plan.positions[: plan.num_frames + 1]
        success, memory = self._judge(state, positions, start_masks, masks, *ahead[:1])
        if not any(shown):
            success = replace(success, reasons=(*success.reasons, _UNSEEN))
        clock.lap('success')
        times = plan.times[1 : plan.num_frames + 1]
        stamp_ns = plan.stamp_ns + round(float(times[-1]) * 1e9)
        state = state.after(
            frames, positions[-1], stamp_ns, pipeline.spec.num_history, memory, ahead
        )
        prediction = Prediction(
            start=start,
            video=MultiViewVideo(views=start.views, times=times, frames=frames),
            seed=seed,
            positions=positions[1:],
            trajectory_video=control,
            start_masks=start_masks,
            masks=masks,
            success=success,
            stamp_ns=plan.stamp_ns,
            chunk=plan.chunk,
            num_chunks=plan.num_chunks,
            imagined_seconds=state.num_imagined / pipeline.spec.fps,
            horizon=pipeline.horizon,
            segmenter=pipeline.segmenter.name,
            num_inference_steps=num_steps,
            in_view=np.array(shown),
            seconds=MappingProxyType(clock.seconds),
        )
        return prediction, state

    def _move_objects(
        self, state: RolloutState, plans: Sequence[ChunkPlan], start_masks: ObjectMasks
    ) -> tuple[ByteArray | None, tuple[FoundObjects, ...]]:
        """Pictures (V, 1 + T, H, W, 4) of the objects on their way, and the objects after a plan.

        None where the model is not shown them. The objects are those after each of the `plans`,
        or of the first ones of them.
        """
        pipeline, plan = self.pipeline, plans[0]
        if pipeline.object_motion is None or not pipeline.rendering.object_motion:
            return None, ()
        poses = self._camera_poses(plan.positions, state.observation.cameras)
        ahead = state.ahead
        if plan.chunk == 0 or not ahead or ahead[0].names != self.names:
            objects = state.objects
            if objects is None or objects.names != self.names:
                objects = self._find_objects(state, start_masks)
            plans = plans[: ceil(_FORESEEN_S / float(plan.times[-1] - plan.times[0]))]
            ahead = objects.foresee(self._commands(plans, objects.tracked))
            shown = ahead[-1].medoid(self._believed(state, plans[-1], ahead[-1]))
            shows = [objects.shown, *[shown] * len(ahead)]
            ahead = tuple(
                replace(part, shown=shown, shown_before=before)
                for part, before in zip(ahead, shows, strict=False)
            )
        times = plan.times - plan.times[0]
        return ahead[0].pictures(times, state.observation.cameras, poses), ahead

    def _commands(
        self, plans: Sequence[ChunkPlan], objects: TrackedObjects
    ) -> Iterator[FloatArray]:
        """The joints of plans, as finely as objects are tracked."""
        for number, plan in enumerate(plans):
            if number:
                self._check_stop()
            yield plan.fine_positions(objects.step_s, objects.commands_a_step)

    def _find_objects(self, state: RolloutState, start_masks: ObjectMasks) -> FoundObjects:
        """The named objects where the rollout stands."""
        # at its own size the real frame shows better where they are; where the names have
        # changed only an imagined frame shows where they are now
        source = state.source if state.objects is None else state.observation
        if source is state.first:
            return self._find_whole(source, start_masks)
        frames, masks = state.observation.frames, start_masks.masks[:, :, 0]
        if state.objects is not None:
            return self._found(source, frames, masks)
        return self._found(source, frames, masks, self._find_whole(state.first))

    def _find_whole(
        self, first: Observation, start_masks: ObjectMasks | None = None
    ) -> FoundObjects:
        """The named objects in the episode's first real frame, in which they count as whole."""
        if self.names not in self._whole:
            frames = fit_observation(first, self.pipeline.spec).frames
            if start_masks is None:
                start_masks = self.pipeline.segmenter.segment(frames[:, None], self.names)
            found = self._found(first, frames, start_masks.masks[:, :, 0])
            self._whole[self.names] = replace(found, is_whole=True)
        return self._whole[self.names]

    def _found(
        self,
        source: Observation,
        frames: ByteArray,
        masks: BoolArray,
        whole: FoundObjects | None = None,
    ) -> FoundObjects:
        """Objects of masks (V, O, H, W) in frames (V, H, W, 3), of the model's size.

        Args:
            source: the same frames as large as there are.
            frames: they.
            masks: in them.
            whole: the same objects when nothing hid them; None = now.
        """
        model, names = self.pipeline.object_motion, self.names
        assert model is not None
        sharp = self.pipeline.segmenter.segment(source.frames[:, None], names).masks[:, :, 0]
        poses = self._camera_poses(source.positions[None], source.cameras)[:, 0]
        given = names, sharp, source.cameras, list(poses)
        if whole is None:
            return FoundObjects.at(names, frames, masks, poses, model.find(*given))
        tracked, same, hidden = model.find_again(whole.tracked, *given)
        found = FoundObjects.at(names, frames, masks, poses, tracked).shown_as(whole, hidden)
        return replace(found, is_whole=bool(same.all()))

    def _camera_poses(self, positions: FloatArray, cameras: Sequence[CameraModel]) -> FloatArray:
        """(V, N, 4, 4) T_base_camera of V cameras at positions (N, J)."""
        robot = self.pipeline.robot
        return np.stack([camera_poses(camera, robot, positions) for camera in cameras])

    def _find_start_masks(self, state: RolloutState) -> ObjectMasks:
        """Masks of the frame that a chunk starts from (T = 1)."""
        return self.pipeline.segmenter.segment(state.observation.frames[:, None], self.names)

    def _follow_masks(
        self, state: RolloutState, start_masks: ObjectMasks, frames: ByteArray
    ) -> ObjectMasks:
        """Masks of the frames (V, T, H, W, 3) after the start frame."""
        return self.pipeline.segmenter.segment(
            frames,
            self.names,
            first_masks=start_masks.masks[:, :, 0],
            first_frames=state.observation.frames,
        )

    def _judge(
        self,
        state: RolloutState,
        positions: FloatArray,
        start_masks: ObjectMasks,
        masks: ObjectMasks,
        objects: FoundObjects | None = None,
        *,
        is_real: bool = False,
    ) -> Judged:
        """The estimate after a chunk with joints at (1 + T, J), and what it remembers.

        `objects` are those at the end of the whole chunk, of which T frames may be left; of real
        frames there are none.
        """
        pipeline = self.pipeline
        footage = footage_of(
            pipeline.robot, state.observation.cameras, positions, start_masks, masks
        )
        num_left = pipeline.spec.num_frames - footage.num_frames
        foreseen = None if objects is None else self._foreseen(state, objects, num_left)
        return pipeline.estimator.estimate(
            footage, self.instruction, state.memory, foreseen, is_real=is_real
        )

    def _foreseen(
        self, state: RolloutState, objects: FoundObjects, num_left: int
    ) -> ForeseenMotions | None:
        """Motions until the end of a chunk without its last frames; None = they do not count."""
        # where the rollout began earlier, objects may have been found half hidden, or in a grip
        begun = state.memory is None or state.memory.num_frames == 1 + state.num_imagined
        if not begun and not objects.is_whole:
            return None
        left_s = num_left / self.pipeline.spec.fps
        num = len(objects.motions[0].points) - round(left_s / objects.tracked.step_s)
        return foreseen_of(self.pipeline.robot, objects, num, is_begun=begun)

    def _believed(
        self, state: RolloutState, plan: ChunkPlan, objects: FoundObjects
    ) -> BoolArray | None:
        """Which motions (K,) end a plan as the most of them do; None = they do not tell.

        So pictures and the estimate say the same.
        """
        num_left = len(plan.times) - 1 - plan.num_frames
        foreseen = self._foreseen(state, objects, num_left)
        if foreseen is None:
            return None
        ends = self.pipeline.estimator.foresee(foreseen, self.instruction, state.memory)
        return None if ends is None else ends.as_most
