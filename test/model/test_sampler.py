"""The sampler: exact for a perfect predictor, reproducible, and stoppable between steps."""

from __future__ import annotations

from types import SimpleNamespace

from diffusers import FlowMatchEulerDiscreteScheduler
import numpy as np
import pytest
import torch
from torch import Tensor

from mtv_world_ros.core.errors import CheckpointError, RolloutPreempted
from mtv_world_ros.model.conditioning import Conditioning
from mtv_world_ros.model.parts import build_scheduler, Scheduler
from mtv_world_ros.model.world_model import sample_latents, set_timesteps

CLEAN = torch.linspace(-1, 1, 2 * 12 * 3 * 4 * 4).reshape(1, 2, 12, 3, 4, 4)
EULER = {'_class_name': 'FlowMatchEulerDiscreteScheduler', 'shift': 5.0}
UNIPC = {
    '_class_name': 'UniPCMultistepScheduler',
    'prediction_type': 'flow_prediction',
    'use_flow_sigmas': True,
    'flow_shift': 5.0,
}


class Oracle:
    """Knows the clean latents; predicts them, or the flow towards them."""

    dtype = torch.float32
    start_image = 'both'

    def __init__(self, prediction: str) -> None:
        self.prediction = prediction
        self.config = SimpleNamespace(prediction=prediction)

    def __call__(self, noisy: Tensor, timestep: Tensor, **_: object) -> Tensor:
        if self.prediction == 'sample':
            return CLEAN.expand_as(noisy)
        return (noisy - CLEAN) / (timestep[0] / 1000)


class ConstantFlow:
    """Predicts the mean of its text as the flow everywhere."""

    dtype = torch.float32
    start_image = 'both'
    prediction = 'flow'

    def __call__(
        self, noisy: Tensor, timestep: Tensor, *, encoder_hidden_states: Tensor, **_: object
    ) -> Tensor:
        del timestep
        return torch.full_like(noisy, encoder_hidden_states.mean().item())


def sample(
    prediction: str = 'sample',
    steps: int = 4,
    should_stop=lambda: False,
    seed: int = 0,
    scheduler: Scheduler | None = None,
    model: object = None,
    **more: object,
) -> Tensor:
    names = ('text', 'negative_text', 'guides_control')
    texts = {name: more.pop(name) for name in names if name in more}
    conditioning = Conditioning(
        control=CLEAN,
        start_control=CLEAN[:, :, :, 0],
        start=CLEAN,
        reference=CLEAN[:, :, :, 0],
        **texts,
    )
    return sample_latents(
        model or Oracle(prediction),
        scheduler or FlowMatchEulerDiscreteScheduler(shift=5.0),
        conditioning,
        seed=seed,
        num_inference_steps=steps,
        should_stop=should_stop,
        **more,
    )


@pytest.mark.parametrize('prediction', ['sample', 'flow'])
@pytest.mark.parametrize('steps', [1, 4, 13])
@pytest.mark.parametrize('config', [EULER, UNIPC], ids=['euler', 'unipc'])
def test_reaches_what_a_perfect_predictor_predicts(prediction, steps, config):
    reached = sample(prediction, steps, scheduler=build_scheduler(config))
    # UniPC tells the model whole time steps, so this oracle's flow is off by up to 1 / 1000
    tolerance = 5e-3 if (config, prediction) == (UNIPC, 'flow') else 1e-5
    torch.testing.assert_close(reached, CLEAN, rtol=0, atol=tolerance)


@pytest.mark.parametrize('steps', [4, 50])
def test_noise_levels_are_spread_and_shifted_as_wan_does(steps):
    """`s * sigma / (1 + (s - 1) * sigma)`; Euler's last one is 1 / n, UniPC's .999 / n."""
    levels = {
        'euler': (EULER, np.linspace(1, 1 / steps, steps), 1e-6),
        'unipc': (UNIPC, np.linspace(0.999, 0, steps + 1)[:-1], 2e-6),
    }
    for config, plain, tolerance in levels.values():
        scheduler = build_scheduler(config)
        set_timesteps(scheduler, steps, torch.device('cpu'))
        expected = 5.0 * plain / (1 + 4.0 * plain)
        sigmas = np.asarray(scheduler.sigmas)
        np.testing.assert_allclose(sigmas[:-1], expected, atol=tolerance)
        assert sigmas[-1] == 0
        timesteps = np.asarray(scheduler.timesteps)
        np.testing.assert_allclose(timesteps, 1000 * expected, rtol=0, atol=1.0)


