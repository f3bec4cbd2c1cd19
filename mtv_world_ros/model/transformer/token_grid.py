"""Token frames in the order of the sequence: history, reference image, video.

Shape letters: B batch, V views, p token frames of the history, f of the video, h w = token grid,
F = p + 1 + f, S = V * F * h * w tokens, D width.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from mtv_world_ros.errors import CheckpointError
from mtv_world_ros.model.transformer.context import Context

#: where the start image may enter: as reference tokens, in its channel slot, or both
START_IMAGES = ('both', 'reference', 'channel')


class TokenGrid(NamedTuple):
    """The token frames of all views.

    Attributes:
        tokens: (B, V, F, h, w, D).
        times: F times for the rotary embedding. The video stands at 1 .. f and the reference image
            at 0, as Wan2.1-Fun-Control was trained, whatever is before them; the history stands
            at -p .. -1.
        num_history: p.
        num_before: token frames before the video, which are dropped from the output.
    """

    tokens: Tensor
    times: tuple[int, ...]
    num_history: int
    num_before: int


def check_start_image(name: str) -> str:
    """Returns the name, or raises CheckpointError if it is none of `START_IMAGES`."""
    if name not in START_IMAGES:
        raise CheckpointError(
            f"transformer.start_image '{name}' is not one of {', '.join(START_IMAGES)}"
        )
    return name


def arrange(video: Tensor, reference: Tensor | None, history: Tensor | None) -> TokenGrid:
    """Returns the grid of (B, V, f | 1 | p, h, w, D) tokens, as far as there are any."""
    num_history = 0 if history is None else history.shape[2]
    parts = [part for part in (history, reference, video) if part is not None]
    first = 1 if reference is None else 0
    return TokenGrid(
        tokens=torch.cat(parts, dim=2),
        times=(*range(-num_history, 0), *range(first, 1 + video.shape[2])),
        num_history=num_history,
        num_before=num_history + 1 - first,
    )


def by_token(time_proj: Tensor, grid: TokenGrid) -> Tensor:
    """Returns the blocks' modulation: one for all tokens, or where levels differ one for each.

    Args:
        time_proj: (B, 1, 6, D), or (B, 2, 6, D) of the video's and the history's noise level.
        grid: which token is which.

    Returns:
        (B, 6, D), or (B, S, 6, D). The reference shares the video's level, as in Wan.
    """
    if not grid.num_history:
        return time_proj[:, 0]
    batch, views, frames, height, width, _ = grid.tokens.shape
    parts = [
        time_proj[:, 1:].expand(-1, grid.num_history, -1, -1),
        time_proj[:, :1].expand(-1, frames - grid.num_history, -1, -1),
    ]
    rows = torch.cat(parts, dim=1)[:, None, :, None]
    return rows.expand(batch, views, -1, height * width, -1, -1).flatten(1, 3)


def fit_context(context: Context, grid: TokenGrid) -> Context:
    """Returns a context of 1 + f time slots for the grid's token frames.

    The history sees what the reference image sees; in its own frames the commands are done with.
    """
    if context.tokens.ndim == 3:
        return context
    first = context.tokens[:, :1].expand(-1, grid.num_before, -1, -1)
    return context._replace(tokens=torch.cat([first, context.tokens[:, 1:]], dim=1))
