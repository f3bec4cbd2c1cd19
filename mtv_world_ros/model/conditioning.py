"""What the transformer is conditioned on, in latents: control, start image, reference.

Shape letters: B batch, V views, T frames, H W pixels, C latent channels, F latent frames,
h w = latent size.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mtv_world_ros.model.autoencoder import SpaceToDepthAutoencoder


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditioning:
    """Latents a chunk is denoised under.

    Attributes:
        control: (B, V, C, F, h, w) of the trajectory video's frames 1 .. T.
        start_control: (B, V, C, h, w) of its frame 0.
        start: (B, V, C, F, h, w) the start image in every frame's channel slot.
        reference: (B, V, C, h, w) of the start image.
        actions: what `ActionEncoding` made of the commands, where they are not drawn.
    """

    control: Tensor
    start_control: Tensor
    start: Tensor
    reference: Tensor
    actions: Tensor | None = None


def encode_frames(autoencoder: SpaceToDepthAutoencoder, frames: Tensor) -> Tensor:
    """Returns (B, V, C, F, h, w) latents of (B, V, T, H, W, 3) uint8 RGB frames."""
    video = frames.to(autoencoder.dtype).div(127.5).sub(1.0).movedim(-1, 2)
    latents = autoencoder.encode(video.flatten(0, 1))
    return latents.unflatten(0, frames.shape[:2])


def decode_frames(autoencoder: SpaceToDepthAutoencoder, latents: Tensor) -> Tensor:
    """Returns (B, V, T, H, W, 3) uint8 RGB frames of (B, V, C, F, h, w) latents."""
    video = autoencoder.decode(latents.flatten(0, 1)).unflatten(0, latents.shape[:2])
    pixels = video.float().add(1.0).mul(127.5).round().clamp(0, 255)
    return pixels.to(torch.uint8).movedim(2, -1)


def condition(
    autoencoder: SpaceToDepthAutoencoder, start_frame: Tensor, trajectory_frames: Tensor
) -> Conditioning:
    """Returns the latents to denoise under.

    Args:
        autoencoder: of the preset.
        start_frame: (B, V, H, W, 3) uint8 RGB.
        trajectory_frames: (B, V, 1 + T, H, W, 3) uint8 RGB; frame k shows the state after
            command k.
    """
    control = encode_frames(autoencoder, trajectory_frames)
    reference, start = _start(autoencoder, start_frame, control.shape[3] - 1)
    return Conditioning(
        control=control[:, :, :, 1:],
        start_control=control[:, :, :, 0],
        start=start,
        reference=reference,
    )


def _start(
    autoencoder: SpaceToDepthAutoencoder, start_frame: Tensor, num_latent_frames: int
) -> tuple[Tensor, Tensor]:
    """(B, V, C, h, w) reference latents and the (B, V, C, F, h, w) start-image slot."""
    reference = encode_frames(autoencoder, start_frame.unsqueeze(2))[:, :, :, 0]
    return reference, reference.unsqueeze(3).expand(-1, -1, -1, num_latent_frames, -1, -1)


def condition_on_actions(
    autoencoder: SpaceToDepthAutoencoder, start_frame: Tensor, actions: Tensor, num_frames: int
) -> Conditioning:
    """Returns the latents to denoise under where actions are not drawn: no trajectory video.

    Its latents are zero, so that the transformer keeps its shape, and with it public weights.

    Args:
        autoencoder: of the preset.
        start_frame: (B, V, H, W, 3) uint8 RGB.
        actions: what `ActionEncoding` gives, of the whole batch.
        num_frames: T.
    """
    reference, start = _start(autoencoder, start_frame, num_frames)
    return Conditioning(
        control=torch.zeros_like(start),
        start_control=torch.zeros_like(reference),
        start=start,
        reference=reference,
        actions=actions,
    )
