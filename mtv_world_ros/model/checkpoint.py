"""Checkpoint folders: diffusers' layout, safetensors only, and `world_model.json` beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import json
from pathlib import Path
import shutil
from typing import Any

from diffusers import FlowMatchEulerDiscreteScheduler
from safetensors import SafetensorError
from safetensors.torch import load_file
import torch

from mtv_world_ros.errors import CheckpointError
from mtv_world_ros.model.action_features import TRAJECTORY_VIDEO
from mtv_world_ros.model.actions import ActionEncoding
from mtv_world_ros.model.autoencoder import SpaceToDepthAutoencoder
from mtv_world_ros.model.card import CARD, check_card, read_card
from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.transformer import copy_of, MultiViewWanTransformer

WEIGHTS = 'diffusion_pytorch_model.safetensors'
PARTS = ('transformer', 'autoencoder', 'scheduler')


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoint:
    """The parts of a trained world model.

    Attributes:
        transformer: the diffusion transformer.
        autoencoder: pixels to latents and back.
        scheduler: noise levels and the step rule.
        card: `world_model.json`: views, fps, num_frames (T), width, height, robot, control,
            object_mask, rendering, trained_on.
        actions: how positions become the transformer's actions; None where they are drawn.
    """

    transformer: MultiViewWanTransformer
    autoencoder: SpaceToDepthAutoencoder
    scheduler: FlowMatchEulerDiscreteScheduler
    card: Mapping[str, Any]
    actions: ActionEncoding | None = None


def save_checkpoint(
    checkpoint: Checkpoint, folder: Path, *, dtype: torch.dtype = torch.float32
) -> None:
    """Writes a checkpoint folder; it appears under its name only when it is whole."""
    partial = folder.with_name(folder.name + '.partial')
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    check_card(checkpoint.card, partial)
    stored = place(copy_of(checkpoint.transformer), torch.device('cpu'), dtype)
    stored.save_pretrained(partial / 'transformer', safe_serialization=True)
    checkpoint.autoencoder.save_pretrained(partial / 'autoencoder', safe_serialization=True)
    checkpoint.scheduler.save_pretrained(partial / 'scheduler')
    if checkpoint.actions is not None:
        checkpoint.actions.save(partial)
    (partial / CARD).write_text(json.dumps(dict(checkpoint.card), indent=2) + '\n')
    if folder.exists():
        old = folder.with_name(folder.name + '.old')
        shutil.rmtree(old, ignore_errors=True)
        folder.rename(old)
        partial.rename(folder)
        shutil.rmtree(old)
    else:
        partial.rename(folder)


def load_checkpoint(folder: Path, *, dtype: torch.dtype = torch.float32) -> Checkpoint:
    """Reads a checkpoint folder.

    Raises:
        CheckpointError: a part is missing, is a pickle, or belongs to another model.
    """
    folder = Path(folder)
    card = read_card(folder)
    for part in PARTS:
        if not (folder / part).is_dir():
            raise CheckpointError(f"checkpoint '{folder}' has no folder '{part}/'")
    pickles = [p.name for p in folder.rglob('*') if p.suffix in ('.bin', '.pt', '.pth', '.ckpt')]
    if pickles:
        raise CheckpointError(
            f"checkpoint '{folder}' holds pickle files {sorted(pickles)}; only safetensors are "
            'loaded: convert them and remove these'
        )
    control = card['control']
    drawn = control == TRAJECTORY_VIDEO
    scheduler: Any = FlowMatchEulerDiscreteScheduler.from_pretrained(folder / 'scheduler')
    return Checkpoint(
        transformer=_load_part(MultiViewWanTransformer, folder / 'transformer', dtype),
        autoencoder=_load_part(SpaceToDepthAutoencoder, folder / 'autoencoder', dtype),
        scheduler=scheduler,
        card=card,
        actions=None if drawn else ActionEncoding.load(folder, control),
    )


def _load_part(kind: Any, folder: Path, dtype: torch.dtype) -> Any:
    try:
        config = json.loads((folder / 'config.json').read_text())
        tensors = load_file(folder / WEIGHTS)
    except (OSError, json.JSONDecodeError, SafetensorError) as error:
        raise CheckpointError(f"'{folder}' cannot be loaded: {error}") from error
    found = config.get('_class_name')
    if found != kind.__name__:
        raise CheckpointError(f"'{folder}' holds a {found}, expected a {kind.__name__}")
    part = kind.from_config(config)
    try:
        part.load_state_dict(tensors)
    except RuntimeError as error:
        raise CheckpointError(f"'{folder}' does not fit its config: {error}") from error
    return place(part, torch.device('cpu'), dtype).eval()
