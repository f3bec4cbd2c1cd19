"""Flow-matching sampling with diffusers' Euler scheduler."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from mtv_world_ros.errors import RolloutPreempted
from mtv_world_ros.model.conditioning import Conditioning
from mtv_world_ros.model.transformer import MultiViewWanTransformer


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
    scheduler: Any,  # its stubs are looser than what it does
    conditioning: Conditioning,
    *,
    seed: int,
    num_inference_steps: int,
    should_stop: Callable[[], bool],
) -> Tensor:
    """Returns (B, V, C, F, h, w) float32 denoised latents.

    `scheduler` is a diffusers `FlowMatchEulerDiscreteScheduler`. The noise is drawn on the CPU, so
    a seed gives the same rollout on every device.

    Raises:
        RolloutPreempted: `should_stop` said so between two steps.
    """
    shape = conditioning.control.shape
    device = conditioning.control.device
    generator = torch.Generator().manual_seed(seed)
    latents = torch.randn(shape, generator=generator).to(device)
    sigmas = torch.linspace(1.0, 1.0 / num_inference_steps, num_inference_steps).tolist()
    scheduler.set_timesteps(sigmas=sigmas, device=device)
    for step, timestep in enumerate(scheduler.timesteps):
        if should_stop():
            raise RolloutPreempted(
                f'given up after {step} of {num_inference_steps} denoising steps'
            )
        out = transformer(
            latents.to(transformer.dtype),
            timestep.expand(shape[0]),
            control=conditioning.control,
            start=conditioning.start,
            reference=conditioning.reference,
            start_control=conditioning.start_control,
            actions=conditioning.actions,
        ).float()
        flow = flow_of(transformer, out, latents, scheduler.sigmas[step].to(device))
        latents = scheduler.step(flow, timestep, latents, return_dict=False)[0]
    return latents
