"""Inputs `context` and `frame` of a control, as tokens of the blocks' cross-attention.

Shape letters: B batch, V views, T frames of a chunk, N shared context tokens, L tokens of a
control, D width of the transformer, S = 1 + f time slots (the reference image and f token frames),
G video frames of one token frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from torch import nn, Tensor
import torch.nn.functional as F

from mtv_world_ros.core.errors import CheckpointError

#: index of tokens that fill up the rows of a batch
PADDING = -1
#: initial scale of vectors that are added to the text (World-Eval)
ADDED_SCALE = 0.1
#: standard deviation of new token embeddings, about that of embedded text
TOKEN_STD = 0.5
#: standard deviation of the codes of a frame's place in its token frame
PLACE_STD = 0.02
#: largest period of the position codes of context tokens
LONGEST_PERIOD = 10_000.0


class Context(NamedTuple):
    """Tokens that a block's cross-attention sees.

    Attributes:
        num_views: number of views V, which gives the time slots in the token sequence.
        shared: (B, N, D) tokens that all video tokens see; None = none.
        mask: (B, N) bool, False = padding of the shared tokens; None = no padding.
        by_slot: (B, S, G, D) tokens that are seen by one time slot alone; None = none.
        image: (B, M, D) tokens of the added image attention; None = none.
    """

    num_views: int
    shared: Tensor | None = None
    mask: Tensor | None = None
    by_slot: Tensor | None = None
    image: Tensor | None = None

    def with_history(self, num_history: int) -> Context:
        """Return the context for a grid with history frames, which get the reference's context."""
        if self.by_slot is None or not num_history:
            return self
        first = self.by_slot[:, :1].expand(-1, num_history, -1, -1)
        return self._replace(by_slot=torch.cat([first, self.by_slot], dim=1))


class ContextAttnProcessor:
    """Wan's cross-attention for a `Context`: any number of tokens, padding, tokens of a slot."""

    def __call__(
        self,
        attn: Any,
        hidden_states: Tensor,
        encoder_hidden_states: Context,
        attention_mask: None = None,
        rotary_emb: None = None,
    ) -> Tensor:
        """Return (B, V * S * n, D) of a token sequence of that shape."""
        del attention_mask, rotary_emb
        context = encoder_hidden_states
        query = attn.norm_q(attn.to_q(hidden_states))
        if context.by_slot is None:
            assert context.shared is not None
            mask = None if context.mask is None else context.mask[:, None, None]
            out = _attend(attn.heads, query, *_keys_values(attn, context.shared), mask)
        else:
            out = _attend_slots(attn, query, context, context.by_slot)
        if context.image is not None:
            key = attn.norm_added_k(attn.add_k_proj(context.image))
            out = out + _attend(attn.heads, query, key, attn.add_v_proj(context.image))
        return attn.to_out[1](attn.to_out[0](out))


def _attend_slots(attn: Any, query: Tensor, context: Context, by_slot: Tensor) -> Tensor:
    """Attention of each time slot to its own tokens and the shared ones, (B, V * S * n, D)."""
    batch, slots, count = by_slot.shape[:3]
    # time slots become part of the batch, so that none sees the tokens of another
    grid = query.unflatten(1, (context.num_views, slots, -1)).transpose(1, 2)
    key, value = _keys_values(attn, by_slot.flatten(0, 1))
    mask = None
    if context.shared is not None:
        shared = _keys_values(attn, context.shared)
        key, value = (
            torch.cat([own, all_see.repeat_interleave(slots, 0)], dim=1)
            for own, all_see in zip((key, value), shared, strict=True)
        )
        if context.mask is not None:
            own = context.mask.new_ones(batch, count)
            mask = torch.cat([own, context.mask], dim=1).repeat_interleave(slots, 0)[:, None, None]
    out = _attend(attn.heads, grid.flatten(2, 3).flatten(0, 1), key, value, mask)
    out = out.unflatten(0, (batch, slots)).unflatten(2, (context.num_views, -1))
    return out.transpose(1, 2).flatten(1, 3)


