"""Latents to tokens and back, by Wan's patches or by the small preset's convolutions.

Shape letters: B batch, V views, C latent channels, F latent frames, P of the history, H W latent
size, f p h w = token grid, D width of the transformer.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def embed_video(transformer: Any, x: Tensor, temb: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Returns tokens (B, V, f, h, w, D) of x (B, V, C_in, F, H, W), and what is skipped with.

    Args:
        transformer: its `patch_embedding` is used.
        x: noisy latents, control and start image by channel.
        temb: (B, D) embedding of their noise level.
    """
    batch, views = x.shape[:2]
    if transformer.stem == 'conv':
        frames = x.transpose(2, 3).flatten(0, 2).contiguous(memory_format=torch.channels_last)
        return transformer.patch_embedding(frames, temb, views)
    tokens = transformer.patch_embedding(x.flatten(0, 1)).unflatten(0, (batch, views))
    return tokens.movedim(2, -1), []


def embed_history(transformer: Any, history: Tensor, start: Tensor, temb: Tensor) -> Tensor:
    """Returns tokens (B, V, p, h, w, D) of the history, as of a video's later frames.

    Its control is zero: the commands that led through it are done with.

    Args:
        transformer: its `patch_embedding` is used.
        history: (B, V, C, P, H, W) latents.
        start: (B, V, C, F, H, W) the start-image slot of the video; its last frame's is taken.
        temb: (B, D) embedding of the history's noise level.
    """
    slot = start[:, :, :, -1:].expand_as(history)
    tokens, _ = embed_video(
        transformer, torch.cat([history, torch.zeros_like(slot), slot], dim=2), temb
    )
    return tokens


def embed_reference(
    transformer: Any,
    reference: Tensor,
    start_control: Tensor | None,
    anchor: Tensor | None,
    temb: Tensor,
) -> tuple[Tensor, Tensor]:
    """Returns tokens (B, V, 1, h, w, D) of the anchor or start image; keys for copying the latter.

    The convolutional stem sees the start image with its control frame; for an anchor from long
    ago there is none.

    Args:
        transformer: its `ref_conv` (phi of the paper) is used.
        reference: (B, V, C, H, W) latents of the start image.
        start_control: the same of the control frame 0.
        anchor: the same of the rollout's first frame; None = the start image is the reference.
        temb: (B, D) embedding of the video's noise level.
    """
    if anchor is not None and transformer.stem != 'conv':
        reference = anchor  # nothing is copied there
    tokens, keys = _tokens_and_keys(transformer, reference, start_control, temb)
    if anchor is not None and transformer.stem == 'conv':
        none = None if start_control is None else torch.zeros_like(start_control)
        tokens = _tokens_and_keys(transformer, anchor, none, temb)[0]
    return tokens.unflatten(0, reference.shape[:2]).movedim(2, -1).unsqueeze(2), keys


def _tokens_and_keys(
    transformer: Any, image: Tensor, control: Tensor | None, temb: Tensor
) -> tuple[Tensor, Tensor]:
    """What phi makes of (B, V, C, H, W) latents."""
    flat = image.flatten(0, 1)
    if transformer.stem == 'conv':
        assert control is not None
        flat = torch.cat([flat, control.flatten(0, 1)], dim=1)
        return transformer.ref_conv(flat.contiguous(memory_format=torch.channels_last), temb)
    tokens = transformer.ref_conv(flat)
    return tokens, tokens


def unembed(
    transformer: Any,
    kept: Tensor,
    skips: list[Tensor],
    temb: Tensor,
    keys: Tensor,
    reference: Tensor,
    like: Tensor,
) -> Tensor:
    """Returns (B, V, C, F, H, W) of the kept tokens (B, V, f, h, w, D).

    Args:
        transformer: its `proj_out` is used.
        kept: the video's tokens.
        skips: of `embed_video`.
        temb: (B, D) embedding of the video's noise level.
        keys: of `embed_reference`.
        reference: (B, V, C, H, W) latents of the start image.
        like: (B, V, C, F, H, W); only its shape is read.
    """
    batch, views, _, num_frames, height, width = like.shape
    if transformer.stem == 'conv':
        frames = transformer.proj_out(kept, skips, temb, keys, reference.flatten(0, 1))
        return frames.unflatten(0, (batch, views, num_frames)).transpose(2, 3)
    p_t, p_h, p_w = transformer.patch_size
    out = transformer.proj_out(kept)
    out = out.unflatten(-1, (p_t, p_h, p_w, -1)).permute(0, 1, 8, 2, 5, 3, 6, 4, 7)
    return out.reshape(batch, views, -1, num_frames, height, width)
