"""The main path: an observation and a joint trajectory in, imagined video and estimate out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import ceil
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import numpy as np

from mtv_world_ros.data_types import (
    ByteArray,
    CameraModel,
    FloatArray,
    JointTrajectory,
    MultiViewVideo,
    ObjectMasks,
    Observation,
    Rollout,
    WorldModelSpec,
)
from mtv_world_ros.errors import ObservationError
from mtv_world_ros.geometry.camera import scaled
from mtv_world_ros.geometry.resample import match_joints, resample
from mtv_world_ros.geometry.robot import check_positions, RobotModel
from mtv_world_ros.history import fit_history, History
from mtv_world_ros.prediction import Prediction, StageClock
from mtv_world_ros.rendering.resize import resize_frames
from mtv_world_ros.rendering.trajectory_video import (
    render_trajectory_video,
    TrajectoryVideoConfig,
)
from mtv_world_ros.success.estimator import SuccessEstimator
from mtv_world_ros.success.footage import footage_of
from mtv_world_ros.success.rollout_memory import RolloutMemory
from mtv_world_ros.success.trusted_horizon import HorizonCurve
from mtv_world_ros.vision.describers.describer import objects_from_instruction
from mtv_world_ros.vision.segmenters.segmenter import Segmenter


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
            history: what of the rollout comes before the start frame; None = it begins there.

        Raises:
            RolloutPreempted: `should_stop` said so.
            ModelMemoryError: the device ran out of memory.
        """
        ...


def _never() -> bool:
    return False


