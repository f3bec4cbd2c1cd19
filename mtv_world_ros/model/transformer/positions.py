"""Rotary position embedding of several views in one token sequence."""

from __future__ import annotations

from collections.abc import Sequence

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

    def forward(
        self, hidden_states: Tensor, times: Sequence[int] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Returns cosines and sines, each (1, V*F*h*w, 1, head_dim).

        Args:
            hidden_states: a (B, V, F, h, w, D) token grid; only its shape is read.
            times: F increasing times of the grid's frames; those before the rollout's video are
                negative. Default: 0 .. F-1.
        """
        _, num_views, num_frames, height, width, _ = hidden_states.shape
        places = self._times(num_views, tuple(times or range(num_frames)))
        self._check_size(num_views, places, height, width)
        cos, sin = self.get_buffer('freqs_cos'), self.get_buffer('freqs_sin')
        # cosines are even, sines odd: a turn by -t undoes one by t
        return (
            self._table(cos, _rows(cos[:, : self.t_dim], places, 1), height, width),
            self._table(sin, _rows(sin[:, : self.t_dim], places, -1), height, width),
        )

    def _times(self, num_views: int, times: tuple[int, ...]) -> list[list[int]]:
        """V rows of F times: the views' own; those of the video are the same whatever is before.

        With an offset in time the views' videos follow one another, and what is before the video
        stands before all of them.
        """
        if self.view_offset != 'time':
            return [list(times) for _ in range(num_views)]
        after, before = max(times) + 1, max(0, -min(times))
        return [
            [t + v * after if t >= 0 else t - (num_views - 1 - v) * before for t in times]
            for v in range(num_views)
        ]

    def _check_size(self, v: int, times: list[list[int]], h: int, w: int) -> None:
        f = 1 + max(abs(t) for row in times for t in row)
        largest = max(f, v * w if self.view_offset == 'width' else w, h)
        if largest > self.max_seq_len:
            raise CheckpointError(
                f'{v} views of {len(times[0])} x {h} x {w} tokens reach position {largest}, the '
                f'model has {self.max_seq_len}; use fewer or smaller frames, or raise '
                'transformer.rope_max_seq_len'
            )

    def _table(self, freqs: Tensor, frames: Tensor, h: int, w: int) -> Tensor:
        """The angles of a (V, F, h, w) grid; frames (V, F, t_dim) are those of time."""
        v, f, _ = frames.shape
        _, row, column = freqs.split([self.t_dim, self.h_dim, self.w_dim], dim=1)
        if self.view_offset == 'width':
            columns = column[: v * w].view(v, 1, 1, w, -1)
        else:
            columns = column[:w].view(1, 1, 1, w, -1)
        table = [
            frames.view(v, f, 1, 1, -1).expand(v, f, h, w, -1),
            row[:h].view(1, 1, h, 1, -1).expand(v, f, h, w, -1),
            columns.expand(v, f, h, w, -1),
        ]
        return torch.cat(table, dim=-1).reshape(1, v * f * h * w, 1, -1)


def _rows(table: Tensor, places: list[list[int]], sign: int) -> Tensor:
    """(V, F, D) rows of a table (N, D); those of negative places times the sign.

    Cut out, not indexed with a tensor: that would have to be copied to the device first.
    """
    return torch.stack(
        [torch.stack([table[t] if t >= 0 else sign * table[-t] for t in row]) for row in places]
    )
