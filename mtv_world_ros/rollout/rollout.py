"""A rollout in the world model: its state from chunk to chunk, imagined or observed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np

from mtv_world_ros.core.data_types import (
    ByteArray,
    CameraModel,
    FloatArray,
    JointTrajectory,
    ObjectMasks,
    Observation,
    SuccessEstimate,
    WorldModelSpec,
)
from mtv_world_ros.core.errors import RolloutPreempted
from mtv_world_ros.core.images import resize_frames
from mtv_world_ros.physics.object_motion import FoundObjects
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.plan import ChunkPlan, Plan
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.prediction import mean_of_seeds, Prediction
from mtv_world_ros.rollout.state import RolloutState
from mtv_world_ros.vision.camera_check import CameraCheck

#: distance between the seeds of the rollouts of a plan, so that those of their chunks never meet
SEED_STEP = 1_000_003


class ObservedChunk(NamedTuple):
    """Masks and estimate of real frames; `start_masks` are of the frame before them (T = 1)."""

    start_masks: ObjectMasks
    masks: ObjectMasks
    success: SuccessEstimate


#: masks that were followed hold in a later observation up to this time after them [frames]
_NEXT_FRAMES = 1.5


class ChunkMaker(Protocol):
    """Imagines and judges one chunk at a time, without a state of its own; see `Pipeline`."""

    @property
    def spec(self) -> WorldModelSpec:
        """Frame size, rate and views of the world model."""
        ...

    @property
    def robot(self) -> RobotModel:
        """The robot whose joints plans move."""
        ...

    def name_objects(
        self, options: RolloutOptions, first_frame: Callable[[], ByteArray]
    ) -> tuple[str, ...]:
        """Return the names of the objects, which (H, W, 3) the first real frame may show."""
        ...

    def imagine(
        self, state: RolloutState, plan: ChunkPlan, options: RolloutOptions
    ) -> tuple[Prediction, RolloutState]:
        """Return one imagined chunk and the state after it."""
        ...

    def observe(
        self,
        state: RolloutState,
        frames: ByteArray,
        positions: FloatArray,
        options: RolloutOptions,
        commands: FloatArray | None = None,
    ) -> tuple[ObservedChunk, RolloutState]:
        """Return masks and estimate of real frames, and the state after them."""
        ...


@dataclass(slots=True, kw_only=True)
class Rollout:
    """An imagined episode: owns the state that is carried from chunk to chunk.

    It has `options.num_seeds` rollouts of the same plans that differ in their noise; the first
    one is what `observation` and the predictions show, the estimate is the mean of all.

    Attributes:
        pipeline: imagines and judges.
        options: options of the next call; may be replaced between two calls.
        num_chunks: number of imagined chunks.
    """

    pipeline: ChunkMaker
    options: RolloutOptions
    num_chunks: int = field(default=0, init=False)
    _states: tuple[RolloutState, ...]
    _described: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def observation(self) -> Observation:
        """Newest frames of the episode at the model's size: the last ones, or the first."""
        return self._states[0].observation

    @property
    def camera_check(self) -> CameraCheck:
        """Calibration check on the first frames; its corrections are applied."""
        return self._states[0].evidence.camera_check

    @property
    def objects(self) -> FoundObjects | None:
        """Objects that are foreseen, and how they moved; None = nothing is foreseen."""
        return self._states[0].evidence.objects.found

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects.

        Raises:
            DescriptionError: the describer failed.
        """
        if self.options.objects:
            return self.options.objects
        instruction = self.options.instruction
        if instruction not in self._described:
            self._described[instruction] = self.pipeline.name_objects(
                self.options, lambda: self._states[0].evidence.objects.first.frames[0]
            )
        return self._described[instruction]

    def extend(self, trajectory: JointTrajectory | Plan) -> Iterator[Prediction]:
        """Imagine a trajectory from where the episode stands; yield each chunk once it is ready.

        An error leaves the episode at the end of the last chunk that was completed.

        Args:
            trajectory: times count from the stamp of `observation`; or a plan that was checked.

        Raises:
            PlanError: the trajectory does not fit the robot.
            CalibrationError: a lens' distortion moves a tool out of the middle of the image.
            DescriptionError: the describer failed.
            RolloutPreempted: `should_stop` said so.
            ModelMemoryError: the device ran out of memory.
        """
        for plan in self._plan(trajectory).chunks(self.pipeline.spec):
            if plan.chunk and self.options.should_stop():
                raise RolloutPreempted('stopped between two chunks')
            options = self._named()
            # rollouts of further seeds branch off from the first one
            states = (self._states + self._states[:1] * options.num_seeds)[: options.num_seeds]
            first_seed = options.seed + self.num_chunks
            made = [
                self.pipeline.imagine(
                    state,
                    plan,
                    replace(
                        options,
                        seed=first_seed + SEED_STEP * number,
                        on_foreseen=None if number else options.on_foreseen,
                    ),
                )
                for number, state in enumerate(states)
            ]
            self._states = tuple(state for _, state in made)
            self.num_chunks += 1
            yield mean_of_seeds([prediction for prediction, _ in made])

    def observe(
        self,
        frames: ByteArray,
        positions: FloatArray,
        cameras: tuple[CameraModel, ...] | None = None,
        commands: FloatArray | None = None,
    ) -> ObservedChunk:
        """Take real frames instead of imagining some; the episode then stands at the last one.

        Args:
            frames: (V, T, H', W', 3) uint8 RGB after `observation`, at the model's frame rate and
                any size.
            positions: (1 + T, J) measured [rad or m]; row 0 where the robot stood before. So a
                gripper that something holds apart is not taken to be open.
            cameras: cameras at the last frame, at the model's size; None = as before.
            commands: (1 + T, J) commanded at the same times [rad or m]: fingers that do not
                follow them hold something; None = not known.
        """
        spec = self.pipeline.spec
        frames = np.stack([resize_frames(view, spec.width, spec.height) for view in frames])
        chunk, state = self.pipeline.observe(
            self._states[0], frames, positions, self._named(), commands
        )
        self._states = (state.seen_by(cameras),)
        return chunk

    def seen_points(self, num_frames: int) -> FloatArray:
        """Return (1 + T, O, 3) where masks showed the objects in the last frames [m]."""
        memory = self._states[0].evidence.memory
        assert memory is not None
        return memory.points[:, -1 - num_frames :].swapaxes(0, 1)

    def branch(self, observation: Observation) -> Rollout:
        """Return an episode that begins at a later real observation and remembers this one.

        The estimate's memory (grasps, first masks, positions of objects) and the appearance of
        whole objects are kept; the model's history begins again. This episode is not changed.

        Raises:
            ObservationError: the views are not the model's.
        """
        before = self._states[0]
        observation = before.evidence.camera_check.corrected_observation(observation)
        state = RolloutState.at(observation, self.pipeline.spec, before.evidence.at(observation))
        passed_s = 1e-9 * abs(observation.stamp_ns - before.observation.stamp_ns)
        is_next = passed_s <= _NEXT_FRAMES / self.pipeline.spec.fps
        state = replace(state, scene=before.scene, followed=before.followed if is_next else None)
        return replace(self, _states=(state,))

    def _plan(self, trajectory: JointTrajectory | Plan) -> Plan:
        """Return the plan from where the episode stands."""
        start = self.observation
        if isinstance(trajectory, Plan):
            return trajectory.after(start)
        return Plan.of(trajectory, self.pipeline.robot, start, self.options.limits)

    def _named(self) -> RolloutOptions:
        """Return the options with the names of the objects."""
        return replace(self.options, objects=self.names)
