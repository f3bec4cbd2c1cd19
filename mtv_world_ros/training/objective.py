"""The training loss: flow matching with higher weights on objects and changing pixels.

Shape letters: B batch, V views, C latent channels, T frames, H W pixels, h w latent size.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
import torch.nn.functional as F

from mtv_world_ros.training.training_config import ObjectiveConfig


class NoiseDraws:
    """Random numbers per clip of a batch; they depend only on seed, step and clip number.

    Numbers are those of the clips within the step's whole batch.
    """

    def __init__(self, seed: int, step: int, numbers: Sequence[int]) -> None:
        # 1: independent of the numbers that cut and disturb the same clip, see `clips/batches.py`
        seeds = [np.random.SeedSequence((seed, step, number, 1)) for number in numbers]
        self._generators = [
            torch.Generator().manual_seed(int(s.generate_state(1, np.uint64)[0] >> 1))
            for s in seeds
        ]

    def uniform(self, *shape: int) -> Tensor:
        """Return (B, *shape) numbers in [0, 1), on the CPU."""
        return torch.stack([torch.rand(shape, generator=g) for g in self._generators])

    def normal(self, *shape: int) -> Tensor:
        """Return (B, *shape) normally distributed numbers, on the CPU."""
        return torch.stack([torch.randn(shape, generator=g) for g in self._generators])


#: RGB difference (of 255) from which a pixel counts as changed
CHANGE_THRESHOLD = 24


class Loss(NamedTuple):
    """A sum of weighted errors and the sum of its weights; their ratio is the loss.

    Both are sums over clips, so that a batch may be split among processes and accumulated parts:
    the sums over the parts give the same ratio and gradients as the whole batch.
    """

    total: Tensor
    weight: Tensor

    @property
    def mean(self) -> Tensor:
        """The loss of these clips alone."""
        return self.total / self.weight


def draw_sigmas(draws: NoiseDraws, config: ObjectiveConfig) -> Tensor:
    """Return (B,) noise levels in (0, 1], shifted towards high noise.

    `sigma' = s * sigma / (1 + (s - 1) * sigma)` as in Wan's schedule.
    """
    uniform = draws.uniform().clamp_min(1e-3)
    shifted = config.sigma_shift * uniform / (1 + (config.sigma_shift - 1) * uniform)
    full = draws.uniform() < config.full_noise_share
    return torch.where(full, torch.ones(()), shifted)


def pixel_weights(
    frames: Tensor,
    object_ids: Tensor | None,
    config: ObjectiveConfig,
    attempted: Tensor | None = None,
) -> Tensor:
    """Return (B, V, T, H, W) weights of the future frames' pixels, at least 1.

    `change_weight`, `object_weight` and `moved_weight` follow what happened: a pixel at the end of
    a carry counts more in the clip where the object came there than in the one where the grasp
    missed, and a model that is unsure gains by imagining that it came. `attempt_weight` counts
    both places in both clips, and favours neither.

    Args:
        frames: (B, V, 1 + T, H, W, 3) uint8 RGB.
        object_ids: (B, V, 1 + T, H, W) uint8 instance ids, 0 = none; None where unknown.
        config: extra weights of pixels.
        attempted: (B, V, 1 + T, H, W) bool places of attempts, see `batches.attempted`; None where
            objects are not known.
    """
    difference = (frames[:, :, 1:].short() - frames[:, :, :1].short()).abs().amax(-1)
    weights = 1.0 + config.change_weight * (difference > CHANGE_THRESHOLD).float()
    if object_ids is not None:
        now, before = object_ids[:, :, 1:], object_ids[:, :, :1]
        weights = weights + config.object_weight * (now > 0).float()
        weights = weights + config.moved_weight * (now != before).float()
    if attempted is not None:
        weights = weights + config.attempt_weight * attempted[:, :, 1:].float()
    return weights


def latent_weights(weights: Tensor, block_size: int) -> Tensor:
    """Return (B, V, 3 * block_size**2, T, h, w) weights for space-to-depth latents."""
    blocks = F.pixel_unshuffle(weights.flatten(0, 1).flatten(0, 1)[:, None], block_size)
    blocks = blocks.repeat(1, 3, 1, 1)  # latent channels are colour-major
    return blocks.unflatten(0, weights.shape[:3]).movedim(3, 2)


def pooled_weights(weights: Tensor, shape: Sequence[int]) -> Tensor:
    """Return weights of shape (B, V, C, 1 + k, h, w) for latents that begin with the start frame.

    Args:
        weights: (B, V, T, H, W) weights of the pixels of the T frames after it; each latent gets
            the mean of those it stands for, the start frame 1.
        shape: shape of the latents.
    """
    frames, height, width = shape[3:]
    pooled = F.adaptive_avg_pool3d(weights.flatten(0, 1), (frames - 1, height, width))
    pooled = F.pad(pooled, (0, 0, 0, 0, 1, 0), value=1.0)
    return pooled.unflatten(0, shape[:2]).unsqueeze(2).expand(*shape)


def add_noise(clean: Tensor, noise: Tensor, sigmas: Tensor) -> Tensor:
    """Return `(1 - sigma) * clean + sigma * noise`; sigmas (B,)."""
    sigma = sigmas.reshape(-1, *[1] * (clean.ndim - 1)).to(clean.dtype)
    return (1 - sigma) * clean + sigma * noise


def sigma_weights(sigmas: Tensor, config: ObjectiveConfig) -> Tensor:
    """Return weights of samples by their noise level, in the shape of `sigmas`.

    `middle` is DiffSynth-Studio's weighting: `exp(-2 ((t - 500) / 1000)^2)` for t = 1000 sigma,
    less its least value, with a mean of 1 over the 1000 steps of the shifted schedule.
    """
    if config.sigma_weighting == 'uniform':
        return torch.ones_like(sigmas)
    steps = torch.linspace(1, 0, 1001, dtype=torch.float64)[:-1]
    shift = config.sigma_shift
    schedule = _bell(shift * steps / (1 + (shift - 1) * steps))
    lowest = schedule.min()
    weights = (_bell(sigmas.double()) - lowest) / (schedule - lowest).mean()
    return weights.clamp_min(0).to(sigmas.dtype)


def _bell(sigmas: Tensor) -> Tensor:
    return torch.exp(-2 * (sigmas - 0.5) ** 2)


def sample_loss(
    predicted: Tensor,
    clean: Tensor,
    weights: Tensor,
    delta: float | None,
    by_sample: Tensor | None = None,
) -> Loss:
    """Return the weighted loss between predicted and clean latents (B, V, C, T, h, w).

    Args:
        predicted: latents that the transformer predicts.
        clean: latents of the recorded frames.
        weights: positive weights, of the same shape.
        delta: error above which the Huber loss is linear; None = the squared error.
        by_sample: (B,) weights of samples; None = equal.
    """
    predicted, clean = predicted.float(), clean.float()
    if delta is None:
        error = F.mse_loss(predicted, clean, reduction='none')
    else:
        error = F.huber_loss(predicted, clean, reduction='none', delta=delta) / delta
    if by_sample is not None:
        error = error * by_sample.reshape(-1, *[1] * (error.ndim - 1))
    return Loss((error * weights).sum(), weights.sum())
