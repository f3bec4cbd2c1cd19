"""Autoencoders: Wan's, a small one with the same latent space, and space-to-depth.

Shapes: B batch, N = 1 + 4 k frames, F = 1 + k latent frames, H W pixels, h w = H / 8, W / 8.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from diffusers import AutoencoderKLWan, ConfigMixin, ModelMixin
from diffusers.configuration_utils import register_to_config
import torch
from torch import nn, Tensor
import torch.nn.functional as F

from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.model.tensor_files import read_tensors

_CHANNELS = 16
_WIDTH = 64
#: channels of the decoder's levels, from small to large images
_WIDTHS = (256, 128, 64, 64)
#: number of latent frames that are encoded or decoded in one call, limited to save memory
_TOGETHER = 7


def _conv(inputs: int, outputs: int, **options: Any) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1, **options)


class _Bound(nn.Module):
    """Soft clipping of latents to [-3, 3] (tanh)."""

    def forward(self, x: Tensor) -> Tensor:
        return 3 * torch.tanh(x / 3)


class _MemoryBlock(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv = nn.Sequential(
            _conv(2 * width, width), nn.ReLU(), _conv(width, width), nn.ReLU(), _conv(width, width)
        )

    def forward(self, x: Tensor, before: Tensor) -> Tensor:
        return F.relu(self.conv(torch.cat([x, before], dim=1)) + x)


class _MergeFrames(nn.Module):
    """(frames, C, h, w) to (frames / count, C, h, w)."""

    def __init__(self, width: int, count: int) -> None:
        super().__init__()
        self.count = count
        self.conv = nn.Conv2d(count * width, width, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(x.unflatten(0, (-1, self.count)).flatten(1, 2))


class _GrowFrames(nn.Module):
    """(frames, C, h, w) to (frames * count, C, h, w)."""

    def __init__(self, width: int, count: int) -> None:
        super().__init__()
        self.count = count
        self.conv = nn.Conv2d(width, count * width, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(x).unflatten(1, (self.count, -1)).flatten(0, 1)


class TinyAutoencoder(nn.Module):
    """Small autoencoder of RGB video in [-1, 1] that approximates Wan's normalised latents.

    It takes the place of a `WanAutoencoder`; at 288x384, 81 frames it costs about a twentieth.
    Layout and weight files are TAEHV's (madebyollin/taehv, `taew2_1`): frames pass convolutions
    one by one; a memory block also sees the frame before, at its own depth.
    """

    includes_start = True
    latent_channels, frames_per_latent, pixels_per_latent = _CHANNELS, 4, 8

    def __init__(self) -> None:
        super().__init__()
        encoder: list[nn.Module] = [_conv(3, _WIDTH), nn.ReLU()]
        for merged in (2, 2, 1):
            encoder += [_MergeFrames(_WIDTH, merged), _conv(_WIDTH, _WIDTH, stride=2, bias=False)]
            encoder += [_MemoryBlock(_WIDTH) for _ in range(3)]
        self.encoder = nn.ModuleList([*encoder, _conv(_WIDTH, _CHANNELS)])
        decoder: list[nn.Module] = [_Bound(), _conv(_CHANNELS, _WIDTHS[0]), nn.ReLU()]
        for level, grown in enumerate((1, 2, 2)):
            width = _WIDTHS[level]
            decoder += [_MemoryBlock(width) for _ in range(3)]
            decoder += [nn.Upsample(scale_factor=2), _GrowFrames(width, grown)]
            decoder += [_conv(width, _WIDTHS[level + 1], bias=False)]
        self.decoder = nn.ModuleList([*decoder, nn.ReLU(), _conv(_WIDTHS[-1], 3)])

    @classmethod
    def load(cls, file: Path) -> TinyAutoencoder:
        """Read `taew2_1` weights, in safetensors.

        Raises:
            CheckpointError: not readable, a pickle, or of another architecture.
        """
        with torch.device('meta'):
            made = cls()
        expected = made.state_dict()
        tensors = read_tensors(file)
        for name in expected.keys() ^ tensors.keys():
            what = 'lacks' if name in expected else 'has an unknown tensor'
            raise CheckpointError(f"'{file}' {what} '{name}'; expected taew2_1 of TAEHV")
        for name, value in tensors.items():
            tensors[name] = _fitting(file, name, value, expected[name].shape)
        made.load_state_dict(tensors, assign=True)
        return made.eval()

    @property
    def dtype(self) -> torch.dtype:
        """Data type of the weights."""
        return next(self.parameters()).dtype

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return next(self.parameters()).device

    def num_latent_frames(self, num_frames: int) -> int:
        """Return the number of latent frames of a chunk of T frames: the start's and T / 4."""
        return 1 + num_frames // self.frames_per_latent

    def encode(self, video: Tensor) -> Tensor:
        """Return (B, C, F, h, w) latents of a (B, 3, N, H, W) video."""
        frames = video.add(1).div(2).transpose(1, 2)
        missing = -frames.shape[1] % self.frames_per_latent
        frames = torch.cat([frames, frames[:, -1:].expand(-1, missing, -1, -1, -1)], dim=1)
        return _run(self.encoder, frames, _TOGETHER * self.frames_per_latent).transpose(1, 2)

    def decode(self, latents: Tensor) -> Tensor:
        """Return the (B, 3, N, H, W) video of (B, C, F, h, w) latents."""
        frames = _run(self.decoder, latents.transpose(1, 2), _TOGETHER)
        # the first latent frame stands for one frame: the last of the four it grew to
        frames = frames[:, self.frames_per_latent - 1 :]
        return frames.clamp(0, 1).mul(2).sub(1).transpose(1, 2)