def _keys_values(attn: Any, tokens: Tensor) -> tuple[Tensor, Tensor]:
    return attn.norm_k(attn.to_k(tokens)), attn.to_v(tokens)


def _attend(
    heads: int, query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None = None
) -> Tensor:
    parts = [x.unflatten(2, (heads, -1)).transpose(1, 2) for x in (query, key, value)]
    out = F.scaled_dot_product_attention(*parts, attn_mask=mask)
    return out.transpose(1, 2).flatten(2).type_as(query)


class ControlTokens(nn.Module):
    """Embeddings of a control's inputs, and the tokens that stand for text in models without.

    Args:
        context: fields of `control.ContextInput`; None = no such input.
        frame: fields of `control.FrameInput`; None = no such input.
        dim: width D of a token.
        frames_per_token: number G of frames that a token stands for.
        num_prompt_tokens: learned tokens in place of the text; 0 = the model has text.
    """

    def __init__(
        self,
        *,
        context: Mapping[str, Any] | None,
        frame: Mapping[str, Any] | None,
        dim: int,
        frames_per_token: int,
        num_prompt_tokens: int,
    ) -> None:
        super().__init__()
        self.context = None if context is None else _ContextEmbedding(dim, **context)
        self.frame = None if frame is None else _FrameEmbedding(dim, frames_per_token, **frame)
        self.prompt = None
        if num_prompt_tokens and context is not None:
            self.prompt = nn.Parameter(TOKEN_STD * torch.randn(num_prompt_tokens, dim))

    def forward(
        self,
        context: Tensor | None,
        frame: Tensor | None,
        kept: Tensor | None,
        text: Tensor | None,
        image: Tensor | None,
        num_slots: int,
        num_views: int,
    ) -> Context:
        """Return the context of the blocks' cross-attention.

        Args:
            context: (B, L) indices, `PADDING` = none, or (B, L, size) vectors, NaN = none.
            frame: (B, 1 + T, size) vectors, row 0 the start.
            kept: (B,) bool, False = the sample goes without its control; None = all have it.
            text: (B, N, D) embedded text; None in models without.
            image: (B, M, D) embedded images; None = none.
            num_slots: number of slots, S.
            num_views: number of views, V.

        Raises:
            CheckpointError: an input is missing, or does not divide into time slots.
        """
        for name, embedding, given in (
            ('context', self.context, context),
            ('frame', self.frame, frame),
        ):
            if (embedding is None) != (given is None):
                said = 'needs' if given is None else 'does not take'
                raise CheckpointError(
                    f"the model {said} the control's input '{name}'; serve it with the control "
                    'that its card names'
                )
        shared, mask, by_slot = text, None, None
        if self.context is not None and context is not None:
            if self.prompt is not None:
                shared = self.prompt.expand(len(context), -1, -1)
            assert shared is not None
            shared, mask = self.context(context, shared, kept)
        if self.frame is not None and frame is not None:
            by_slot = self.frame(frame, num_slots, kept)
            if self.context is None and text is not None:
                # as in Ctrl-World: a frame sees its own vectors alone, which carry the text
                by_slot, shared = by_slot + text.mean(1)[:, None, None], None
        return Context(num_views=num_views, shared=shared, mask=mask, by_slot=by_slot, image=image)


