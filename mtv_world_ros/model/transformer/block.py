"""Wan's transformer block for runs of tokens of one noise level, with few passes over memory.

Shape letters: B batch, S tokens, R runs of as many tokens each, D width, H heads, d of a head.
"""

from __future__ import annotations

from typing import Any

from diffusers.models.attention_dispatch import dispatch_attention_fn
from diffusers.models.transformers.transformer_wan import WanTransformerBlock
import torch
from torch import nn, Tensor

from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.model.transformer.attention import attend

#: umT5 tokens; Wan's attention splits image from text tokens by this number
NUM_TEXT_TOKENS = 512


def check_tokens(
    text: Tensor | None, image: Tensor | None, takes_image: bool, num_views: int
) -> None:
    """Check umT5 and CLIP tokens (B, N, any width) for Wan's own cross-attention.

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
    """Replacement of cross-attention in models without context tokens."""

    def forward(self, hidden_states: Tensor, *_: Any) -> Tensor:
        return torch.zeros_like(hidden_states)


def without_cross_attention(blocks: Any) -> None:
    """Take the cross-attention out of the blocks of a model without context tokens."""
    for block in blocks:
        block.attn2 = _NoContext()
        block.norm2 = nn.Identity()


class RunwiseBlock(WanTransformerBlock):
    """Block equal to its base class whose modulation is stored once per run of tokens."""

    def forward(
        self,
        hidden_states: Tensor,
        encoder_hidden_states: Tensor,
        temb: Tensor,
        rotary_emb: tuple[Tensor, Tensor],
    ) -> Tensor:
        """Return (B, S, D).

        Args:
            hidden_states: (B, S, D) tokens.
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
        """Return (B, S, D) of (B, S, D) tokens at places of `rotary_emb`."""
        del encoder_hidden_states, attention_mask
        assert rotary_emb is not None
        query = attn.norm_q(attn.to_q(hidden_states)).unflatten(2, (attn.heads, -1))
        key = attn.norm_k(attn.to_k(hidden_states)).unflatten(2, (attn.heads, -1))
        value = attn.to_v(hidden_states).unflatten(2, (attn.heads, -1))
        query, key = _turned(query, *rotary_emb), _turned(key, *rotary_emb)
        if query.device.type == 'cpu':
            heads = (x.transpose(1, 2) for x in (query, key, value))
            out = attend(*heads).transpose(1, 2)
        else:
            out = dispatch_attention_fn(query, key, value, backend=self._attention_backend)
        out = out.flatten(2, 3).type_as(hidden_states)
        return attn.to_out[1](attn.to_out[0](out))


def _turned(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Return x (B, S, H, d) with rotated pairs of channels; cos and sin have each value twice."""
    even, odd = x.unflatten(-1, (-1, 2)).unbind(-1)
    crossed = torch.stack((-odd, even), dim=-1).flatten(-2)
    return torch.addcmul(x * cos, crossed.to(sin.dtype), sin).type_as(x)


def hold_levels_by_run(blocks: nn.ModuleList) -> None:
    """Make blocks of the base class `RunwiseBlock`s, in place; weights and names stay."""
    block: Any
    for block in blocks:
        block.__class__ = RunwiseBlock
        block.attn1.set_processor(SelfAttnProcessor())
