"""What a training leaves: a checkpoint of its own, or an adapter for the one it built on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from mtv_world_ros.model.actions import ActionEncoding
from mtv_world_ros.model.card import OPTIONAL_KEYS
from mtv_world_ros.model.checkpoint import Checkpoint, save_checkpoint
from mtv_world_ros.model.lora import save_adapter
from mtv_world_ros.model.parts import build_scheduler
from mtv_world_ros.training.averaged_weights import Weights
from mtv_world_ros.training.base import Base
from mtv_world_ros.training.config import TrainingConfig
from mtv_world_ros.training.encoding import Encoders


def export_adapter(
    folder: Path, weights: Weights, card: Mapping[str, Any], base: Base | None
) -> None:
    """Writes the averaged adapter in float32, with what is trained beside it and its card."""
    save_adapter(weights.worker, folder, weights=weights.averages(), card=_with_text(card, base))


def export_checkpoint(
    folder: Path,
    weights: Weights,
    card: Mapping[str, Any],
    base: Base | None,
    config: TrainingConfig,
    encoders: Encoders,
    actions: ActionEncoding | None,
    dtype: torch.dtype,
) -> None:
    """Writes the averaged weights in a number format, with all other parts beside them."""
    parts = Checkpoint(
        transformer=weights.averaged(),
        autoencoder=encoders.autoencoder,
        scheduler=build_scheduler(config.scheduler),
        card=_with_text(card, base),
        actions=actions,
        text_encoder=base and base.checkpoint.text_encoder,
        image_encoder=base and base.checkpoint.image_encoder,
    )
    save_checkpoint(parts, folder, dtype=dtype)


def _with_text(card: Mapping[str, Any], base: Base | None) -> dict[str, Any]:
    """With the prompt and guidance that the base has."""
    theirs = base.checkpoint.card if base else {}
    return {**card, **{name: theirs[name] for name in OPTIONAL_KEYS if name in theirs}}
