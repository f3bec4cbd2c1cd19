"""Conditioning of the transformer in latents: control, start image, reference.

Shape letters: B batch, V views, T frames, H W pixels, C latent channels, F latent frames,
h w = latent size, L context tokens of a control.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
import torch
from torch import Tensor

from mtv_world_ros.control.control import ControlInputs
from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.model.card import HistorySettings
from mtv_world_ros.model.parts import Autoencoder
from mtv_world_ros.model.transformer.control_tokens import PADDING


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditioning:
    """Latents a chunk is denoised under.

    Attributes:
        control: (B, V, C, F, h, w) latents of the control's video, in step with the denoised
            latents; zero where the control feeds none.
        start_control: (B, V, C, h, w) latents of the control's frame 0.
        start: (B, V, C, F, h, w) the start image's channel slot.
        reference: (B, V, C, h, w) latents of the start image.
        text: (B, 512, text_dim) umT5 tokens of the prompt, in models with text.
        negative_text: tokens of the text that guidance leads away from; None = no guidance.
        image: (B, V * 257, image_dim) CLIP tokens of the start image.
        anchor: (B, V, C, h, w) latents of the rollout's first frame, if reference tokens show it.
        history: (B, V, C, P, h, w) latents of earlier frames, in models that take them.
        history_sigmas: (B,) noise levels of the history, 1 = there is none.
        context: (B, L) indices or (B, L, size) vectors of the control, where it feeds them.
        frame: (B, 1 + T, size) vectors of the control, where it feeds them.
        control_kept: (B,) bool, False = a sample without these two; None = all have them.
        guides_control: whether guidance leads away from the sample without its control, too.
    """

    control: Tensor
    start_control: Tensor
    start: Tensor
    reference: Tensor
    text: Tensor | None = None
    negative_text: Tensor | None = None
    image: Tensor | None = None
    anchor: Tensor | None = None
    history: Tensor | None = None
    history_sigmas: Tensor | None = None
    context: Tensor | None = None
    frame: Tensor | None = None
    control_kept: Tensor | None = None
    guides_control: bool = False

    def with_noisy_history(self, noise: Tensor) -> Conditioning:
        """Return the same with noise (B, V, C, P, h, w) mixed into the clean history."""
        assert self.history is not None and self.history_sigmas is not None
        sigma = self.history_sigmas.reshape(-1, 1, 1, 1, 1, 1)
        noisy = (1 - sigma) * self.history.float() + sigma * noise
        return replace(self, history=noisy.to(self.history.dtype))

    @property
    def history_timestep(self) -> Tensor | None:
        """(B,) in [0, 1000], as the transformer takes it."""
        return None if self.history_sigmas is None else 1000 * self.history_sigmas

    def with_one_start(self) -> Conditioning:
        """Return the same with the start image in one place, as Wan2.1-Fun-Control was trained.

        Where the reference tokens would show the start image, its channel slot alone has it and
        the tokens are of zeros; where they show another frame, the slot is zero. (VideoX-Fun,
        scripts/wan2.1_fun/train_control_lora.py, `clip_idx`.)
        """
        shown = self.reference if self.anchor is None else self.anchor
        largest = shown.abs().flatten(1).amax(1)
        difference = (shown - self.reference).abs().flatten(1).amax(1)
        # encoded twice, the same picture differs by rounding
        same = (difference <= 0.01 * largest).reshape(-1, 1, 1, 1, 1)
        return replace(self, start=self.start * same.unsqueeze(3), anchor=shown * ~same)

    @property
    def unguided(self) -> Conditioning | None:
        """Conditioning that guidance leads away from; None = there is none.

        It has the negative text, and no control where the model was trained with samples without.
        """
        if self.guides_control:
            kept = torch.zeros(len(self.control), dtype=torch.bool, device=self.control.device)
            return replace(
                self,
                text=self.text if self.negative_text is None else self.negative_text,
                control=torch.zeros_like(self.control),
                start_control=torch.zeros_like(self.start_control),
                control_kept=kept,
            )
        return None if self.negative_text is None else replace(self, text=self.negative_text)

    @property
    def has_control_tokens(self) -> bool:
        """True if the control provides tokens for the cross-attention."""
        return self.context is not None or self.frame is not None

    def part(self, samples: slice) -> Conditioning:
        """Return that of some samples."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        tensors = {name: v for name, v in values.items() if isinstance(v, Tensor)}
        return replace(self, **{name: v[samples] for name, v in tensors.items()})

    def in_dtype(self, dtype: torch.dtype) -> Conditioning:
        """Return the same with latents and tokens in a number format."""
        latents = ('control', 'start_control', 'start', 'reference', 'anchor', 'history')
        tokens = ('text', 'negative_text', 'image')
        held = {name: getattr(self, name) for name in (*latents, *tokens)}
        return replace(self, **{n: v.to(dtype) for n, v in held.items() if v is not None})


