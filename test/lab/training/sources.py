"""Tiny presets, batches of recordings and trainers of them, as tests want them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from mtv_world_ros.data.recording import Recording
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.lab.training.clips.batches import BatchSource
from mtv_world_ros.lab.training.trainer import Trainer
from mtv_world_ros.lab.training.training_config import TrainingConfig
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter

#: a model that is trained in seconds
TINY_MODEL = {
    'transformer.num_attention_heads': 2,
    'transformer.attention_head_dim': 12,
    'transformer.ffn_dim': 32,
    'transformer.num_layers': 1,
    'transformer.stem_widths': [8, 16, 16],
    'transformer.freq_dim': 16,
    'video.width': 48,
    'video.height': 40,
    'optimizer.batch_size': 1,
}


def set_options(values: dict[str, Any]) -> list[str]:
    """Options of `train` that change a preset."""
    return [f'--set={key}={value}' for key, value in values.items()]


#: options of `train` for one step of a tiny model
ONE_STEP = set_options({**TINY_MODEL, 'optimizer.steps': 1})


def with_batch_size(config: TrainingConfig, batch_size: int) -> TrainingConfig:
    """The same with another batch size."""
    return config.replace(optimizer=config.optimizer.replace(batch_size=batch_size))


def make_source(
    recordings: Sequence[Recording], config: TrainingConfig, robot: RobotModel, **more: Any
) -> BatchSource:
    """Their batches, with colour masks and seed 0."""
    segmenter = ColourSegmenter()
    return BatchSource(recordings, config, robot=robot, segmenter=segmenter, seed=0, **more)


def make_trainer(
    config: TrainingConfig, folder: Path, seed: int = 0, device: str = 'cpu', **more: Any
) -> Trainer:
    """A trainer, in bfloat16 on a GPU."""
    dtype = torch.float32 if device == 'cpu' else torch.bfloat16
    return Trainer(config, folder, seed=seed, device=device, dtype=dtype, trained_on={}, **more)


def losses_of(trainer: Trainer, source: BatchSource) -> list[float]:
    """The losses of all steps that are left; none is saved."""
    reports = trainer.run(source, save_every=1000, on_save=lambda _: None)
    return [report.loss for report in reports]
