"""Batches of recordings and options of short trainings, as tests want them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mtv_world_ros.data.recording import Recording
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.lab.training.clips.batches import BatchSource
from mtv_world_ros.lab.training.training_config import TrainingConfig
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter

#: options of `train` for one step of a tiny model
ONE_STEP = (
    '--set=transformer.num_attention_heads=2',
    '--set=transformer.attention_head_dim=12',
    '--set=transformer.ffn_dim=32',
    '--set=transformer.num_layers=1',
    '--set=transformer.stem_widths=[8, 16, 16]',
    '--set=transformer.freq_dim=16',
    '--set=video.width=48',
    '--set=video.height=40',
    '--set=optimizer.batch_size=1',
    '--set=optimizer.steps=1',
)


def with_batch_size(config: TrainingConfig, batch_size: int) -> TrainingConfig:
    """The same with another batch size."""
    return config.replace(optimizer=config.optimizer.replace(batch_size=batch_size))


def make_source(
    recordings: Sequence[Recording], config: TrainingConfig, robot: RobotModel, **more: Any
) -> BatchSource:
    """Their batches, with colour masks and seed 0."""
    segmenter = ColourSegmenter()
    return BatchSource(recordings, config, robot=robot, segmenter=segmenter, seed=0, **more)