def encode_frames(autoencoder: Autoencoder, frames: Tensor) -> Tensor:
    """Return (B, V, C, F, h, w) latents of (B, V, T, H, W, 3) uint8 RGB frames."""
    video = frames.to(autoencoder.dtype).div(127.5).sub(1.0).movedim(-1, 2)
    latents = autoencoder.encode(video.flatten(0, 1))
    return latents.unflatten(0, frames.shape[:2])


def encode_chunk(autoencoder: Autoencoder, frames: Tensor) -> Tensor:
    """Encode 1 + T frames (B, V, 1 + T, H, W, 3) into the latents (B, V, C, F, h, w)."""
    kept = frames if autoencoder.includes_start else frames[:, :, 1:]
    return encode_frames(autoencoder, kept)


def decode_frames(autoencoder: Autoencoder, latents: Tensor) -> Tensor:
    """Return the (B, V, T, H, W, 3) predicted uint8 RGB frames of (B, V, C, F, h, w) latents."""
    video = autoencoder.decode(latents.flatten(0, 1)).unflatten(0, latents.shape[:2])
    if autoencoder.includes_start:
        video = video[:, :, :, 1:]
    pixels = video.float().add(1.0).mul(127.5).round().clamp(0, 255)
    return pixels.to(torch.uint8).movedim(2, -1)


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlBatch:
    """Inputs of a control for B chunks; see `control.ControlInputs`.

    Attributes:
        num_frames: number of frames, T.
        video: (B, V, 1 + T, H, W, 3) uint8 RGB.
        context: (B, L) int64, `PADDING` = no token, or (B, L, size) float32, NaN = none.
        frame: (B, 1 + T, size) float32 vector of each frame.
    """

    num_frames: int
    video: Tensor | None = None
    context: Tensor | None = None
    frame: Tensor | None = None

    @classmethod
    def of(cls, inputs: Sequence[ControlInputs]) -> ControlBatch:
        """Return the batch of chunks of one control and one length."""
        first = inputs[0]
        return cls(
            num_frames=first.num_frames,
            video=_stacked([one.video for one in inputs]),
            context=None
            if first.context is None
            else pad_rows([torch.from_numpy(i.context) for i in inputs if i.context is not None]),
            frame=_stacked([one.frame for one in inputs]),
        )

    @classmethod
    def drawn(cls, video: Tensor) -> ControlBatch:
        """Return the inputs of plans that are drawn: (B, V, 1 + T, H, W, 3) uint8 RGB."""
        return cls(num_frames=video.shape[2] - 1, video=video)

    def _tensors(self) -> dict[str, Tensor]:
        held = {name: getattr(self, name) for name in ('video', 'context', 'frame')}
        return {name: tensor for name, tensor in held.items() if tensor is not None}

    def to(self, device: torch.device) -> ControlBatch:
        """Return the batch on a device."""
        return replace(self, **{n: v.to(device) for n, v in self._tensors().items()})

    def __getitem__(self, samples: slice) -> ControlBatch:
        return replace(self, **{n: v[samples] for n, v in self._tensors().items()})

    def with_chunk(self, index: int, chunk: ControlBatch) -> ControlBatch:
        """Return the batch with another chunk (B = 1) at an index."""
        changes = {}
        for name, tensor in self._tensors().items():
            other = getattr(chunk, name)[0]
            rows = [tensor[k] if k != index else other for k in range(len(tensor))]
            changes[name] = pad_rows(rows) if name == 'context' else torch.stack(rows)
        return replace(self, **changes)


def _stacked(arrays: Sequence[NDArray[Any] | None]) -> Tensor | None:
    known = [array for array in arrays if array is not None]
    return torch.from_numpy(np.stack(known)) if known else None


def pad_rows(rows: Sequence[Tensor]) -> Tensor:
    """Return token rows (L, ...) of unequal lengths as one tensor (B, longest L, ...)."""
    filler = float('nan') if rows[0].is_floating_point() else PADDING
    return torch.nn.utils.rnn.pad_sequence(list(rows), batch_first=True, padding_value=filler)


