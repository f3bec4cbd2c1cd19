"""Convolutional stem and decoder of the small preset, in place of linear patch embeddings.

At small scale a convolutional stem learns several times faster than patches, and a decoder that
may hold or copy the reference image instead of redrawing it keeps objects sharp.

Shape letters: N = B*V*F frames, R = B*V reference images, h w = latent size, h2 w2 = half,
h4 w4 = a quarter of it, D = width of the transformer, G = frames merged into one token.
"""

from __future__ import annotations

import torch
from torch import nn, Tensor
import torch.nn.functional as F

from mtv_world_ros.model.transformer.attention import attend

#: what every output pixel chooses from: hold the reference, two copies of it, or draw anew
NUM_SOURCES = 4
#: weight, before the softmax, of a source that a model learns to use later
_NEW_SOURCE_BIAS = -1.0
NUM_COPIES = 2


class ResBlock(nn.Module):
    """Two 3x3 convolutions around a skip, modulated by the time embedding."""

    def __init__(self, in_channels: int, channels: int, time_dim: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(8, in_channels)
        self.conv1 = nn.Conv2d(in_channels, channels, 3, padding=1)
        self.modulation = nn.Linear(time_dim, 2 * channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)
        same = in_channels == channels
        self.skip = nn.Identity() if same else nn.Conv2d(in_channels, channels, 1)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)
        nn.init.zeros_(self.conv2.weight)
        nn.init.zeros_(self.conv2.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor, temb: Tensor) -> Tensor:
        """Return (N, channels, h, w) for x (N, in_channels, h, w) and temb (B, D), B | N."""
        hidden = self.conv1(F.silu(_normed(self.norm, x)))
        scale, shift = self.modulation(temb).chunk(2, dim=1)
        repeats = x.shape[0] // temb.shape[0]
        scale = scale.repeat_interleave(repeats, 0)[:, :, None, None]
        shift = shift.repeat_interleave(repeats, 0)[:, :, None, None]
        hidden = self.conv2(F.silu(hidden * (1 + scale) + shift))
        return self.skip(x) + hidden


def _normed(norm: nn.GroupNorm, x: Tensor) -> Tensor:
    """Return x (N, C, h, w) normed; on a CPU the gradient of bfloat16 images takes float32.

    Torch's gradient of channels-last images is two to three times as fast in float32.
    """
    if x.device.type != 'cpu' or x.dtype != torch.bfloat16 or not torch.is_grad_enabled():
        return norm(x)
    weight, bias = norm.weight.float(), norm.bias.float()
    return F.group_norm(x.float(), norm.num_groups, weight, bias, norm.eps).type_as(x)


class ConvStem(nn.Module):
    """Frames to tokens: down to a quarter of the latent size, G frames merged into one."""

    def __init__(
        self, in_channels: int, widths: tuple[int, int, int], dim: int, merge: int
    ) -> None:
        super().__init__()
        c1, c2, c3 = widths
        self.merge = merge
        self.conv_in = nn.Conv2d(in_channels, c1, 3, padding=1)
        self.block1 = ResBlock(c1, c1, dim)
        self.down1 = nn.Conv2d(c1, c2, 3, stride=2, padding=1)
        self.block2 = ResBlock(c2, c2, dim)
        self.down2 = nn.Conv2d(c2, c3, 3, stride=2, padding=1)
        self.block3 = ResBlock(c3, c3, dim)
        self.to_tokens = nn.Linear(merge * c3, dim)

    def forward(self, x: Tensor, temb: Tensor, views: int) -> tuple[Tensor, list[Tensor]]:
        """Return tokens (B, V, F/G, h4, w4, D) and the features to skip with, fine to coarse.

        Args:
            x: (N, in_channels, h, w), frames in the order B, V, F.
            temb: (B, D) time embedding.
            views: number of views, V.
        """
        fine = self.block1(self.conv_in(x), temb)
        half = self.block2(self.down1(fine), temb)
        coarse = self.block3(self.down2(half), temb)
        _, c3, h4, w4 = coarse.shape
        grid = coarse.reshape(temb.shape[0], views, -1, self.merge, c3, h4, w4)
        tokens = self.to_tokens(grid.permute(0, 1, 2, 5, 6, 3, 4).flatten(5))
        return tokens, [fine, half, coarse]


