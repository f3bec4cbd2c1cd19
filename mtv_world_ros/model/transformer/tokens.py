"""Latents to tokens and back; their order in the sequence and their positions.

Shape letters: B batch, V views, C latent channels, F latent frames, P of the history, H W latent
size, D width of the transformer. p token frames of the history, f of the video, h w = token grid;
a grid has F = p + 1 + f token frames and S = V * F * h * w tokens.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from diffusers.models.transformers.transformer_wan import WanRotaryPosEmbed
import torch
from torch import Tensor

from mtv_world_ros.core.errors import CheckpointError

#: inputs of the start image: both the reference tokens and its channel slot, or either
START_IMAGES = ('both', 'either')


def embed_video(transformer: Any, x: Tensor, temb: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Embed x (B, V, C_in, F, H, W) as tokens (B, V, f, h, w, D); also return the skips.

    Args:
        transformer: transformer whose `patch_embedding` is used.
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
    """Return tokens (B, V, p, h, w, D) of the history, as of a video's later frames.

    Its control is zero: the commands that led through it are done with.

    Args:
        transformer: transformer whose `patch_embedding` is used.
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
    """Return tokens (B, V, 1, h, w, D) of the anchor or start image; keys for copying the latter.

    The convolutional stem sees the start image with its control frame; for an anchor from long
    ago there is none.

    Args:
        transformer: transformer whose `ref_conv` (phi of the paper) is used.
        reference: (B, V, C, H, W) latents of the start image.
        start_control: latents of the control frame 0.
        anchor: (B, V, C, H, W) latents of the rollout's first frame; None = the start image is the
            reference.
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
    """Return the tokens and keys that phi gives for (B, V, C, H, W) latents."""
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
    control: Tensor,
) -> Tensor:
    """Project tokens (B, V, f, h, w, D) to the output latents (B, V, C, F, H, W).

    Args:
        transformer: transformer whose `proj_out` is used.
        kept: the video's tokens.
        skips: skips of `embed_video`.
        temb: (B, D) embedding of the video's noise level.
        keys: keys of `embed_reference`.
        reference: (B, V, C, H, W) latents of the start image.
        control: (B, V, C, F, H, W) latents of the trajectory video.
    """
    batch, views, _, num_frames, height, width = control.shape
    if transformer.stem == 'conv':
        drawn = control.transpose(2, 3).flatten(0, 2)
        frames = transformer.proj_out(kept, skips, temb, keys, reference.flatten(0, 1), drawn)
        return frames.unflatten(0, (batch, views, num_frames)).transpose(2, 3)
    p_t, p_h, p_w = transformer.patch_size
    out = transformer.proj_out(kept)
    out = out.unflatten(-1, (p_t, p_h, p_w, -1)).permute(0, 1, 8, 2, 5, 3, 6, 4, 7)
    return out.reshape(batch, views, -1, num_frames, height, width)


class MultiViewRotaryPosEmbed(WanRotaryPosEmbed):
    """Wan's rotary embedding with the views placed side by side in width.

    Args:
        attention_head_dim: channels of one head.
        patch_size: size (time, height, width) of a token; kept for the base class.
        max_seq_len: largest position along any axis, view offset included.
        view_offset: `width` puts view v at columns v*w .. (v+1)*w; `none` gives all views the same
            positions (the view embedding alone tells them apart).

    Raises:
        CheckpointError: another `view_offset`; or, called, a grid beyond `max_seq_len`.
    """

    def __init__(
        self,
        attention_head_dim: int,
        patch_size: tuple[int, ...],
        max_seq_len: int,
        view_offset: str = 'width',
    ) -> None:
        super().__init__(attention_head_dim, patch_size, max_seq_len)  # type: ignore[arg-type]
        if view_offset not in ('width', 'none'):
            raise CheckpointError(
                f"transformer.view_offset '{view_offset}' is not one of width, none"
            )
        self.view_offset = view_offset

    def forward(
        self, hidden_states: Tensor, times: Sequence[int] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return cosines and sines, each (1, V*F*h*w, 1, head_dim).

        Args:
            hidden_states: a (B, V, F, h, w, D) token grid; only its shape is read.
            times: F increasing times of the grid's frames; those before the rollout's video are
                negative. Default: 0 .. F-1.
        """
        _, num_views, num_frames, height, width, _ = hidden_states.shape
        places = times or range(num_frames)
        self._check_size(num_views, places, height, width)
        cos, sin = self.get_buffer('freqs_cos'), self.get_buffer('freqs_sin')
        # cosines are even, sines odd: a turn by -t undoes one by t
        return (
            self._table(cos, _rows(cos[:, : self.t_dim], places, 1), num_views, height, width),
            self._table(sin, _rows(sin[:, : self.t_dim], places, -1), num_views, height, width),
        )

    def _check_size(self, v: int, times: Sequence[int], h: int, w: int) -> None:
        f = 1 + max(abs(t) for t in times)
        largest = max(f, v * w if self.view_offset == 'width' else w, h)
        if largest > self.max_seq_len:
            raise CheckpointError(
                f'{v} views of {len(times)} x {h} x {w} tokens reach position {largest}, the '
                f'model has {self.max_seq_len}; use fewer or smaller frames, or raise '
                'transformer.rope_max_seq_len'
            )

    def _table(self, freqs: Tensor, frames: Tensor, v: int, h: int, w: int) -> Tensor:
        """Return the angles of a (V, F, h, w) grid; frames (F, t_dim) are those of time."""
        f = len(frames)
        _, row, column = freqs.split([self.t_dim, self.h_dim, self.w_dim], dim=1)
        if self.view_offset == 'width':
            columns = column[: v * w].view(v, 1, 1, w, -1)
        else:
            columns = column[:w].view(1, 1, 1, w, -1)
        table = [
            frames.view(1, f, 1, 1, -1).expand(v, f, h, w, -1),
            row[:h].view(1, 1, h, 1, -1).expand(v, f, h, w, -1),
            columns.expand(v, f, h, w, -1),
        ]
        return torch.cat(table, dim=-1).reshape(1, v * f * h * w, 1, -1)