def condition(autoencoder: Autoencoder, start_frame: Tensor, inputs: ControlBatch) -> Conditioning:
    """Return the latents and tokens to denoise under.

    Where the control feeds no video its latents are zero, so that the transformer keeps its shape,
    and with it public weights.

    Args:
        autoencoder: autoencoder of the preset.
        start_frame: (B, V, H, W, 3) uint8 RGB.
        inputs: inputs of the control, on the device of the autoencoder.
    """
    reference = encode_frames(autoencoder, start_frame.unsqueeze(2))[:, :, :, 0]
    if inputs.video is None:
        count = autoencoder.num_latent_frames(inputs.num_frames)
        first = torch.zeros_like(reference)
        control = first.unsqueeze(3).repeat(1, 1, 1, count, 1, 1)
    else:
        control = encode_frames(autoencoder, inputs.video)
        first = control[:, :, :, 0]
        if not autoencoder.includes_start:
            control = control[:, :, :, 1:]
    return Conditioning(
        context=inputs.context,
        frame=inputs.frame,
        control=control,
        start_control=first,
        start=start_slot(reference, control.shape[3], autoencoder.includes_start),
        reference=reference,
    )


def start_slot(reference: Tensor, num_latent_frames: int, includes_start: bool) -> Tensor:
    """Return the (B, V, C, F, h, w) start-image slot of (B, V, C, h, w) reference latents.

    Where the video begins with the start image, the slot holds it there and is zero behind, as
    Wan2.1-Fun-Control was trained; else it holds it in every frame.
    """
    slot = reference.unsqueeze(3).expand(-1, -1, -1, num_latent_frames, -1, -1)
    if includes_start:
        slot = torch.cat([slot[:, :, :, :1], torch.zeros_like(slot[:, :, :, 1:])], dim=3)
    return slot


def check_history(
    settings: HistorySettings, autoencoder: Autoencoder, transformer: Mapping[str, Any]
) -> None:
    """Check that history frames divide into latents and tokens.

    Args:
        settings: settings of the model.
        autoencoder: autoencoder of the model.
        transformer: configuration of the transformer.

    Raises:
        CheckpointError: they do not.
    """
    if autoencoder.includes_start:
        merged, first = autoencoder.frames_per_latent, 1
    else:
        conv = transformer.get('stem') == 'conv'
        merged, first = transformer.get('frames_per_token', 4) if conv else 1, 0
    if settings.num_frames and (settings.num_frames - first) % merged:
        more = f'one more than a multiple of {merged}' if first else f'a multiple of {merged}'
        raise CheckpointError(
            f'{settings.num_frames} history frames do not divide into tokens; set '
            f'history.num_frames to {more}, or to 0'
        )


def with_history(
    autoencoder: Autoencoder,
    conditioning: Conditioning,
    frames: Tensor,
    sigmas: Tensor,
) -> Conditioning:
    """Return the conditioning with clean latents of the history.

    The frames are encoded again, because latents of a causal autoencoder depend on the frames
    before them and cannot be cut out of a denoised chunk.

    Args:
        autoencoder: autoencoder of the preset.
        conditioning: conditioning of the chunk.
        frames: (B, V, N, H, W, 3) uint8 RGB.
        sigmas: (B,) noise levels; 1 (pure noise) without history. The timestep then marks the
            history as noise: no attention mask is needed, and every chunk has the same shapes.
    """
    return replace(conditioning, history=encode_frames(autoencoder, frames), history_sigmas=sigmas)


def without_history(
    autoencoder: Autoencoder, conditioning: Conditioning, num_frames: int
) -> Conditioning:
    """Return the conditioning of a chunk without history: noise level 1."""
    count = autoencoder.num_latent_frames(num_frames - int(autoencoder.includes_start))
    start = conditioning.reference.unsqueeze(3)
    return replace(
        conditioning,
        history=torch.zeros_like(start).repeat(1, 1, 1, count, 1, 1),
        history_sigmas=torch.ones(len(start), device=start.device),
    )


def with_anchor(
    autoencoder: Autoencoder, conditioning: Conditioning, frame: Tensor
) -> Conditioning:
    """Return the conditioning with reference tokens of a frame (B, V, H, W, 3) uint8 RGB."""
    anchor = encode_frames(autoencoder, frame.unsqueeze(2))[:, :, :, 0]
    return replace(conditioning, anchor=anchor)
