"""The loss of one batch: from frames and actions to a number."""

from __future__ import annotations

import torch
from torch import Tensor

from mtv_world_ros.model.action_features import EE_MLP
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.training.clip_noise import Draws
from mtv_world_ros.training.clips.batches import Batch
from mtv_world_ros.training.config import TrainingConfig
from mtv_world_ros.training.encoding import drop_conditions, encode_batch, EncodedBatch, Encoders
from mtv_world_ros.training.objective import (
    add_noise,
    draw_sigmas,
    Loss,
    sample_loss,
    sigma_weights,
)


def batch_loss(
    transformer: MultiViewWanTransformer,
    encoders: Encoders,
    batch: Batch | EncodedBatch,
    config: TrainingConfig,
    draws: Draws,
    device: torch.device,
) -> Loss:
    """Returns the loss of a batch, as sums over its clips.

    Args:
        transformer: on `device`, in the number format of forward and backward.
        encoders: on `device`.
        batch: clips, or what a latent cache holds of them.
        config: the preset.
        draws: of its clips; noise levels, noise and what is dropped come from them.
        device: where to compute.
    """
    objective, dtype = config.objective, transformer.dtype
    if isinstance(batch, Batch):
        batch = encode_batch(encoders, batch, objective, device)
    clean = batch.clean
    sigmas = draw_sigmas(draws, objective)
    noise = draws.normal(*clean.shape[1:]).to(device)
    noisy = add_noise(clean, noise, sigmas.to(device))
    kept = _kept(draws, config, device)
    cond = drop_conditions(batch.conditioning, config.augment, draws)
    if cond.history is not None:
        cond = cond.with_noisy_history(draws.normal(*cond.history.shape[1:]).to(device))
    cond = cond.in_dtype(dtype)
    predicted = transformer(
        noisy.to(dtype),
        (sigmas * 1000).to(device),
        control=cond.control,
        start=cond.start,
        reference=cond.reference,
        start_control=cond.start_control,
        encoder_hidden_states=None if cond.text is None else cond.text.to(dtype),
        encoder_hidden_states_image=None if cond.image is None else cond.image.to(dtype),
        actions=cond.actions,
        actions_kept=kept,
        anchor=cond.anchor,
        history=cond.history,
        history_timestep=cond.history_timestep,
    )
    target = clean if transformer.prediction == 'sample' else noise - clean
    by_sigma = sigma_weights(sigmas, objective).to(device)
    return sample_loss(predicted, target, batch.weights, objective.huber_delta, by_sigma)


def _kept(draws: Draws, config: TrainingConfig, device: torch.device) -> Tensor | None:
    """(B,) bool, False where a sample goes without its actions."""
    if config.video.control != EE_MLP:
        return None
    return (draws.uniform() >= config.augment.action_dropout).to(device)