def _rows(table: Tensor, places: Sequence[int], sign: int) -> Tensor:
    """Return (F, D) rows of a table (N, D); those of negative places times the sign.

    Cut out, not indexed with a tensor: that would have to be copied to the device first.
    """
    return torch.stack([table[t] if t >= 0 else sign * table[-t] for t in places])


class TokenGrid(NamedTuple):
    """The token frames of all views.

    Attributes:
        tokens: (B, V, F, h, w, D) tokens.
        times: F times for the rotary embedding. The video stands at 1 .. f and the reference image
            at 0, as Wan2.1-Fun-Control was trained, whatever is before them; the history stands
            at -p .. -1.
        num_history: p. These and the reference image are dropped from the output.
    """

    tokens: Tensor
    times: tuple[int, ...]
    num_history: int


def check_start_image(name: str) -> str:
    """Return the name, or raise CheckpointError if it is none of `START_IMAGES`."""
    if name not in START_IMAGES:
        raise CheckpointError(
            f"transformer.start_image '{name}' is not one of {', '.join(START_IMAGES)}"
        )
    return name


def arrange(video: Tensor, reference: Tensor, history: Tensor | None) -> TokenGrid:
    """Return the grid of (B, V, f | 1 | p, h, w, D) tokens."""
    num_history = 0 if history is None else history.shape[2]
    parts = [part for part in (history, reference, video) if part is not None]
    return TokenGrid(
        tokens=torch.cat(parts, dim=2),
        times=tuple(range(-num_history, 1 + video.shape[2])),
        num_history=num_history,
    )


def by_run(time_proj: Tensor, grid: TokenGrid) -> Tensor:
    """Return the blocks' modulation (B, R, 6, D) of R runs of tokens.

    There is one run, or V * F frames if noise levels differ. The reference shares the video's
    level, as in Wan.

    Args:
        time_proj: (B, 1, 6, D), or (B, 2, 6, D) of the video's and the history's noise level.
        grid: view, time, row and column of each token.
    """
    if not grid.num_history:
        return time_proj
    views, frames = grid.tokens.shape[1:3]
    parts = [
        time_proj[:, 1:].expand(-1, grid.num_history, -1, -1),
        time_proj[:, :1].expand(-1, frames - grid.num_history, -1, -1),
    ]
    return torch.cat(parts, dim=1).repeat(1, views, 1, 1)