def _run(layers: nn.ModuleList, frames: Tensor, together: int) -> Tensor:
    """Run frames (B, T, C, H, W) through layers, a few frames at a time to save memory."""
    memory: dict[int, Tensor] = {}
    parts = [_run_part(layers, part, memory) for part in frames.split(together, dim=1)]
    return torch.cat(parts, dim=1)


def _run_part(layers: nn.ModuleList, frames: Tensor, memory: dict[int, Tensor]) -> Tensor:
    """Run a part of the frames; `memory` holds the last input of each memory block."""
    batch = len(frames)
    x = frames.flatten(0, 1)
    for index, layer in enumerate(layers):
        if not isinstance(layer, _MemoryBlock):
            x = layer(x)
            continue
        seen = x.unflatten(0, (batch, -1))
        last = memory.get(index, torch.zeros_like(seen[:, :1]))
        memory[index] = seen[:, -1:]
        before = torch.cat([last, seen[:, :-1]], dim=1)
        x = layer(x, before.flatten(0, 1))
    return x.unflatten(0, (batch, -1))


def _fitting(file: Path, name: str, value: Tensor, shape: torch.Size) -> Tensor:
    """Return the weight; if the stored layer upsamples time by more, its last frames' part."""
    surplus = '.conv.weight' in name and value.shape[0] % shape[0] == 0
    if surplus and value.shape[1:] == shape[1:]:
        return value[-shape[0] :]
    if value.shape != shape:
        raise CheckpointError(
            f"'{file}': '{name}' has shape {list(value.shape)}, expected {list(shape)} "
            '(taew2_1 of TAEHV)'
        )
    return value


class WanAutoencoder(nn.Module):
    """Autoencoder of RGB video in [-1, 1]: normalised latents, 8x in space, 4x in time.

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
        """Return the number of latent frames of a chunk of T frames: the start's and T / 4."""
        return 1 + num_frames // self.frames_per_latent

    @property
    def dtype(self) -> torch.dtype:
        """Data type of the weights."""
        return self.vae.dtype

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return self.vae.device

    @property
    def config(self) -> Any:
        """The arguments that it was built with."""
        return self.vae.config

    def encode(self, video: Tensor) -> Tensor:
        """Return (B, C, F, h, w) latents, zero mean and unit scale, of a (B, 3, N, H, W) video.

        The most likely latents, not a sample: the same video gives the same latents.
        """
        latents = self.vae.encode(video, return_dict=False)[0].mode()
        mean, std = self._statistics(latents)
        return (latents - mean) / std

    def decode(self, latents: Tensor) -> Tensor:
        """Return the (B, 3, N, H, W) video of (B, C, F, h, w) latents."""
        mean, std = self._statistics(latents)
        return self.vae.decode(latents * std + mean, return_dict=False)[0]  # type: ignore[index]

    def save_pretrained(self, folder: Path, **options: Any) -> None:
        """Write it as diffusers' own class."""
        self.vae.save_pretrained(folder, **options)

    def _statistics(self, like: Tensor) -> tuple[Tensor, Tensor]:
        shape = (1, -1, 1, 1, 1)
        mean, std = (
            torch.tensor(self.vae.config[name], device=like.device, dtype=like.dtype)
            for name in ('latents_mean', 'latents_std')
        )
        return mean.reshape(shape), std.reshape(shape)


class SpaceToDepthAutoencoder(ModelMixin, ConfigMixin):
    """Lossless mapping of RGB video in [-1, 1] to latents of `3 * block_size**2` channels.

    With a model of the size of `small`, a learned autoencoder costs more than it gains (measured,
    see `experiments/results/`). The interface is the used part of a diffusers autoencoder.

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
        """Return the number of latent frames of a chunk of T frames: the start's and T / 4."""
        return num_frames

    def encode(self, video: Tensor) -> Tensor:
        """Return (B, C, F, h, w) latents of a (B, 3, F, H, W) video."""
        frames = video.transpose(1, 2).flatten(0, 1)
        latents = F.pixel_unshuffle(frames, self.block_size) * self.scale
        return latents.unflatten(0, (video.shape[0], -1)).transpose(1, 2)

    def decode(self, latents: Tensor) -> Tensor:
        """Return the (B, 3, F, H, W) video of (B, C, F, h, w) latents."""
        frames = latents.transpose(1, 2).flatten(0, 1)
        video = F.pixel_shuffle(frames / self.scale, self.block_size)
        return video.unflatten(0, (latents.shape[0], -1)).transpose(1, 2)
