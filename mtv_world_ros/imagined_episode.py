"""An episode in the world model: its state from chunk to chunk, imagined or observed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TYPE_CHECKING

import numpy as np

from mtv_world_ros.data_types import (
    ByteArray,
    CameraModel,
    FloatArray,
    JointTrajectory,
    ObjectMasks,
    Observation,
    SuccessEstimate,
)
from mtv_world_ros.errors import RolloutPreempted
from mtv_world_ros.geometry.chunk_plan import Plan, PlanLimits
from mtv_world_ros.geometry.motion import Motion
from mtv_world_ros.prediction import mean_of_seeds, Prediction
from mtv_world_ros.rendering.images import resize_frames
from mtv_world_ros.rollout_state import RolloutState
from mtv_world_ros.vision.camera_check import CameraCheck
from mtv_world_ros.vision.describers.describer import name_objects

if TYPE_CHECKING:
    from mtv_world_ros.pipeline import Pipeline

#: distance between the seeds of an episode's rollouts, so that those of their chunks never meet
SEED_STEP = 1_000_003


class ObservedChunk(NamedTuple):
    """Masks and estimate of real frames; `start_masks` are of the frame before them (T = 1)."""

    start_masks: ObjectMasks
    masks: ObjectMasks
    success: SuccessEstimate


@dataclass(slots=True, kw_only=True)
class ImaginedEpisode:
    """An episode in the world model: owns the state that is carried from chunk to chunk.

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
        camera_check: calibration check on the first frames; its corrections are applied.
        doubt: why the fitted physics does not hold here, which widens the estimate; empty = no
            contradiction was observed.
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

    def extend(self, trajectory: JointTrajectory | Plan) -> Iterator[Prediction]:
        """Imagines a trajectory from where the episode stands; yields each chunk once it is ready.

        An error leaves the episode at the end of the last chunk that was completed.

        Args:
            trajectory: times count from the stamp of `observation`; or a plan that was checked.

        Raises:
            TrajectoryError: the trajectory does not fit the robot.
            CalibrationError: a lens' distortion moves a tool out of the middle of the image.
            DescriptionError: the describer failed.
            RolloutPreempted: `should_stop` said so.
            ModelMemoryError: the device ran out of memory.
        """
        for plan in self._plan(trajectory).chunks(self.pipeline.spec):
            if plan.chunk and self.should_stop():
                raise RolloutPreempted('stopped between two chunks')
            # rollouts of further seeds branch off from the first one
            states = (self._rollouts + self._rollouts[:1] * self.num_seeds)[: self.num_seeds]
            seeds = (self.seed + self.num_chunks + SEED_STEP * r for r in range(self.num_seeds))
            made = [
                self.pipeline.imagine(self, state, plan, seed)
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
        start_masks = self.pipeline.find(self, state)
        masks = self.pipeline.follow(self, state, start_masks, frames)
        motion = Motion.of(self.pipeline.robot, state.observation.cameras, positions)
        success, memory = self.pipeline.judge(
            self, state, motion, start_masks, masks, is_real=True
        )
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

    def _plan(self, trajectory: JointTrajectory | Plan) -> Plan:
        """The plan from where the episode stands."""
        start = self.observation
        if isinstance(trajectory, Plan):
            return trajectory.after(start)
        limits = PlanLimits(tolerance=self.limit_tolerance)
        return Plan.of(trajectory, self.pipeline.robot, start, limits)
