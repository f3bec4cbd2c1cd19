"""How actions enter the transformer when they are not drawn: as context of its cross-attention.

Shape letters: B batch, V views, T frames of a chunk, A numbers an action, L action tokens, N
context tokens, D width, S = 1 + f time slots (the reference image and f token frames), G frames
that one token frame stands for.
"""

from __future__ import annotations

import torch
from torch import nn, Tensor

from mtv_world_ros.errors import CheckpointError
from mtv_world_ros.model.actions import (
    check_control,
    EE_MLP,
    POLICY2VEC,
    TRAJECTORY_VIDEO,
    VOCABULARY,
)
from mtv_world_ros.model.transformer.block import Context

#: width of Ctrl-World's action encoder; narrower where the model is
_HIDDEN = 1024


class Policy2Vec(nn.Module):
    """One vector for the whole chunk, added to every text token (World-Eval)."""

    def __init__(self, action_dim: int, dim: int) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(action_dim, dim), nn.GELU(), nn.Linear(dim, dim))
        self.scale = nn.Parameter(torch.tensor(0.3))

    def forward(self, actions: Tensor, text: Tensor, num_slots: int) -> tuple[Tensor, None]:
        """Returns (B, N, D) of actions (B, 1 + T, A) and text (B, N, D)."""
        del num_slots
        return text + self.scale * self.net(actions[:, 1:].mean(1))[:, None], None


class FrameActionMlp(nn.Module):
    """A token per action; a token frame sees those of its own frames alone (Ctrl-World)."""

    def __init__(self, action_dim: int, dim: int, frames_per_token: int) -> None:
        super().__init__()
        hidden = min(_HIDDEN, dim)
        self.net = nn.Sequential(
            nn.Linear(action_dim, hidden),
            nn.SiLU(),
            nn.Linear(hidden, hidden),
            nn.SiLU(),
            nn.Linear(hidden, dim),
        )
        # which of its slot's frames an action belongs to: attention knows no order
        self.place = nn.Parameter(0.02 * torch.randn(frames_per_token, dim))

    def forward(self, actions: Tensor, text: Tensor | None, num_slots: int) -> tuple[Tensor, None]:
        """Returns (B, S, G, D) of actions (B, 1 + T, A); the mean text token is added."""
        tokens = self.net(by_slot(actions, num_slots, len(self.place))) + self.place
        return tokens if text is None else tokens + text.mean(1)[:, None, None], None


def by_slot(actions: Tensor, num_slots: int, group: int) -> Tensor:
    """Returns (B, S, G, A): the actions of each time slot.

    The first action is repeated G - 1 more times, then G neighbours form a group: (T + G) / G
    groups, the first one for the start. Where the video itself begins with the start frame, the
    reference slot before it shares that group.

    Raises:
        CheckpointError: the number of frames does not fit the number of slots.
    """
    padded = torch.cat([actions[:, :1].expand(-1, group - 1, -1), actions], dim=1)
    if padded.shape[1] % group == 0:
        groups = padded.unflatten(1, (-1, group))
        if groups.shape[1] == num_slots:
            return groups
        if groups.shape[1] == num_slots - 1:
            return torch.cat([groups[:, :1], groups], dim=1)
    raise CheckpointError(
        f'{actions.shape[1] - 1} actions do not divide into {num_slots - 1} token frames of '
        f'{group} frames each; set transformer.frames_per_token to video frames per token'
    )


class FastTokenEmbedding(nn.Module):
    """Action tokens behind the text tokens, with a code of their place (FAST)."""

    def __init__(self, dim: int, vocabulary: int = VOCABULARY) -> None:
        super().__init__()
        self.embedding = nn.Embedding(vocabulary, dim)
        nn.init.normal_(self.embedding.weight, std=0.5)

    def forward(self, tokens: Tensor, text: Tensor, num_slots: int) -> tuple[Tensor, Tensor]:
        """Returns (B, N + L, D) of tokens (B, L), -1 = padding, and which of them count."""
        del num_slots
        embedded = self.embedding(tokens.clamp_min(0))
        embedded = embedded + _place_codes(tokens.shape[1], embedded)
        counts = torch.ones(text.shape[:2], dtype=torch.bool, device=text.device)
        mask = torch.cat([counts, tokens >= 0], dim=1)
        return torch.cat([text, embedded.to(text.dtype)], dim=1), mask


