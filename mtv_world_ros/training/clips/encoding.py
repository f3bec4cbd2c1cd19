"""Clips encoded for the transformer: latents, tokens, and weights of the latents.

Shape letters: B batch, V views, C latent channels, F latent frames, h w latent size, N tokens.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mtv_world_ros.model.autoencoders import SpaceToDepthAutoencoder
from mtv_world_ros.model.card import HistorySettings
from mtv_world_ros.model.conditioning import (
    condition,
    Conditioning,
    encode_chunk,
    with_anchor,
    with_history,
)
from mtv_world_ros.model.encoders import ImageEncoder
from mtv_world_ros.model.parts import Autoencoder
from mtv_world_ros.training.clips.batches import ClipBatch
from mtv_world_ros.training.objective import (
    latent_weights,
    NoiseDraws,
    pixel_weights,
    pooled_weights,
)
from mtv_world_ros.training.training_config import AugmentConfig, ObjectiveConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Encoders:
    """The frozen encoders: pixels to latents, text and images to tokens.

    Attributes:
        autoencoder: autoencoder on the device that trains.
        text: (1, 512, text_dim) umT5 tokens of the prompt that all clips share, in models with
            text; the paper has one for all tasks.
        image: CLIP, in models with text.
        history: settings of the history frames.
    """

    autoencoder: Autoencoder
    text: Tensor | None = None
    image: ImageEncoder | None = None
    history: HistorySettings = HistorySettings()


@dataclass(frozen=True, slots=True, kw_only=True)
class EncodedBatch:
    """Clips in latents.

    Attributes:
        clean: (B, V, C, F, h, w) targets of denoising.
        conditioning: inputs of denoising.
        weights: weights of each latent in the loss, at least 1; the shape of `clean`.
        step, numbers: see `Batch`.
    """

    clean: Tensor
    conditioning: Conditioning
    weights: Tensor
    step: int = 0
    numbers: Sequence[int] = ()

    def parts(self, count: int) -> Iterator[EncodedBatch]:
        """Yield its clips in `count` batches of nearly equal size."""
        size = len(self.numbers)
        for index in range(count):
            chosen = slice(size * index // count, size * (index + 1) // count)
            yield replace(
                self,
                clean=self.clean[chosen],
                conditioning=self.conditioning.part(chosen),
                weights=self.weights[chosen],
                numbers=self.numbers[chosen],
            )


@torch.no_grad()
def encode_batch(
    encoders: Encoders, batch: ClipBatch, objective: ObjectiveConfig, device: torch.device
) -> EncodedBatch:
    """Return a batch of clips in latents, on a device."""
    frames = batch.frames.to(device)
    clean = encode_chunk(encoders.autoencoder, frames).float()
    ids = None if batch.object_ids is None else batch.object_ids.to(device)
    attempted = None if batch.attempted is None else batch.attempted.to(device)
    weights = pixel_weights(frames, ids, objective, attempted)
    return EncodedBatch(
        clean=clean,
        conditioning=condition_batch(encoders, batch, device),
        weights=_weights(weights, encoders.autoencoder, clean),
    )


def condition_batch(encoders: Encoders, batch: ClipBatch, device: torch.device) -> Conditioning:
    """Return the conditioning of a batch."""
    autoencoder, start = encoders.autoencoder, batch.start_frame.to(device)
    latents = condition(autoencoder, start, batch.inputs.to(device))
    latents = _with_past(encoders, latents, batch, device)
    if encoders.text is None or encoders.image is None:
        return latents
    tokens = torch.stack([encoders.image.encode(images).flatten(0, 1) for images in start])
    text = encoders.text.to(device).expand(len(start), -1, -1)
    return replace(latents, text=text, image=tokens.to(device).clone())


def _with_past(
    encoders: Encoders, latents: Conditioning, batch: ClipBatch, device: torch.device
) -> Conditioning:
    """Add anchor and history, in models that take them."""
    settings = encoders.history
    if settings.anchored:
        assert batch.anchor is not None
        latents = with_anchor(encoders.autoencoder, latents, batch.anchor.to(device))
    if not settings.num_frames:
        return latents
    assert batch.history is not None and batch.history_sigmas is not None
    frames, sigmas = batch.history.to(device), batch.history_sigmas.to(device)
    return with_history(encoders.autoencoder, latents, frames, sigmas)


def _weights(weights: Tensor, autoencoder: Autoencoder, clean: Tensor) -> Tensor:
    """Return the pixels' weights (B, V, T, H, W) in the shape of the latents."""
    if isinstance(autoencoder, SpaceToDepthAutoencoder):
        return latent_weights(weights, autoencoder.block_size)
    return pooled_weights(weights, clean.shape)


def drop_conditions(
    conditioning: Conditioning,
    augment: AugmentConfig,
    draws: NoiseDraws,
    control_dropout: float = 0.0,
) -> Conditioning:
    """Drop control, reference, start slot or CLIP tokens in random samples, each independently.

    Dropped latents are zero, dropped tokens of a control are left out. VideoX-Fun drops one in ten
    samples; classifier-free guidance needs a model trained without its condition.

    Args:
        conditioning: conditioning of a batch.
        augment: probabilities of the drops.
        draws: random numbers of the batch.
        control_dropout: the control's own, where it is higher than `augment.control_dropout`.
    """
    dropped = {
        ('control', 'start_control'): max(augment.control_dropout, control_dropout),
        ('reference', 'anchor'): augment.reference_dropout,
        ('start',): augment.start_dropout,
        ('image',): augment.image_dropout,
    }
    changes: dict[str, Tensor] = {}
    for names, probability in dropped.items():
        if probability == 0:  # nothing is drawn: runs without dropout keep their noise
            continue
        kept = draws.uniform() >= probability
        if 'control' in names and conditioning.has_control_tokens:
            changes['control_kept'] = kept.to(conditioning.control.device)
        for name in names:
            value = getattr(conditioning, name)
            if value is not None:
                mask = kept.to(value.device).reshape(-1, *[1] * (value.ndim - 1))
                changes[name] = value * mask
    return replace(conditioning, **changes)
