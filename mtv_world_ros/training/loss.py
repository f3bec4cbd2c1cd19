"""The loss of one batch: from frames and actions to a number."""

from __future__ import annotations

import torch
from torch import Tensor

from mtv_world_ros.model.action_features import EE_MLP
from mtv_world_ros.model.autoencoder import SpaceToDepthAutoencoder
from mtv_world_ros.model.conditioning import (
    condition,
    condition_on_actions,
    Conditioning,
    encode_chunk,
)
from mtv_world_ros.model.parts import Autoencoder
from mtv_world_ros.model.transformer import MultiViewWanTransformer
from mtv_world_ros.training.batches import Batch
from mtv_world_ros.training.config import TrainingConfig
from mtv_world_ros.training.objective import (
    add_noise,
    draw_sigmas,
    latent_weights,
    pixel_weights,
    pooled_weights,
    sample_loss,
)


def batch_loss(
    transformer: MultiViewWanTransformer,
    autoencoder: Autoencoder,
    batch: Batch,
    config: TrainingConfig,
    generator: torch.Generator,
    device: torch.device,
) -> Tensor:
    """Returns the loss of a batch.

    Args:
        transformer: on `device`, in the number format of forward and backward.
        autoencoder: on `device`, in float32.
        batch: clips.
        config: the preset.
        generator: on the CPU; noise levels, noise and dropped actions are drawn from it.
        device: where to compute.
    """
    objective, dtype = config.objective, transformer.dtype
    frames = batch.frames.to(device)
    cond = _condition(autoencoder, batch, device)
    clean = encode_chunk(autoencoder, frames)
    sigmas = draw_sigmas(len(frames), objective, generator)
    noise = torch.randn(clean.shape, generator=generator).to(device)
    noisy = add_noise(clean, noise, sigmas.to(device))
    predicted = transformer(
        noisy.to(dtype),
        (sigmas * 1000).to(device),
        control=cond.control.to(dtype),
        start=cond.start.to(dtype),
        reference=cond.reference.to(dtype),
        start_control=cond.start_control.to(dtype),
        actions=cond.actions,
        actions_kept=_kept(len(frames), config, generator, device),
    )
    ids = None if batch.object_ids is None else batch.object_ids.to(device)
    weights = _latent_weights(pixel_weights(frames, ids, objective), autoencoder, clean)
    target = clean if transformer.prediction == 'sample' else noise - clean
    return sample_loss(predicted, target, weights, objective.huber_delta)


def _condition(autoencoder: Autoencoder, batch: Batch, device: torch.device) -> Conditioning:
    start = batch.start_frame.to(device)
    if batch.actions is None:
        assert batch.trajectory is not None
        return condition(autoencoder, start, batch.trajectory.to(device))
    num_frames = batch.frames.shape[2] - 1
    return condition_on_actions(autoencoder, start, batch.actions.to(device), num_frames)


def _kept(
    count: int, config: TrainingConfig, generator: torch.Generator, device: torch.device
) -> Tensor | None:
    """(B,) bool, False where a sample goes without its actions."""
    if config.video.control != EE_MLP:
        return None
    return (torch.rand(count, generator=generator) >= config.augment.action_dropout).to(device)


def _latent_weights(weights: Tensor, autoencoder: Autoencoder, clean: Tensor) -> Tensor:
    """Pixels' weights (B, V, T, H, W) in the shape of the latents."""
    if isinstance(autoencoder, SpaceToDepthAutoencoder):
        return latent_weights(weights, autoencoder.block_size)
    return pooled_weights(weights, clean.shape)
