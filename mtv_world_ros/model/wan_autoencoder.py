"""Wan's causal video autoencoder behind the world model's interface."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from diffusers import AutoencoderKLWan
import torch
from torch import nn, Tensor


class WanAutoencoder(nn.Module):
    """Maps RGB video in [-1, 1] to normalised latents and back: 8x in space, 4x in time.

    The first latent frame holds the first video frame alone, each further one holds four: a video
    has 1 + 4 k frames. So a chunk is encoded together with the observed frame that it starts from
    (`includes_start`), and that frame is dropped after decoding.

    Shapes: B batch, N = 1 + 4 k frames, F = 1 + k latent frames, H W pixels, h w = H / 8, W / 8.
    """

    includes_start = True

    def __init__(self, vae: AutoencoderKLWan) -> None:
        super().__init__()
        self.vae = vae

    @property
    def latent_channels(self) -> int:
        """Channels of the latents."""
        return self.vae.config['z_dim']

    @property
    def frames_per_latent(self) -> int:
        """Video frames in a latent frame, but for the first one."""
        return self.vae.config['scale_factor_temporal']

    @property
    def pixels_per_latent(self) -> int:
        """Width and height of a latent position in pixels."""
        return self.vae.config['scale_factor_spatial']

    def num_latent_frames(self, num_frames: int) -> int:
        """Latent frames that denoising a chunk of T frames takes: the start's and T / 4."""
        return 1 + num_frames // self.frames_per_latent

    @property
    def dtype(self) -> torch.dtype:
        """Of the weights."""
        return self.vae.dtype

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return self.vae.device

    @property
    def config(self) -> Any:
        """The arguments that it was built with."""
        return self.vae.config

    def encode(self, video: Tensor) -> Tensor:
        """Returns (B, C, F, h, w) latents, zero mean and unit scale, of a (B, 3, N, H, W) video.

        The most likely latents, not a sample: the same video gives the same latents.
        """
        latents = self.vae.encode(video, return_dict=False)[0].mode()
        mean, std = self._statistics(latents)
        return (latents - mean) / std

    def decode(self, latents: Tensor) -> Tensor:
        """Returns the (B, 3, N, H, W) video of (B, C, F, h, w) latents."""
        mean, std = self._statistics(latents)
        return self.vae.decode(latents * std + mean, return_dict=False)[0]  # type: ignore[index]

    def save_pretrained(self, folder: Path, **options: Any) -> None:
        """Writes it as diffusers' own class."""
        self.vae.save_pretrained(folder, **options)

    def _statistics(self, like: Tensor) -> tuple[Tensor, Tensor]:
        shape = (1, -1, 1, 1, 1)
        mean, std = (
            torch.tensor(self.vae.config[name], device=like.device, dtype=like.dtype)
            for name in ('latents_mean', 'latents_std')
        )
        return mean.reshape(shape), std.reshape(shape)