class ReferenceStem(nn.Module):
    """Encoder of reference latents (phi of the paper) to tokens and to keys for copying."""

    def __init__(self, in_channels: int, widths: tuple[int, int, int], dim: int) -> None:
        super().__init__()
        c1, c2, _ = widths
        self.conv_in = nn.Conv2d(in_channels, c1, 3, padding=1)
        self.block1 = ResBlock(c1, c1, dim)
        self.down1 = nn.Conv2d(c1, c2, 3, stride=2, padding=1)
        self.block2 = ResBlock(c2, c2, dim)
        self.to_tokens = nn.Conv2d(c2, dim, 2, stride=2)

    def forward(self, x: Tensor, temb: Tensor) -> tuple[Tensor, Tensor]:
        """Return tokens (R, D, h4, w4) and keys (R, c2, h2, w2)."""
        x = self.block1(self.conv_in(x), temb)
        keys = self.block2(self.down1(x), temb)
        return self.to_tokens(keys), keys


class CopyAttention(nn.Module):
    """Attention that copies pixels of a view's reference image into each output patch."""

    def __init__(self, channels: int, reference_channels: int, head_dim: int = 32) -> None:
        super().__init__()
        self.head_dim = head_dim
        self.to_q = nn.Conv2d(channels, NUM_COPIES * head_dim, 1)
        self.to_k = nn.Conv2d(reference_channels, NUM_COPIES * head_dim, 1)
        self.place = nn.Linear(18, NUM_COPIES * head_dim)

    def forward(self, x: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        """Return (N, NUM_COPIES * P, h2, w2) copied patches.

        Args:
            x: (N, channels, h2, w2) decoder features.
            keys: (R, reference_channels, h2, w2) features of the reference images.
            values: (R, P, h2, w2) the reference images' pixels, one patch a position.
        """
        num_refs, _, h2, w2 = keys.shape
        frames = x.shape[0] // num_refs
        place = self.place(_fourier_places(h2, w2, x)).T.reshape(1, -1, h2, w2)
        q = (self.to_q(x) + place).unflatten(1, (NUM_COPIES, self.head_dim))
        k = (self.to_k(keys) + place).unflatten(1, (NUM_COPIES, self.head_dim)).flatten(3)
        q = q.reshape(num_refs, frames, NUM_COPIES, self.head_dim, h2 * w2)
        q = q.permute(0, 2, 1, 4, 3).flatten(2, 3)
        v = values.flatten(2).transpose(1, 2)[:, None].expand(-1, NUM_COPIES, -1, -1)
        copied = attend(q.to(v.dtype), k.transpose(2, 3).to(v.dtype), v)
        copied = copied.unflatten(2, (frames, h2 * w2)).permute(0, 2, 1, 4, 3)
        return copied.reshape(x.shape[0], -1, h2, w2)


def _fourier_places(h: int, w: int, like: Tensor) -> Tensor:
    """(h*w, 18) sines and cosines of four frequencies of each coordinate, and themselves."""
    y = torch.linspace(-1, 1, h, device=like.device, dtype=torch.float32)
    x = torch.linspace(-1, 1, w, device=like.device, dtype=torch.float32)
    place = torch.stack(torch.meshgrid(y, x, indexing='ij'), dim=-1).reshape(-1, 2)
    angles = torch.cat([place * f * torch.pi for f in (0.5, 1.0, 2.0, 4.0)], dim=1)
    return torch.cat([place, angles.sin(), angles.cos()], dim=1).to(like.dtype)


class ReferenceDecoder(nn.Module):
    """Tokens to frames: each pixel a mixture of the held, copied and drawn image."""

    def __init__(
        self,
        out_channels: int,
        widths: tuple[int, int, int],
        dim: int,
        merge: int,
        reference_channels: int,
        copies_control: bool = False,
    ) -> None:
        super().__init__()
        c1, c2, c3 = widths
        self.merge = merge
        self.num_sources = NUM_SOURCES + copies_control
        self.out_channels = out_channels
        self.from_tokens = nn.Linear(dim, merge * c3)
        self.block3 = ResBlock(2 * c3, c3, dim)
        self.up2 = nn.Conv2d(c3, c2, 3, padding=1)
        self.block2 = ResBlock(2 * c2, c2, dim)
        self.copy = CopyAttention(c2, reference_channels)
        self.up1 = nn.Conv2d(c2, c1, 3, padding=1)
        self.block1 = ResBlock(2 * c1, c1, dim)
        # 4 latent channels share one pixel position of a space-to-depth block of 2 x 2
        self.num_positions = out_channels // 3
        num_out = out_channels + self.num_sources * self.num_positions
        self.conv_out = nn.Conv2d(c1, num_out, 3, padding=1)
        nn.init.zeros_(self.conv_out.weight)
        with torch.no_grad():
            bias = self.conv_out.bias
            assert bias is not None
            bias.zero_()
            bias[out_channels : out_channels + self.num_positions] = 2.0
            bias[out_channels + NUM_SOURCES * self.num_positions :] = _NEW_SOURCE_BIAS

    def forward(
        self,
        tokens: Tensor,
        skips: list[Tensor],
        temb: Tensor,
        keys: Tensor,
        reference: Tensor,
        control: Tensor,
    ) -> Tensor:
        """Return (N, out_channels, h, w) clean latents.

        Args:
            tokens: (B, V, F/G, h4, w4, D) tokens.
            skips: features of the stem, fine to coarse.
            temb: (B, D) time embedding.
            keys: (R, reference_channels, h2, w2) features of the reference images.
            reference: (R, out_channels, h, w) reference latents.
            control: (N, out_channels, h, w) latents of the trajectory video.
        """
        fine, half, coarse = skips
        grid = self.from_tokens(tokens).unflatten(-1, (self.merge, -1))
        x = grid.permute(0, 1, 2, 5, 6, 3, 4).reshape(coarse.shape)
        x = x.contiguous(memory_format=torch.channels_last)
        x = self.block3(torch.cat([x, coarse], dim=1), temb)
        x = self.up2(F.interpolate(x, scale_factor=2.0, mode='nearest'))
        x = self.block2(torch.cat([x, half], dim=1), temb)
        copies = self.copy(x, keys, F.pixel_unshuffle(reference, 2))
        x = self.up1(F.interpolate(x, scale_factor=2.0, mode='nearest'))
        x = self.block1(torch.cat([x, fine], dim=1), temb)
        out = self.conv_out(F.silu(x)).float()
        return self._mix(out, copies.float(), reference, control)

    def _mix(self, out: Tensor, copies: Tensor, reference: Tensor, control: Tensor) -> Tensor:
        """Weigh the sources; channels of a latent are ordered colour-major (C, positions)."""
        c, p = self.out_channels, self.num_positions
        n, _, h, w = out.shape
        drawn, choice = out.split([c, out.shape[1] - c], dim=1)
        weights = choice.reshape(n, self.num_sources, 1, p, h, w).softmax(dim=1)
        copied = F.pixel_shuffle(copies.reshape(n * NUM_COPIES, -1, h // 2, w // 2), 2)
        copied = copied.reshape(n, NUM_COPIES, 3, p, h, w)
        held = reference.float().repeat_interleave(n // reference.shape[0], 0)
        parts = [
            held.reshape(n, 1, 3, p, h, w),
            copied,
            (held + drawn).reshape(n, 1, 3, p, h, w),
        ]
        if self.num_sources > NUM_SOURCES:
            parts.append(control.float().reshape(n, 1, 3, p, h, w))
        return (weights * torch.cat(parts, dim=1)).sum(dim=1).reshape(n, c, h, w)
