"""Flow-matching sampling with diffusers' schedulers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from diffusers import FlowMatchEulerDiscreteScheduler
import numpy as np
import torch
from torch import Tensor

from mtv_world_ros.errors import RolloutPreempted
from mtv_world_ros.model.conditioning import Conditioning
from mtv_world_ros.model.parts import Scheduler
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer


def flow_of(transformer: MultiViewWanTransformer, out: Tensor, noisy: Tensor, sigma: Tensor):
    """Returns the flow (noise - clean) whatever the transformer predicts.

    Args:
        transformer: its `config.prediction` says what `out` is.
        out: (B, V, C, F, h, w) its output.
        noisy: (B, V, C, F, h, w) its input.
        sigma: noise level of `noisy`, broadcastable to it, > 0.
    """
    if transformer.prediction == 'flow':
        return out
    return (noisy - out) / sigma


@torch.inference_mode()
def sample_latents(
    transformer: MultiViewWanTransformer,
    scheduler: Scheduler,
    conditioning: Conditioning,
    *,
    seeds: Sequence[int],
    num_inference_steps: int,
    should_stop: Callable[[], bool],
    guidance_scale: float = 1.0,
) -> Tensor:
    """Returns (K, V, C, F, h, w) float32 denoised latents, one sample a seed.

    The noise of a seed is drawn on the CPU and by itself, so a seed gives the same rollout on
    every device and in every company.

    Args:
        transformer: the model.
        scheduler: noise levels, shift and step rule.
        conditioning: of one chunk (batch 1); all samples are denoised under it.
        seeds: K seeds of the noise.
        num_inference_steps: denoising steps.
        should_stop: asked between steps.
        guidance_scale: how far to go from what `conditioning.negative_text` gives to what
            `conditioning.text` gives; 1 = no guidance, and half the work.

    Raises:
        RolloutPreempted: `should_stop` said so between two steps.
    """
    shape = conditioning.control.shape[1:]
    device = conditioning.control.device
    if transformer.start_image == 'either':
        conditioning = conditioning.with_one_start()
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    latents = _noise(generators, shape).to(device)
    conditioning = conditioning.repeated(len(seeds))
    if conditioning.history is not None:
        noise = _noise(generators, conditioning.history.shape[1:])
        conditioning = conditioning.with_noisy_history(noise.to(device))
    set_timesteps(scheduler, num_inference_steps, device)
    timesteps: Any = scheduler.timesteps  # the stubs are looser than the schedulers
    sigmas: Any = scheduler.sigmas
    for step, timestep in enumerate(timesteps):
        if should_stop():
            raise RolloutPreempted(
                f'given up after {step} of {num_inference_steps} denoising steps'
            )
        out = denoise(transformer, latents, timestep, conditioning, conditioning.text)
        if guidance_scale != 1.0 and conditioning.negative_text is not None:
            away = denoise(
                transformer, latents, timestep, conditioning, conditioning.negative_text
            )
            out = away + guidance_scale * (out - away)
        flow = flow_of(transformer, out, latents, sigmas[step].to(device))
        latents = scheduler.step(flow, timestep, latents, return_dict=False)[0]  # type: ignore[arg-type]
    return latents


def _noise(generators: Sequence[torch.Generator], shape: Sequence[int]) -> Tensor:
    """(K, *shape) noise, a sample from each generator."""
    return torch.cat([torch.randn(1, *shape, generator=generator) for generator in generators])


def set_timesteps(scheduler: Scheduler, num_inference_steps: int, device: torch.device) -> None:
    """Spreads the steps over the noise levels, from 1 down; the scheduler shifts them."""
    if isinstance(scheduler, FlowMatchEulerDiscreteScheduler):
        sigmas = torch.linspace(1.0, 1.0 / num_inference_steps, num_inference_steps).tolist()
        scheduler.set_timesteps(sigmas=sigmas, device=device)
    else:
        # Wan's and VideoX-Fun's: evenly from .999 to 0, the last one left out. diffusers by itself
        # ends a step of training higher, shifted by 3 at .060 in place of .058 for 50 steps.
        levels = np.linspace(0.999, 0.0, num_inference_steps + 1)[:-1]
        scheduler.set_timesteps(sigmas=levels, device=device)  # type: ignore[arg-type]


def denoise(
    transformer: MultiViewWanTransformer,
    latents: Tensor,
    timestep: Tensor,
    conditioning: Conditioning,
    text: Tensor | None,
) -> Tensor:
    """Returns what the transformer predicts of latents, in float32.

    Args:
        transformer: the model.
        latents: (B, V, C, F, h, w) noisy.
        timestep: of all of them, in [0, 1000].
        conditioning: in the transformer's number format.
        text: tokens in place of the conditioning's.
    """
    return transformer(
        latents.to(transformer.dtype),
        timestep.expand(len(latents)),
        control=conditioning.control,
        start=conditioning.start,
        reference=conditioning.reference,
        start_control=conditioning.start_control,
        encoder_hidden_states=text,
        encoder_hidden_states_image=conditioning.image,
        actions=conditioning.actions,
        anchor=conditioning.anchor,
        history=conditioning.history,
        history_timestep=conditioning.history_timestep,
    ).float()
