"""Conditioning on the frames of a rollout before the chunk: history tokens and anchor.

Shape letters: B batch, V views, N frames, H W pixels, C latent channels, P latent frames, h w =
latent size.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from mtv_world_ros.errors import CheckpointError
from mtv_world_ros.model.card import HistorySettings
from mtv_world_ros.model.conditioning import Conditioning, encode_frames
from mtv_world_ros.model.parts import Autoencoder


def check_history(
    settings: HistorySettings, autoencoder: Autoencoder, transformer: Mapping[str, Any]
) -> None:
    """Checks that history frames divide into latents and tokens.

    Args:
        settings: of the model.
        autoencoder: of the model.
        transformer: configuration of the transformer.

    Raises:
        CheckpointError: they do not, or there are no reference tokens to anchor.
    """
    if settings.anchored and transformer.get('start_image', 'both') == 'channel':
        raise CheckpointError(
            "history.reference 'first_frame' needs reference tokens, which transformer."
            "start_image 'channel' leaves out; set that to both or reference"
        )
    if autoencoder.includes_start:
        merged, first = autoencoder.frames_per_latent, 1
    else:
        conv = transformer.get('stem') == 'conv'
        merged, first = transformer.get('frames_per_token', 4) if conv else 1, 0
    if settings.num_frames and (settings.num_frames - first) % merged:
        more = f'one more than a multiple of {merged}' if first else f'a multiple of {merged}'
        raise CheckpointError(
            f'{settings.num_frames} history frames do not divide into tokens; set '
            f'history.num_frames to {more}, or to 0'
        )


def with_history(
    autoencoder: Autoencoder,
    conditioning: Conditioning,
    frames: Tensor,
    sigmas: Tensor,
) -> Conditioning:
    """Returns the conditioning with clean latents of the history.

    They are encoded anew: the latents that a causal autoencoder was denoised in stand for frames
    that follow a certain start, and cannot be cut out of it.

    Args:
        autoencoder: of the preset.
        conditioning: of the chunk.
        frames: (B, V, N, H, W, 3) uint8 RGB.
        sigmas: (B,) noise levels. Where there is no history it is 1: pure noise, of which the
            timestep says so. That needs no attention mask, and every chunk has the same shapes.
    """
    return replace(conditioning, history=encode_frames(autoencoder, frames), history_sigmas=sigmas)


def without_history(
    autoencoder: Autoencoder, conditioning: Conditioning, num_frames: int
) -> Conditioning:
    """Returns the conditioning of a chunk without history: noise level 1."""
    count = autoencoder.num_latent_frames(num_frames - int(autoencoder.includes_start))
    start = conditioning.reference.unsqueeze(3)
    return replace(
        conditioning,
        history=torch.zeros_like(start).repeat(1, 1, 1, count, 1, 1),
        history_sigmas=torch.ones(len(start), device=start.device),
    )


def with_anchor(
    autoencoder: Autoencoder, conditioning: Conditioning, frame: Tensor
) -> Conditioning:
    """Returns the conditioning with reference tokens of a frame (B, V, H, W, 3) uint8 RGB."""
    anchor = encode_frames(autoencoder, frame.unsqueeze(2))[:, :, :, 0]
    return replace(conditioning, anchor=anchor)