def _place_codes(length: int, like: Tensor) -> Tensor:
    """(length, D) sines and cosines of the places, as in "Attention is all you need"."""
    half = like.shape[-1] // 2
    rates = torch.exp(torch.arange(half, device=like.device) * (-9.21 / half))  # 1 .. 1e-4
    angles = torch.arange(length, device=like.device)[:, None] * rates
    return torch.cat([angles.sin(), angles.cos()], dim=1).to(like.dtype)


class ActionControl(nn.Module):
    """The actions of a chunk as context.

    Args:
        control: `policy2vec`, `ee_mlp` or `fast_tokens`.
        action_dim: A.
        dim: D.
        frames_per_token: G.
        num_prompt_tokens: learned tokens in place of the text, in presets without; 0 = with text.
    """

    def __init__(
        self,
        control: str,
        *,
        action_dim: int,
        dim: int,
        frames_per_token: int,
        num_prompt_tokens: int,
    ) -> None:
        super().__init__()
        if control == POLICY2VEC:
            self.encoder: nn.Module = Policy2Vec(action_dim, dim)
        elif control == EE_MLP:
            self.encoder = FrameActionMlp(action_dim, dim, frames_per_token)
        else:
            self.encoder = FastTokenEmbedding(dim)
        self.prompt = None
        if num_prompt_tokens and control != EE_MLP:
            self.prompt = nn.Parameter(0.5 * torch.randn(num_prompt_tokens, dim))

    def forward(
        self,
        actions: Tensor,
        kept: Tensor | None,
        text: Tensor | None,
        image: Tensor | None,
        slots_views: tuple[int, int],
    ) -> Context:
        """Returns the context.

        Args:
            actions: (B, 1 + T, A) scaled actions, row 0 the start; tokens (B, L) of `fast_tokens`.
            kept: (B,) bool, False = this sample's context is zero (only `ee_mlp` drops actions);
                None = all kept.
            text: (B, N, D) embedded text, None in presets without.
            image: (B, M, D) embedded images or None.
            slots_views: S and V.
        """
        if self.prompt is not None:
            text = self.prompt.expand(len(actions), -1, -1)
        if actions.is_floating_point():
            actions = actions.to(next(self.encoder.parameters()).dtype)
        tokens, mask = self.encoder(actions, text, slots_views[0])
        if kept is not None:
            tokens = tokens * kept.to(tokens.dtype).reshape(-1, *[1] * (tokens.ndim - 1))
        return Context(tokens=tokens, num_views=slots_views[1], mask=mask, image=image)


def build_control(
    control: str, *, with_text: bool, num_context_tokens: int, **sizes: int
) -> ActionControl | None:
    """Returns what a control needs beside the transformer; None for the trajectory video.

    Args:
        control: one of `CONTROLS`.
        with_text: whether the model has text tokens.
        num_context_tokens: learned tokens in their place, where it has none.
        **sizes: `action_dim`, `dim`, `frames_per_token`.

    Raises:
        ConfigError: an unknown control.
        CheckpointError: the sizes are not set.
    """
    check_control(control)
    if control == TRAJECTORY_VIDEO:
        return None
    if sizes['action_dim'] < 1:
        raise CheckpointError(
            f"control '{control}' needs transformer.action_dim, the numbers of an action; "
            "'mtv-world train' sets it from the robot"
        )
    return ActionControl(
        control, num_prompt_tokens=0 if with_text else num_context_tokens, **sizes
    )
