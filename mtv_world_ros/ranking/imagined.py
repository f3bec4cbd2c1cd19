"""Imagination as a world that policies live in: predicted frames, commanded joints, estimates."""

from __future__ import annotations

import numpy as np

from mtv_world_ros.data_types import (
    ByteArray,
    FloatArray,
    JointTrajectory,
    Observation,
    SuccessEstimate,
)
from mtv_world_ros.geometry.camera import camera_poses
from mtv_world_ros.history import History
from mtv_world_ros.pipeline import fit_observation, Pipeline
from mtv_world_ros.rendering.resize import resize_frames
from mtv_world_ros.success.describer import objects_from_instruction
from mtv_world_ros.success.rollout_memory import RolloutMemory


class ImaginedWorld:
    """One imagined episode; each answer is imagined from the last predicted frame.

    Attributes:
        success: the estimate at the end; None before the first answer.
        seconds: time by stage [s].

    Args:
        pipeline: imagines and judges.
        instruction: what the robot is told.
        seed: of the noise.
        num_inference_steps: denoising steps.
    """

    def __init__(
        self, pipeline: Pipeline, instruction: str, *, seed: int, num_inference_steps: int
    ) -> None:
        self._pipeline, self._instruction = pipeline, instruction
        self._seed, self._num_inference_steps = seed, num_inference_steps
        self._history: History | None = None
        self._memory: RolloutMemory | None = None
        self.success: SuccessEstimate | None = None
        self.seconds: dict[str, float] = {}

    def execute(self, observation: Observation, answer: JointTrajectory) -> Observation:
        """Returns the last predicted frame of the answer."""
        for chunk in self._pipeline.imagine(
            observation,
            answer,
            instruction=self._instruction,
            seed=self._seed,
            num_inference_steps=self._num_inference_steps,
            memory=self._memory,
            history=self._history,
        ):
            self._seed += 1
            self.success = chunk.success
            for stage, seconds in chunk.seconds.items():
                self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds
            observation = chunk.end_observation
            self._memory, self._history = chunk.memory, chunk.end_history
        return observation


def judge(
    pipeline: Pipeline,
    start: Observation,
    frames: ByteArray,
    positions: FloatArray,
    instruction: str,
) -> SuccessEstimate:
    """Returns the pipeline's estimate of frames that were not imagined.

    Args:
        pipeline: its segmenter and estimator judge.
        start: what was seen before the frames.
        frames: (V, T, H, W, 3) uint8 RGB, any size.
        positions: (J,) commanded at the end [rad or m].
        instruction: what the robot was told.
    """
    spec, robot = pipeline.spec, pipeline.robot
    fitted = fit_observation(start, spec)
    frames = np.stack([resize_frames(view, spec.width, spec.height) for view in frames])
    names = pipeline.objects or objects_from_instruction(instruction)
    start_masks = pipeline.segmenter.segment(fitted.frames[:, None], names)
    masks = pipeline.segmenter.segment(
        frames, names, first_masks=start_masks.masks[:, :, 0], first_frames=fitted.frames
    )
    ends, starts = (
        tuple(camera_poses(camera, robot, row[None])[0] for camera in fitted.cameras)
        for row in (positions, start.positions)
    )
    return pipeline.estimator.estimate(
        masks,
        start_masks,
        fitted.cameras,
        ends,
        instruction,
        T_base_camera_start=starts,
        gripper_openings=robot.gripper_openings(positions[None])[:, 0],
    )