def test_a_seed_gives_the_same_noise():
    noise = torch.randn(CLEAN.shape, generator=torch.Generator().manual_seed(3))
    still = sample(seed=3, model=ConstantFlow(), text=torch.zeros(1, 512, 1))
    torch.testing.assert_close(still, noise)


@pytest.mark.parametrize(('scale', 'flow'), [(1.0, 2.0), (3.0, 0.5 + 3.0 * (2.0 - 0.5))])
def test_guidance_goes_beyond_the_prompt(scale, flow):
    """A constant flow moves the noise by itself: the levels go from 1 to 0."""
    moved = sample(
        model=ConstantFlow(),
        text=torch.full((1, 512, 1), 2.0),
        negative_text=torch.full((1, 512, 1), 0.5),
        guidance_scale=scale,
    )
    noise = torch.randn(CLEAN.shape, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(moved, noise - flow, rtol=0, atol=1e-5)


class ControlledFlow(ConstantFlow):
    """Predicts 2 as the flow where the control is there, 0.5 where a sample goes without."""

    def __call__(
        self,
        noisy: Tensor,
        timestep: Tensor,
        *,
        control: Tensor,
        control_kept: Tensor | None = None,
        **_: object,
    ) -> Tensor:
        del timestep
        if control_kept is None:
            return torch.full_like(noisy, 2.0)
        assert not control_kept.any() and not control.any()
        return torch.full_like(noisy, 0.5)


@pytest.mark.parametrize(('guides', 'flow'), [(False, 2.0), (True, 0.5 + 2.0 * (2.0 - 0.5))])
def test_guidance_goes_beyond_a_control_that_samples_were_trained_without(guides, flow):
    moved = sample(model=ControlledFlow(), guides_control=guides, guidance_scale=2.0)
    noise = torch.randn(CLEAN.shape, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(moved, noise - flow, rtol=0, atol=1e-5)


def test_stops_between_steps():
    asked = []

    def should_stop() -> bool:
        asked.append(None)
        return len(asked) == 3

    with pytest.raises(RolloutPreempted, match='after 2 of 4 denoising steps'):
        sample(should_stop=should_stop)


@pytest.mark.parametrize(
    ('config', 'message'),
    [
        ({'_class_name': 'DDIMScheduler'}, "'DDIMScheduler' is not one of FlowMatchEuler"),
        ({**UNIPC, 'prediction_type': 'epsilon'}, 'prediction_type: flow_prediction'),
        ({'_class_name': 'UniPCMultistepScheduler'}, 'use_flow_sigmas: true'),
    ],
)
def test_a_schedule_without_flow_matching_is_refused(config, message):
    with pytest.raises(CheckpointError, match=message):
        build_scheduler(config)


@pytest.mark.parametrize(('steps', 'shift'), [(4, 3.0), (50, 3.0), (50, 5.0)])
def test_unipc_has_the_noise_levels_of_videox_fun(steps, shift):
    """Its `FlowUniPCMultistepScheduler`: sigma_max .999 and sigma_min 0 of the unshifted table."""
    scheduler = build_scheduler({**UNIPC, 'flow_shift': shift})
    set_timesteps(scheduler, steps, torch.device('cpu'))
    table = 1.0 - np.linspace(1, 1 / 1000, 1000)[::-1]
    even = np.linspace(table[0], table[-1], steps + 1)[:-1]
    wanted = shift * even / (1 + (shift - 1) * even)
    sigmas = np.asarray(scheduler.sigmas)
    np.testing.assert_allclose(sigmas, [*wanted, 0.0], atol=1e-6)
    assert [int(t) for t in scheduler.timesteps] == [int(1000 * sigma) for sigma in wanted]
    if (steps, shift) == (50, 3.0):
        assert sigmas[-2] == pytest.approx(0.0576, abs=1e-4)  # diffusers alone: 0.0604
