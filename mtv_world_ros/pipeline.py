"""The main path: an observation and a joint trajectory in, imagined video and estimate out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
from mtv_world_ros.foresight.episode_objects import Majority, ObjectForesight
from mtv_world_ros.geometry.camera import tools_in_view
from mtv_world_ros.geometry.chunk_plan import ChunkPlan
from mtv_world_ros.geometry.object_motion import ObjectMotionModel
from mtv_world_ros.geometry.plan_limits import check_plan
from mtv_world_ros.geometry.resample import match_joints, resample
from mtv_world_ros.geometry.robot.model import LIMIT_TOLERANCE, RobotModel
from mtv_world_ros.prediction import mean_of_seeds, Prediction, StageClock
from mtv_world_ros.rendering.images import resize_frames
from mtv_world_ros.rendering.trajectory_video import (
    render_trajectory_video,
    TrajectoryVideoConfig,
)
from mtv_world_ros.rollout_state import RolloutState
from mtv_world_ros.success.calibration import HorizonCurve
from mtv_world_ros.success.doubts import doubted, widened
from mtv_world_ros.success.estimator import Judged, SuccessEstimator
from mtv_world_ros.success.foreseen import ForeseenMotions
from mtv_world_ros.success.rollout_memory import footage_of
from mtv_world_ros.vision.camera_check import CameraCheck, CameraChecker
from mtv_world_ros.vision.describers.describer import Describer, name_objects
from mtv_world_ros.vision.segmenters.segmenter import Segmenter

#: the seeds of an episode's rollouts lie so far apart that those of their chunks never meet
SEED_STEP = 1_000_003
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
        horizon: measured J by horizon; None = not measured.
        object_motion: where objects go, for models whose trajectory videos show that; None = the
            trajectory video shows them where they were.
        camera_checker: compares the first pictures with the arm's outline; None = nothing does.
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
    camera_checker: CameraChecker | None = None

    @property
    def spec(self) -> WorldModelSpec:
        """Of the world model."""
        return self.world_model.spec

    def with_robot(self, robot: RobotModel) -> Pipeline:
        """Returns the same for a robot of the same joints and tools, e.g. a calibrated one."""
        motion, checker = self.object_motion, self.camera_checker
        return replace(
            self,
            robot=robot,
            camera_checker=None if checker is None else checker.with_robot(robot),
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
        checker = self.camera_checker
        check = CameraCheck() if checker is None else checker.check(observation)
        observation = check.corrected_observation(observation)
        return ImaginedEpisode(
            pipeline=self,
            camera_check=check,
            instruction=instruction,
            objects=objects,
            seed=seed,
            num_seeds=num_seeds,
            num_inference_steps=num_inference_steps,
            limit_tolerance=limit_tolerance,
            should_stop=should_stop,
            _rollouts=(RolloutState.at(observation, self.spec, self._objects_in(observation)),),
        )

    def _objects_in(self, observation: Observation) -> ObjectForesight:
        """The objects of an episode that begins at an observation."""
        return ObjectForesight(
            model=self.object_motion if self.rendering.object_motion else None,
            segmenter=self.segmenter,
            robot=self.robot,
            first=observation,
            source=observation,
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
        instruction: text for the robot; names the objects unless they are given.
        objects: names of the objects; empty = the pipeline's, else its describer's, which is
            asked once for each instruction, else those of the instruction.
        seed: of the noise; chunk k of rollout r uses `seed + k + r * SEED_STEP`.
        num_seeds: rollouts; each takes as long as one.
        num_inference_steps: denoising steps a chunk; 0 = those the model is made for.
        limit_tolerance: joints may exceed their limits by this [rad or m].
        should_stop: asked between denoising steps and between chunks.
        num_chunks: imagined so far.
        camera_check: what the first pictures say about the cameras, which are corrected by it.
        doubt: why the fitted physics is not to be believed, which widens the estimate; empty =
            nothing speaks against it.
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
    camera_check: CameraCheck = CameraCheck()
    doubt: str = ''
    _rollouts: tuple[RolloutState, ...]
    _described: dict[str, tuple[str, ...]] = field(default_factory=dict)

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
                first_frame=lambda: self._rollouts[0].objects.first.frames[0],
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
        for plan in self._plan_chunks(trajectory):
            if plan.chunk:
                self._check_stop()
            # rollouts of further seeds branch off from the first one
            states = (self._rollouts + self._rollouts[:1] * self.num_seeds)[: self.num_seeds]
            seeds = (self.seed + self.num_chunks + SEED_STEP * r for r in range(self.num_seeds))
            made = [
                self._imagine_chunk(state, plan, seed)
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
        state = state.after(
            frames, positions[-1], stamp_ns, spec.num_history, memory, state.objects
        )
        if cameras is not None:
            cameras = self.camera_check.corrected(cameras)
        last = replace(state.observation, cameras=cameras or state.observation.cameras)
        objects = state.objects.branch(last)
        self._rollouts = (replace(state, observation=last, num_imagined=0, objects=objects),)
        return ObservedChunk(start_masks=start_masks, masks=masks, success=success)

    def seen_points(self, num_frames: int) -> FloatArray:
        """Returns (1 + T, O, 3) where masks showed the objects in the last frames [m]."""
        memory = self._rollouts[0].memory
        assert memory is not None
        return memory.points[:, -1 - num_frames :].swapaxes(0, 1)

    def branch(self, observation: Observation) -> ImaginedEpisode:
        """Returns an episode that begins at a later real observation and remembers this one.

        What the estimate remembers (grasps, first masks, where objects have been) goes on, and
        what objects look like where nothing hides them; the model's history begins again. This
        episode stays as it is.

        Raises:
            ObservationError: the views are not the model's.
        """
        observation = self.camera_check.corrected_observation(observation)
        before = self._rollouts[0]
        objects = before.objects.branch(observation)
        state = RolloutState.at(observation, self.pipeline.spec, objects)
        return replace(self, _rollouts=(replace(state, memory=before.memory),))

    def _plan_chunks(self, trajectory: JointTrajectory) -> list[ChunkPlan]:
        """The trajectory on the model's clock, cut into chunks."""
        robot, spec, start = self.pipeline.robot, self.pipeline.spec, self.observation
        trajectory = match_joints(trajectory, robot, start.positions)
        check_plan(robot, trajectory, start.positions, tolerance=self.limit_tolerance)
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
        self, state: RolloutState, plan: ChunkPlan, seed: int
    ) -> tuple[Prediction, RolloutState]:
        """One chunk of one rollout, stage by stage, and where the rollout stands then.

        Args:
            state: the rollout so far.
            plan: the chunk.
            seed: of the noise.
        """
        pipeline, start, clock = self.pipeline, state.observation, StageClock()
        num_steps = self.num_inference_steps or pipeline.spec.num_inference_steps
        shown = [tools_in_view(c, pipeline.robot, plan.positions) for c in start.cameras]
        start_masks = self._find_start_masks(state)
        clock.lap('start masks')
        objects = state.objects.foresee(
            plan,
            start,
            self.names,
            start_masks,
            self._majority(state),
            state.is_begun,
            self.should_stop,
        )
        pictures = objects.pictures(plan, start)
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
        foreseen = objects.motions(plan, state.is_begun)
        success, memory = self._judge(state, positions, start_masks, masks, foreseen)
        unseen = () if any(shown) else (_UNSEEN,)
        success = doubted(success, (*objects.reasons, *unseen))
        success = doubted(success, refusal=objects.refusal)
        clock.lap('success')
        times = plan.times[1 : plan.num_frames + 1]
        stamp_ns = plan.stamp_ns + round(float(times[-1]) * 1e9)
        state = state.after(
            frames, positions[-1], stamp_ns, pipeline.spec.num_history, memory, objects
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
            foreseen=None if foreseen is None else foreseen.at_frames(plan),
            in_view=np.array(shown),
            seconds=MappingProxyType(clock.seconds),
        )
        return prediction, state

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
        foreseen: ForeseenMotions | None = None,
        *,
        is_real: bool = False,
    ) -> Judged:
        """The estimate after a chunk with joints at (1 + T, J), and what it remembers."""
        pipeline, cameras = self.pipeline, state.observation.cameras
        footage = footage_of(pipeline.robot, cameras, positions, start_masks, masks)
        judged = pipeline.estimator.estimate(
            footage, self.instruction, state.memory, foreseen, is_real=is_real
        )
        check = self.camera_check
        estimate = doubted(judged.estimate, check.notes, check.refusal)
        return judged._replace(estimate=widened(estimate, self.doubt) if self.doubt else estimate)

    def _majority(self, state: RolloutState) -> Majority:
        """Says which futures end as most do, so that pictures and the estimate say the same."""

        def majority(motions: ForeseenMotions) -> BoolArray | None:
            ends = self.pipeline.estimator.foresee(motions, self.instruction, state.memory)
            return None if ends is None else ends.is_majority

        return majority
