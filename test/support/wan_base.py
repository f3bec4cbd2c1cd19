"""A tiny Wan checkpoint in the true formats, and the preset that trains on top of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import yaml

from mtv_world_ros.model.wan_weights import import_weights
from mtv_world_ros.training.training_config import load_training_config, TrainingConfig
from test.support.wan_files import AUTOENCODER, TRANSFORMER, write_videox

#: the preset of the paper's size, made tiny; the episode has 5 frames a second
CHANGES: dict[str, dict[str, Any]] = {
    'transformer': {**TRANSFORMER, 'num_views': 2},
    'autoencoder': AUTOENCODER,
    'video': {'fps': 5.0, 'num_frames': 4, 'width': 32, 'height': 32, 'clip_stride_s': 2.0},
    'lora': {'rank': 4},
    'optimizer': {'batch_size': 2, 'epochs': None, 'steps': 4, 'learning_rate': 0.01},
}


def tiny_preset(folder: Path) -> Path:
    """Write `wan-1.3b` with those changes as a preset file."""
    values = load_training_config('wan-1.3b').model_dump()
    for section, changes in CHANGES.items():
        values[section] |= changes
    plain = yaml.safe_load(yaml.safe_dump(_plain(values)))
    file = folder / 'tiny.yaml'
    file.write_text(yaml.safe_dump(plain))
    return file


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(held) for key, held in value.items()}
    return list(value) if isinstance(value, tuple) else value


def make_base(folder: Path, config: TrainingConfig, prompt: str = 'pick the block') -> Path:
    """Import random weights of the published layouts."""
    import_weights(
        write_videox(folder / 'public', dtype=torch.float32),
        folder / 'base',
        transformer=config.transformer,
        autoencoder=config.autoencoder,
        scheduler=config.scheduler,
        card=config.card({}, prompt=prompt),
    )
    return folder / 'base'
