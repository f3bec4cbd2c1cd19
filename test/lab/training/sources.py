"""Batches of recordings, as tests want them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mtv_world_ros.data.recording import Recording
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.lab.training.clips.batches import BatchSource
from mtv_world_ros.lab.training.training_config import TrainingConfig
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter


def with_batch_size(config: TrainingConfig, batch_size: int) -> TrainingConfig:
    """The same with another batch size."""
    return config.replace(optimizer=config.optimizer.replace(batch_size=batch_size))


def make_source(
    recordings: Sequence[Recording], config: TrainingConfig, robot: RobotModel, **more: Any
) -> BatchSource:
    """Their batches, with colour masks and seed 0."""
    segmenter = ColourSegmenter()
    return BatchSource(recordings, config, robot=robot, segmenter=segmenter, seed=0, **more)
