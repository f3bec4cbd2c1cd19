"""Rotary position embedding of several views in one token sequence."""

from __future__ import annotations

from diffusers.models.transformers.transformer_wan import WanRotaryPosEmbed
import torch
from torch import Tensor

from mtv_world_ros.errors import CheckpointError


class MultiViewRotaryPosEmbed(WanRotaryPosEmbed):
    """Wan's rotary embedding with the views placed side by side in width.

    Args:
        attention_head_dim: channels of one head.
        patch_size: (time, height, width) of a token; kept for the base class.
        max_seq_len: largest position along any axis, view offset included.
        view_offset: `width` puts view v at columns v*w .. (v+1)*w; `time` at frames v*f ..
            (v+1)*f; `none` gives all views the same positions (the view embedding alone tells them
            apart).

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
        if view_offset not in ('width', 'time', 'none'):
            raise CheckpointError(
                f"transformer.view_offset '{view_offset}' is not one of width, time, none"
            )
        self.view_offset = view_offset

    def forward(self, hidden_states: Tensor) -> tuple[Tensor, Tensor]:
        """Returns cosines and sines, each (1, V*F*h*w, 1, head_dim).

        Args:
            hidden_states: a (B, V, F, h, w, D) token grid; only its shape is read.
        """
        _, num_views, num_frames, height, width, _ = hidden_states.shape
        self._check_size(num_views, num_frames, height, width)
        return (
            self._table(self.get_buffer('freqs_cos'), num_views, num_frames, height, width),
            self._table(self.get_buffer('freqs_sin'), num_views, num_frames, height, width),
        )

    def _check_size(self, v: int, f: int, h: int, w: int) -> None:
        along = {'width': (f, v * w), 'time': (v * f, w), 'none': (f, w)}[self.view_offset]
        largest = max(*along, h)
        if largest > self.max_seq_len:
            raise CheckpointError(
                f'{v} views of {f} x {h} x {w} tokens reach position {largest}, the model has '
                f'{self.max_seq_len}; use fewer or smaller frames, or raise '
                'transformer.rope_max_seq_len'
            )

    def _table(self, freqs: Tensor, v: int, f: int, h: int, w: int) -> Tensor:
        time, row, column = freqs.split([self.t_dim, self.h_dim, self.w_dim], dim=1)
        if self.view_offset == 'width':
            columns = column[: v * w].view(v, 1, 1, w, -1)
        else:
            columns = column[:w].view(1, 1, 1, w, -1)
        if self.view_offset == 'time':
            frames = time[: v * f].view(v, f, 1, 1, -1)
        else:
            frames = time[:f].view(1, f, 1, 1, -1)
        table = [
            frames.expand(v, f, h, w, -1),
            row[:h].view(1, 1, h, 1, -1).expand(v, f, h, w, -1),
            columns.expand(v, f, h, w, -1),
        ]
        return torch.cat(table, dim=-1).reshape(1, v * f * h * w, 1, -1)