@dataclass(frozen=True, slots=True, kw_only=True)
class Pipeline:
    """Everything between a message and a prediction; holds no state between rollouts.

    Attributes:
        robot: joints, limits and tools.
        world_model: predicts chunks.
        segmenter: finds the objects' masks.
        estimator: judges the outcome.
        rendering: how trajectory videos look; must be what the model was trained with.
        object_mask: whether trajectory videos carry the object masks.
        objects: names of the objects; empty = the ones the instruction names.
        horizon: how J falls with the horizon, where it was measured.
        limit_tolerance: joints may exceed their limits by this [rad or m].
    """

    robot: RobotModel
    world_model: WorldModel
    segmenter: Segmenter
    estimator: SuccessEstimator
    rendering: TrajectoryVideoConfig
    object_mask: bool = True
    objects: tuple[str, ...] = ()
    horizon: HorizonCurve | None = None
    limit_tolerance: float = 1e-3

    @property
    def spec(self) -> WorldModelSpec:
        """Of the world model."""
        return self.world_model.spec

    def accept(self, trajectory: JointTrajectory, current: FloatArray | None) -> JointTrajectory:
        """Returns the trajectory in the robot's joint order, or says why it is rejected.

        Raises:
            TrajectoryError: joints missing, positions outside the limits.
        """
        matched = match_joints(trajectory, self.robot, current)
        check_positions(self.robot, matched.positions, tolerance=self.limit_tolerance)
        return matched

    def imagine(
        self,
        observation: Observation,
        trajectory: JointTrajectory,
        *,
        instruction: str = '',
        seed: int = 0,
        num_inference_steps: int = 0,
        should_stop: Callable[[], bool] = _never,
        memory: RolloutMemory | None = None,
        history: History | None = None,
    ) -> Iterator[Prediction]:
        """Yields the predicted chunks, each as soon as it is ready.

        Args:
            observation: V views in the model's order, any size.
            trajectory: times count from the observation's stamp.
            instruction: what the robot was told; names the objects unless they are given.
            seed: of the noise; chunk k uses `seed + k`.
            num_inference_steps: denoising steps a chunk; 0 = those the model is made for.
            should_stop: asked between denoising steps.
            memory: of the prediction that the observation is the end of, where it is one: the
                estimate is about the whole, from its first observation on.
            history: `end_history` of the prediction that the observation is the end of; None = a
                rollout begins.

        Raises:
            TrajectoryError: the trajectory does not fit the robot.
            ObservationError: the views are not the model's, or the history is of another size.
            RolloutPreempted: `should_stop` said so.
            ModelMemoryError: the device ran out of memory.
        """
        spec = self.spec
        trajectory = self.accept(trajectory, observation.positions)
        total = max(1, ceil(float(trajectory.times[-1]) * spec.fps - 1e-6))
        num_chunks = ceil(total / spec.num_frames)
        start = fit_observation(observation, spec)
        past = (memory, fit_history(history, start))
        names = self.objects or objects_from_instruction(instruction)
        times = np.arange(num_chunks * spec.num_frames + 1) / spec.fps
        positions = resample(trajectory, observation.positions, times)
        num_steps = num_inference_steps or spec.num_inference_steps
        request = _Request(names, instruction, num_steps, should_stop)
        for chunk in range(num_chunks):
            first = chunk * spec.num_frames
            window = slice(first, first + spec.num_frames + 1)
            num_kept = min(spec.num_frames, total - first)
            parts = self._imagine_chunk(
                start, times[window], positions[window], num_kept, request, seed + chunk, past
            )
            prediction = Prediction(
                **parts,
                cameras=start.cameras,
                stamp_ns=observation.stamp_ns,
                chunk=chunk,
                num_chunks=num_chunks,
                horizon=self.horizon,
                segmenter=self.segmenter.name,
                num_inference_steps=num_steps,
            )
            yield prediction
            start = prediction.end_observation
            past = (prediction.memory, prediction.end_history)

    def _imagine_chunk(
        self,
        start: Observation,
        times: FloatArray,
        positions: FloatArray,
        num_kept: int,
        request: _Request,
        seed: int,
        past: tuple[RolloutMemory | None, History],
    ) -> dict[str, Any]:
        """What is made of one chunk: fields of `Prediction`."""
        clock, (memory, history) = StageClock(), past
        start_masks = self.segmenter.segment(start.frames[:, None], request.names)
        clock.lap('start masks')
        control = self.draw(start.cameras, positions, times, start_masks)
        clock.lap('trajectory video')
        frames = self.world_model.predict(
            start.frames,
            control.frames,
            positions=positions,
            seed=seed,
            num_inference_steps=request.num_inference_steps,
            should_stop=request.should_stop,
            history=history,
        )[:, :num_kept]
        clock.lap('model')
        first = start_masks.masks[:, :, 0]
        masks = self.segmenter.segment(
            frames, request.names, first_masks=first, first_frames=start.frames
        )
        clock.lap('masks')
        rollout = Rollout(
            video=MultiViewVideo(views=start.views, times=times[1 : num_kept + 1], frames=frames),
            seed=seed,
            start_frame=start.frames,
            positions=positions[1 : num_kept + 1],
        )
        footage = footage_of(
            self.robot, start.cameras, positions[: num_kept + 1], start_masks, masks
        )
        success, memory = self.estimator.estimate(footage, request.instruction, memory)
        clock.lap('success')
        return {
            'rollout': rollout,
            'trajectory_video': control,
            'start_masks': start_masks,
            'masks': masks,
            'success': success,
            'memory': memory,
            'end_history': history.after(start.frames, frames, self.spec.num_history),
            'seconds': MappingProxyType(clock.seconds),
        }

    def draw(
        self,
        cameras: tuple[CameraModel, ...],
        positions: FloatArray,
        times: FloatArray,
        start_masks: ObjectMasks,
    ) -> MultiViewVideo:
        """Returns the 1 + T frames of the trajectory video, at the cameras' size."""
        return render_trajectory_video(
            cameras=cameras,
            robot=self.robot,
            positions=positions,
            times=times,
            object_masks=start_masks.masks[:, :, 0] if self.object_mask else None,
            config=self.rendering,
        )


class _Request(NamedTuple):
    """What all chunks of a rollout share; see `Pipeline.imagine`."""

    names: tuple[str, ...]
    instruction: str
    num_inference_steps: int
    should_stop: Callable[[], bool]


def fit_observation(observation: Observation, spec: WorldModelSpec) -> Observation:
    """Returns the observation with frames and cameras at the model's size.

    Raises:
        ObservationError: the views are not the model's.
    """
    if observation.views != spec.views:
        raise ObservationError(
            f'the observation has views {list(observation.views)}, the model was trained on '
            f'{list(spec.views)} in this order'
        )
    if observation.frames.shape[1:3] == (spec.height, spec.width):
        return observation
    return Observation(
        cameras=tuple(scaled(c, spec.width, spec.height) for c in observation.cameras),
        frames=resize_frames(observation.frames, spec.width, spec.height),
        positions=observation.positions,
        stamp_ns=observation.stamp_ns,
    )
