"""The small preset's autoencoder: pixels rearranged to half size, nothing learned, nothing lost.

A learned convolutional autoencoder beside a model this small costs more than it gives (measured,
see `benchmark/results/`), so the latents are the pixels themselves. The interface is that of
diffusers' autoencoders as far as the world model uses it.
"""

from __future__ import annotations

from diffusers import ConfigMixin, ModelMixin
from diffusers.configuration_utils import register_to_config
import torch
from torch import Tensor
import torch.nn.functional as F


class SpaceToDepthAutoencoder(ModelMixin, ConfigMixin):
    """Maps RGB video in [-1, 1] to latents of `3 * block_size**2` channels and back, exactly.

    Shapes: B batch, F frames, H W pixels, h w = H / block_size, W / block_size.
    """

    #: whether a chunk is encoded and denoised together with the frame that it starts from
    includes_start = False

    @register_to_config
    def __init__(self, block_size: int = 2) -> None:
        super().__init__()
        self.block_size = block_size
        # ModelMixin asks a parameter for device and dtype; a buffer serves both.
        self.register_buffer('scale', torch.ones(()), persistent=True)

    @property
    def latent_channels(self) -> int:
        """Channels of the latents."""
        return 3 * self.block_size**2

    def num_latent_frames(self, num_frames: int) -> int:
        """Latent frames that denoising a chunk of T frames takes."""
        return num_frames

    def encode(self, video: Tensor) -> Tensor:
        """Returns (B, C, F, h, w) latents of a (B, 3, F, H, W) video."""
        frames = video.transpose(1, 2).flatten(0, 1)
        latents = F.pixel_unshuffle(frames, self.block_size) * self.scale
        return latents.unflatten(0, (video.shape[0], -1)).transpose(1, 2)

    def decode(self, latents: Tensor) -> Tensor:
        """Returns the (B, 3, F, H, W) video of (B, C, F, h, w) latents."""
        frames = latents.transpose(1, 2).flatten(0, 1)
        video = F.pixel_shuffle(frames / self.scale, self.block_size)
        return video.unflatten(0, (latents.shape[0], -1)).transpose(1, 2)