class _ContextEmbedding(nn.Module):
    """Indices or vectors as tokens behind the text, or as one vector added to it."""

    def __init__(
        self,
        dim: int,
        vector_size: int = 0,
        vocabulary: int = 0,
        joins: str = 'append',
        hidden_size: int = 0,
    ) -> None:
        super().__init__()
        self.is_added = joins == 'add'
        self.net: nn.Module
        if vocabulary:
            self.net = nn.Embedding(vocabulary, dim)
            nn.init.normal_(self.net.weight, std=TOKEN_STD)  # type: ignore[arg-type]
        elif hidden_size:
            self.net = _three_layers(vector_size, hidden_size, dim, nn.GELU)
        else:
            self.net = nn.Sequential(nn.Linear(vector_size, dim), nn.GELU(), nn.Linear(dim, dim))
        self.scale = nn.Parameter(torch.tensor(ADDED_SCALE)) if self.is_added else None

    def forward(
        self, given: Tensor, text: Tensor, kept: Tensor | None
    ) -> tuple[Tensor, Tensor | None]:
        """Return the tokens (B, N', D) of text (B, N, D) and control, and their mask (B, N')."""
        counts = given >= 0 if given.ndim == 2 else given.isfinite().all(-1)
        if given.ndim == 2:
            embedded = self.net(given.clamp_min(0))
        else:
            dtype = next(self.net.parameters()).dtype
            embedded = self.net(torch.nan_to_num(given).to(dtype))
        if kept is not None:
            counts = counts & kept[:, None]
        if self.scale is not None:
            share = counts / counts.sum(1, keepdim=True).clamp_min(1)
            mean = (embedded * share.to(embedded.dtype)[..., None]).sum(1, keepdim=True)
            return text + self.scale * mean, None
        embedded = embedded + _place_codes(given.shape[1], embedded)
        whole = torch.ones(text.shape[:2], dtype=torch.bool, device=text.device)
        tokens = torch.cat([text, embedded.to(text.dtype)], dim=1)
        return tokens, torch.cat([whole, counts], dim=1)


def _three_layers(
    vector_size: int, hidden_size: int, dim: int, activation: Callable[[], nn.Module]
) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(vector_size, hidden_size),
        activation(),
        nn.Linear(hidden_size, hidden_size),
        activation(),
        nn.Linear(hidden_size, dim),
    )


def _place_codes(length: int, like: Tensor) -> Tensor:
    """Return (length, D) sines and cosines of the places, as in "Attention is all you need"."""
    half = like.shape[-1] // 2
    rates = LONGEST_PERIOD ** -(torch.arange(half, device=like.device) / half)
    angles = torch.arange(length, device=like.device)[:, None] * rates
    return torch.cat([angles.sin(), angles.cos()], dim=1).to(like.dtype)


class _FrameEmbedding(nn.Module):
    """A token a frame, by an MLP of three layers (Ctrl-World)."""

    def __init__(
        self, dim: int, frames_per_token: int, vector_size: int, hidden_size: int
    ) -> None:
        super().__init__()
        self.net = _three_layers(vector_size, hidden_size, dim, nn.SiLU)
        hidden = [layer for layer in self.net if isinstance(layer, nn.Linear)][:-1]
        for layer in hidden:  # as in Ctrl-World (`Action_encoder2`)
            nn.init.kaiming_normal_(layer.weight, mode='fan_in', nonlinearity='relu')
        # which of its slot's frames a vector belongs to: attention knows no order
        self.place = nn.Parameter(PLACE_STD * torch.randn(frames_per_token, dim))

    def forward(self, frame: Tensor, num_slots: int, kept: Tensor | None) -> Tensor:
        """Return (B, S, G, D) of vectors (B, 1 + T, size)."""
        dtype = self.place.dtype
        slots = by_slot(frame.to(dtype), num_slots, len(self.place))
        tokens = self.net(slots) + self.place
        return tokens if kept is None else tokens * kept.to(dtype).reshape(-1, 1, 1, 1)


def by_slot(vectors: Tensor, num_slots: int, group: int) -> Tensor:
    """Return (B, S, G, size): the vectors (B, 1 + T, size) of each time slot.

    The first vector is repeated G - 1 more times, then G neighbours form a group: (T + G) / G
    groups, the first one for the start. Where the video itself begins with the start frame, the
    reference slot before it shares that group.

    Raises:
        CheckpointError: the number of frames does not fit the number of slots.
    """
    padded = torch.cat([vectors[:, :1].expand(-1, group - 1, -1), vectors], dim=1)
    if padded.shape[1] % group == 0:
        groups = padded.unflatten(1, (-1, group))
        if groups.shape[1] == num_slots:
            return groups
        if groups.shape[1] == num_slots - 1:
            return torch.cat([groups[:, :1], groups], dim=1)
    raise CheckpointError(
        f'{vectors.shape[1] - 1} vectors do not divide into {num_slots - 1} token frames of '
        f'{group} frames each; set transformer.frames_per_token to video frames per token'
    )
