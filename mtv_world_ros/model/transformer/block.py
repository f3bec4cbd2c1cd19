"""Wan's transformer block for runs of tokens of one noise level, with few passes over memory.

Shape letters: B batch, S tokens, R runs of as many tokens each, D width, H heads, d of a head.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from diffusers.models.attention_dispatch import dispatch_attention_fn
from diffusers.models.transformers.transformer_wan import WanTransformerBlock
import torch
from torch import nn, Tensor
import torch.nn.functional as F

from mtv_world_ros.errors import CheckpointError


class Context(NamedTuple):
    """Context tokens of a block's cross-attention.

    Attributes:
        tokens: (B, N, D) for all tokens alike, or (B, S, G, D): each time slot has its own.
        num_views: V, to find the time slots in the token sequence.
        mask: (B, N) bool, False = padding; None = all count.
        image: (B, M, D) tokens that the added image attention looks at, or None.
    """

    tokens: Tensor
    num_views: int
    mask: Tensor | None = None
    image: Tensor | None = None


class ContextAttnProcessor:
    """Wan's cross-attention for a `Context`: any number of tokens, padding, slots of their own."""

    def __call__(
        self,
        attn: Any,
        hidden_states: Tensor,
        encoder_hidden_states: Context,
        attention_mask: None = None,
        rotary_emb: None = None,
    ) -> Tensor:
        """Returns (B, V * S * n, D) for a token sequence of that shape."""
        del attention_mask, rotary_emb
        context = encoder_hidden_states
        query = attn.norm_q(attn.to_q(hidden_states))
        out = _attend_context(attn, query, context)
        if context.image is not None:
            key = attn.norm_added_k(attn.add_k_proj(context.image))
            out = out + _attend(attn.heads, query, key, attn.add_v_proj(context.image))
        return attn.to_out[1](attn.to_out[0](out))


def _attend_context(attn: Any, query: Tensor, context: Context) -> Tensor:
    tokens = context.tokens
    if tokens.ndim == 3:
        mask = None if context.mask is None else context.mask[:, None, None]
        return _attend(attn.heads, query, *_keys_values(attn, tokens), mask)
    batch, slots = tokens.shape[:2]
    # time slots become part of the batch, so that none sees the actions of another
    grid = query.unflatten(1, (context.num_views, slots, -1)).transpose(1, 2)
    own = grid.flatten(2, 3).flatten(0, 1)
    out = _attend(attn.heads, own, *_keys_values(attn, tokens.flatten(0, 1)))
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


#: umT5 tokens; Wan's attention splits image from text tokens by this number
NUM_TEXT_TOKENS = 512


def check_tokens(
    text: Tensor | None, image: Tensor | None, takes_image: bool, num_views: int
) -> None:
    """Checks umT5 and CLIP tokens (B, N, any width) for Wan's own cross-attention.

    Raises:
        CheckpointError: missing, or of another number than the attention counts on.
    """
    if text is None or text.shape[1] != NUM_TEXT_TOKENS:
        given = 'no' if text is None else text.shape[1]
        raise CheckpointError(
            f'{given} text tokens given, the model takes {NUM_TEXT_TOKENS}, padded with zeros'
        )
    if not takes_image:
        return
    if image is None or image.shape[1] % num_views:
        given = 'no' if image is None else image.shape[1]
        raise CheckpointError(
            f'{given} image tokens given for {num_views} views; give as many for each view'
        )


class _NoContext(nn.Module):
    """Replaces cross-attention in models without context tokens."""

    def forward(self, hidden_states: Tensor, *_: Any) -> Tensor:
        return torch.zeros_like(hidden_states)


def fit_cross_attention(blocks: Any, *, with_actions: bool, with_text: bool) -> None:
    """Lets the blocks' cross-attention look at a `Context`, or takes it out."""
    for block in blocks:
        if with_actions:
            block.attn2.set_processor(ContextAttnProcessor())
        elif not with_text:
            block.attn2 = _NoContext()
            block.norm2 = nn.Identity()


class RunwiseBlock(WanTransformerBlock):
    """Computes what its base class does; a noise level is held once a run, not once a token."""

    def forward(
        self,
        hidden_states: Tensor,
        encoder_hidden_states: Tensor,
        temb: Tensor,
        rotary_emb: tuple[Tensor, Tensor],
    ) -> Tensor:
        """Returns (B, S, D).

        Args:
            hidden_states: (B, S, D).
            encoder_hidden_states: (B, N, D) tokens of images and text.
            temb: (B, R, 6, D) modulations of the runs.
            rotary_emb: cosines and sines, each (1, S, 1, d).
        """
        levels = (self.scale_shift_table + temb.float()).unsqueeze(3).unbind(2)
        shift, scale, gate, ffn_shift, ffn_scale, ffn_gate = levels
        x = hidden_states.unflatten(1, (temb.shape[1], -1))
        given = _modulated(self.norm1(x.float()), shift, scale).type_as(x).flatten(1, 2)
        attended = self.attn1(given, None, None, rotary_emb).view_as(x)
        x = torch.addcmul(x.float(), attended.float(), gate).type_as(x)
        given = self.norm2(x.float()).type_as(x).flatten(1, 2)
        x = x + self.attn2(given, encoder_hidden_states, None, None).view_as(x)
        given = _modulated(self.norm3(x.float()), ffn_shift, ffn_scale).type_as(x)
        x = torch.addcmul(x.float(), self.ffn(given).float(), ffn_gate).type_as(x)
        return x.flatten(1, 2)


def _modulated(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    return torch.addcmul(shift, x, 1 + scale)


class SelfAttnProcessor:
    """Wan's self-attention; neighbouring channels are turned in two passes in place of eight."""

    _attention_backend = None
    _parallel_config = None

    def __call__(
        self,
        attn: Any,
        hidden_states: Tensor,
        encoder_hidden_states: None = None,
        attention_mask: None = None,
        rotary_emb: tuple[Tensor, Tensor] | None = None,
    ) -> Tensor:
        """Returns (B, S, D) of (B, S, D) tokens at places of `rotary_emb`."""
        del encoder_hidden_states, attention_mask
        assert rotary_emb is not None
        query = attn.norm_q(attn.to_q(hidden_states)).unflatten(2, (attn.heads, -1))
        key = attn.norm_k(attn.to_k(hidden_states)).unflatten(2, (attn.heads, -1))
        value = attn.to_v(hidden_states).unflatten(2, (attn.heads, -1))
        out = dispatch_attention_fn(
            _turned(query, *rotary_emb),
            _turned(key, *rotary_emb),
            value,
            backend=self._attention_backend,
        )
        out = out.flatten(2, 3).type_as(hidden_states)
        return attn.to_out[1](attn.to_out[0](out))


def _turned(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """(B, S, H, d) with pairs of channels turned; cos and sin have each value twice."""
    even, odd = x.unflatten(-1, (-1, 2)).unbind(-1)
    crossed = torch.stack((-odd, even), dim=-1).flatten(-2)
    return torch.addcmul(x * cos, crossed.to(sin.dtype), sin).type_as(x)


def hold_levels_by_run(blocks: nn.ModuleList) -> None:
    """Makes blocks of the base class `RunwiseBlock`s, in place; weights and names stay."""
    block: Any
    for block in blocks:
        block.__class__ = RunwiseBlock
        block.attn1.set_processor(SelfAttnProcessor())
