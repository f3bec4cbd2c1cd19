"""The one diffusion transformer: Wan's, over all views in one token sequence.

Shape letters: B batch, V views, C latent channels, F latent frames, H W latent size,
P latent frames of the history, f h w = token grid, D width; `tokens.py` has the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from diffusers import WanTransformer3DModel
from diffusers.configuration_utils import register_to_config
import torch
from torch import nn, Tensor
from torch.utils.checkpoint import checkpoint

from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.core.network_sizes import check_sizes
from mtv_world_ros.model.transformer.block import (
    check_tokens,
    hold_levels_by_run,
    without_cross_attention,
)
from mtv_world_ros.model.transformer.control_tokens import ContextAttnProcessor, ControlTokens
from mtv_world_ros.model.transformer.stem import ConvStem, ReferenceDecoder, ReferenceStem
from mtv_world_ros.model.transformer.tokens import (
    arrange,
    by_run,
    check_start_image,
    embed_history,
    embed_reference,
    embed_video,
    MultiViewRotaryPosEmbed,
    unembed,
)


class MultiViewWanTransformer(WanTransformer3DModel):
    """`WanTransformer3DModel` with views, control latents and reference latents.

    Input channels per view are `cat[noisy | control | start image]`; reference latents pass
    through phi (`ref_conv`), are prepended in time and dropped again. The layout follows
    Wan2.1-Fun-Control with all views in one sequence (paper, Method).

    A history, what was seen before the chunk, goes through the video's own stem with a noise level
    of its own. In time it stands before the reference image, at negative times, so that the
    video's are those of a chunk without history; its tokens are dropped like the reference's.

    Args (beyond the base class):
        latent_channels: C of the autoencoder.
        num_views: views it has an embedding for.
        stem: `patch` (Wan's own) or `conv` (small preset).
        stem_widths: channels of the convolutional stem at full, half and quarter latent size.
        frames_per_token: latent frames merged by the convolutional stem; with patches, video
            frames that the autoencoder merges.
        context: `text_image` (cross-attention as in Wan) or `none`.
        view_offset: see `MultiViewRotaryPosEmbed`.
        prediction: `flow` (noise - clean, Wan) or `sample` (the clean latents).
        start_image: where the start image enters: `both` as reference tokens and in its channel
            slot, or in `either` (see `Conditioning.with_one_start`).
        copies_control: the convolutional decoder may also copy from the trajectory video, where
            that shows the objects themselves (`rendering.object_motion`).
        context_input: fields of `control.ContextInput`, tokens of a control that all tokens see;
            None = no such input. With it or the next one, blocks have cross-attention also where
            `context` is `none`.
        frame_input: fields of `control.FrameInput`, vectors of a control that their own frames
            see; None = no such input.
        num_prompt_tokens: learned tokens in place of the text where `context` is `none` and there
            is a `context_input`.
    """

    _repeated_blocks = ['WanTransformerBlock', 'RunwiseBlock']
    _no_split_modules = _repeated_blocks
    # number formats are chosen by whoever loads the model, in one place for all modules
    _keep_in_fp32_modules = None

    @register_to_config
    def __init__(
        self,
        patch_size: tuple[int, ...] = (1, 2, 2),
        num_attention_heads: int = 12,
        attention_head_dim: int = 128,
        in_channels: int = 48,
        out_channels: int = 16,
        text_dim: int = 4096,
        freq_dim: int = 256,
        ffn_dim: int = 8960,
        num_layers: int = 30,
        cross_attn_norm: bool = True,
        qk_norm: str | None = 'rms_norm_across_heads',
        eps: float = 1e-6,
        image_dim: int | None = None,
        added_kv_proj_dim: int | None = None,
        rope_max_seq_len: int = 1024,
        pos_embed_seq_len: int | None = None,
        latent_channels: int = 16,
        num_views: int = 2,
        stem: str = 'patch',
        stem_widths: tuple[int, int, int] = (48, 96, 128),
        frames_per_token: int = 4,
        context: str = 'text_image',
        view_offset: str = 'width',
        prediction: str = 'flow',
        start_image: str = 'both',
        copies_control: bool = False,
        context_input: dict[str, Any] | None = None,
        frame_input: dict[str, Any] | None = None,
        num_prompt_tokens: int = 8,
    ) -> None:
        sizes = {'num_layers': num_layers, 'num_views': num_views, 'patch_size': patch_size}
        sizes |= {'num_attention_heads': num_attention_heads, 'ffn_dim': ffn_dim}
        sizes |= {'attention_head_dim': attention_head_dim, 'rope_max_seq_len': rope_max_seq_len}
        check_sizes(sizes, 'transformer')
        super().__init__(
            patch_size=patch_size,
            num_attention_heads=num_attention_heads,
            attention_head_dim=attention_head_dim,
            in_channels=in_channels,
            out_channels=out_channels,
            text_dim=text_dim,
            freq_dim=freq_dim,
            ffn_dim=ffn_dim,
            num_layers=num_layers,
            cross_attn_norm=cross_attn_norm,
            qk_norm=qk_norm,
            eps=eps,
            image_dim=image_dim,
            added_kv_proj_dim=added_kv_proj_dim,
            rope_max_seq_len=rope_max_seq_len,
            pos_embed_seq_len=pos_embed_seq_len,
        )
        self.stem, self.prediction = stem, prediction
        self.start_image = check_start_image(start_image)
        if stem == 'patch':  # as Wan was trained; bfloat16 is too coarse for angles and times
            self._keep_in_fp32_modules = ['rope', 'time_embedder', 'scale_shift_table']
        self.patch_size = tuple(patch_size)
        dim = num_attention_heads * attention_head_dim
        # computed, not loaded: real also where the weights are still to come (meta device)
        with torch.device('cpu'):
            self.rope = MultiViewRotaryPosEmbed(
                attention_head_dim, patch_size, rope_max_seq_len, view_offset
            )
        self.view_embedding = nn.Parameter(torch.zeros(num_views, dim))
        if context == 'none':
            self.condition_embedder.text_embedder = nn.Identity()  # type: ignore[assignment]
        if stem == 'conv':
            self._build_conv_stem(
                in_channels, latent_channels, stem_widths, dim, frames_per_token, copies_control
            )
        else:
            self.ref_conv = nn.Conv2d(latent_channels, dim, patch_size[1:], stride=patch_size[1:])  # type: ignore[arg-type]
        hold_levels_by_run(self.blocks)
        self.with_text = context != 'none'
        # last, so that a seed gives all controls the same weights of what they share
        self.control_tokens: ControlTokens | None = None
        if context_input is not None or frame_input is not None:
            self._build_control_tokens(context_input, frame_input)
        elif not self.with_text:
            without_cross_attention(self.blocks)

    def add_control_inputs(
        self,
        context_input: dict[str, Any] | None = None,
        frame_input: dict[str, Any] | None = None,
    ) -> None:
        """Add inputs of a control to a model with text; other weights stay as they are.

        Args:
            context_input: fields of `control.ContextInput`; None = no such input.
            frame_input: fields of `control.FrameInput`; None = no such input.

        Raises:
            CheckpointError: the model has no cross-attention, or other control inputs already.
        """
        if not self.with_text or self.control_tokens is not None:
            reason = 'other control inputs' if self.control_tokens else 'no cross-attention'
            raise CheckpointError(
                f'the transformer has {reason}: train a model of this control from the start'
            )
        self._build_control_tokens(context_input, frame_input)
        self.register_to_config(context_input=context_input, frame_input=frame_input)

    def _build_control_tokens(
        self, context_input: dict[str, Any] | None, frame_input: dict[str, Any] | None
    ) -> None:
        config: Any = self.config
        self.control_tokens = ControlTokens(
            context=context_input,
            frame=frame_input,
            dim=config['num_attention_heads'] * config['attention_head_dim'],
            frames_per_token=config['frames_per_token'],
            num_prompt_tokens=0 if self.with_text else config['num_prompt_tokens'],
        )
        blocks: Any = self.blocks
        for block in blocks:
            block.attn2.set_processor(ContextAttnProcessor())

    def _build_conv_stem(
        self,
        in_channels: int,
        channels: int,
        widths: tuple[int, int, int],
        dim: int,
        merge: int,
        copies_control: bool,
    ) -> None:
        self.patch_embedding = ConvStem(in_channels, widths, dim, merge)  # type: ignore[assignment]
        self.ref_conv = ReferenceStem(2 * channels, widths, dim)
        self.proj_out = ReferenceDecoder(  # type: ignore[assignment]
            channels, widths, dim, merge, widths[1], copies_control
        )

    def forward(  # type: ignore[override]
        self,
        hidden_states: Tensor,
        timestep: Tensor,
        control: Tensor,
        start: Tensor,
        reference: Tensor,
        start_control: Tensor | None = None,
        encoder_hidden_states: Tensor | None = None,
        encoder_hidden_states_image: Tensor | None = None,
        anchor: Tensor | None = None,
        history: Tensor | None = None,
        history_timestep: Tensor | None = None,
        control_context: Tensor | None = None,
        control_frame: Tensor | None = None,
        control_kept: Tensor | None = None,
        before_block: Callable[[], None] | None = None,
    ) -> Tensor:
        """Return (B, V, C, F, H, W): flow or clean latents, as `config.prediction` says.

        Args:
            hidden_states: (B, V, C, F, H, W) noisy latents.
            timestep: (B,) timestep in [0, 1000].
            control: (B, V, C, F, H, W) latents of the trajectory video.
            start: (B, V, C, F, H, W) latents for the start-image slot.
            reference: (B, V, C, H, W) latents of the start image.
            start_control: (B, V, C, H, W) latents of the control frame 0 (convolutional stem).
            encoder_hidden_states: (B, 512, text_dim) umT5 tokens.
            encoder_hidden_states_image: (B, V * 257, image_dim) CLIP tokens.
            anchor: (B, V, C, H, W) latents of the image that the reference tokens are made of, in
                place of the start image: the first one of the rollout.
            history: (B, V, C, P, H, W) latents of what was seen before the chunk, as noisy as
                `history_timestep` says; None = no such tokens.
            history_timestep: (B,) history timestep in [0, 1000]; 1000 = nothing is known of it.
            control_context: (B, L) indices or (B, L, size) vectors of the control, in models with
                `context_input`.
            control_frame: (B, 1 + T, size) vectors of the control, in models with `frame_input`.
            control_kept: (B,) bool, False = a sample without these two; None = all have them.
            before_block: called before each block and after the last; what it raises ends the
                call.

        Raises:
            CheckpointError: more views than the model has embeddings for, or text, image or
                control tokens that are missing or of another number.
        """
        num_views = hidden_states.shape[1]
        if num_views > self.view_embedding.shape[0]:
            raise CheckpointError(
                f'{num_views} views given, the model was built for '
                f'{self.view_embedding.shape[0]}; set `views` to those, or train with num_views'
            )
        if self.with_text:
            takes_image = self.config['added_kv_proj_dim'] is not None
            check_tokens(
                encoder_hidden_states, encoder_hidden_states_image, takes_image, num_views
            )
        if encoder_hidden_states is None:
            encoder_hidden_states = hidden_states.new_zeros(hidden_states.shape[0], 1, 1)
        temb, time_proj, text, image = self._embed_times(
            timestep, history_timestep, encoder_hidden_states, encoder_hidden_states_image
        )
        x = torch.cat([hidden_states, control, start], dim=2)
        tokens, skips = embed_video(self, x, temb[:, 0])
        ref_tokens, keys = embed_reference(self, reference, start_control, anchor, temb[:, 0])
        grid = arrange(
            tokens,
            ref_tokens,
            None if history is None else embed_history(self, history, start, temb[:, -1]),
        )
        sequence = grid.tokens + self.view_embedding[:num_views, None, None, None]
        context: Any = text if image is None else torch.cat([image, text], dim=1)
        if self.control_tokens is not None:
            context = self.control_tokens(
                control_context,
                control_frame,
                control_kept,
                text if self.with_text else None,
                image,
                num_slots=grid.tokens.shape[2] - grid.num_history,
                num_views=num_views,
            ).with_history(grid.num_history)
        sequence = self._run_blocks(
            sequence.flatten(1, 4),
            context,
            by_run(time_proj, grid),
            self.rope(grid.tokens, grid.times),
            before_block,
        )
        shift, scale = (self.scale_shift_table + temb[:, :1]).chunk(2, dim=1)
        sequence = (self.norm_out(sequence.float()) * (1 + scale) + shift).type_as(sequence)
        kept = sequence.reshape(grid.tokens.shape)[:, :, grid.num_history + 1 :]
        return unembed(self, kept, skips, temb[:, 0], keys, reference, control)

    def _embed_times(
        self,
        timestep: Tensor,
        history_timestep: Tensor | None,
        text: Tensor,
        image: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Return (B, K, D) embeddings and (B, K, 6, D) modulations of K noise levels; text.

        Images.

        K is 2 with a history, whose level comes last, else 1.
        """
        if history_timestep is None:
            temb, proj, text, image = self.condition_embedder(timestep, text, image)
            temb, proj = temb.unsqueeze(1), proj.unsqueeze(1)
        else:
            both = torch.stack([timestep, history_timestep], dim=1).flatten()
            temb, proj, text, image = self.condition_embedder(
                both, text, image, timestep_seq_len=2
            )
        return temb, proj.unflatten(2, (6, -1)), text, image

    def _run_blocks(
        self,
        sequence: Tensor,
        context: Any,
        time_proj: Tensor,
        rotary: tuple[Tensor, Tensor],
        before_block: Callable[[], None] | None,
    ) -> Tensor:
        for block in self.blocks:
            if before_block is not None:
                before_block()
            if torch.is_grad_enabled() and self.gradient_checkpointing:
                sequence = checkpoint(
                    block, sequence, context, time_proj, rotary, use_reentrant=False
                )
            else:
                sequence = block(sequence, context, time_proj, rotary)
        if before_block is not None:
            before_block()
        return sequence


def copy_of(transformer: MultiViewWanTransformer) -> MultiViewWanTransformer:
    """Return another transformer of the same configuration and weights."""
    other: Any = MultiViewWanTransformer.from_config(transformer.config)
    other.load_state_dict(transformer.state_dict())
    return other
