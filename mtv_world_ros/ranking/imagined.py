"""Imagination as a world that policies live in: predicted frames, commanded joints, estimates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mtv_world_ros.data_types import (
    JointTrajectory,
    Observation,
    SuccessEstimate,
)
from mtv_world_ros.history import History
from mtv_world_ros.pipeline import fit_observation, Pipeline
from mtv_world_ros.ranking.worlds import SeenChunk
from mtv_world_ros.rendering.resize import resize_frames
from mtv_world_ros.success.footage import footage_of
from mtv_world_ros.success.rollout_memory import RolloutMemory
from mtv_world_ros.vision.describers.describer import objects_from_instruction


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
    pipeline: Pipeline, chunks: Sequence[SeenChunk], instruction: str
) -> SuccessEstimate | None:
    """Returns the pipeline's estimate of an episode that was not imagined; None without a chunk.

    Args:
        pipeline: its segmenter and estimator judge.
        chunks: what was seen, any image size.
        instruction: what the robot was told.
    """
    spec, success, memory = pipeline.spec, None, None
    names = pipeline.objects or objects_from_instruction(instruction)
    for chunk in chunks:
        start = fit_observation(chunk.start, spec)
        frames = np.stack([resize_frames(v, spec.width, spec.height) for v in chunk.frames])
        start_masks = pipeline.segmenter.segment(start.frames[:, None], names)
        masks = pipeline.segmenter.segment(
            frames, names, first_masks=start_masks.masks[:, :, 0], first_frames=start.frames
        )
        footage = footage_of(pipeline.robot, start.cameras, chunk.positions, start_masks, masks)
        success, memory = pipeline.estimator.estimate(footage, instruction, memory)
    return success
