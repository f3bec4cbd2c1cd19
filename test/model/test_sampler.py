"""The sampler: exact for a perfect predictor, reproducible, and stoppable between steps."""

from __future__ import annotations

from types import SimpleNamespace

from diffusers import FlowMatchEulerDiscreteScheduler
import pytest
import torch

from mtv_world_ros.errors import RolloutPreempted
from mtv_world_ros.model.conditioning import Conditioning
from mtv_world_ros.model.sampler import sample_latents

CLEAN = torch.linspace(-1, 1, 2 * 12 * 3 * 4 * 4).reshape(1, 2, 12, 3, 4, 4)


class Oracle:
    """Knows the clean latents; predicts them, or the flow towards them."""

    dtype = torch.float32

    def __init__(self, prediction: str) -> None:
        self.prediction = prediction
        self.config = SimpleNamespace(prediction=prediction)

    def __call__(self, noisy: torch.Tensor, timestep: torch.Tensor, **_: object) -> torch.Tensor:
        if self.prediction == 'sample':
            return CLEAN
        return (noisy - CLEAN) / (timestep[0] / 1000)


def sample(prediction: str = 'sample', steps: int = 4, should_stop=lambda: False, seed: int = 0):
    conditioning = Conditioning(
        control=CLEAN, start_control=CLEAN[:, :, :, 0], start=CLEAN, reference=CLEAN[:, :, :, 0]
    )
    return sample_latents(
        Oracle(prediction),  # type: ignore[arg-type]
        FlowMatchEulerDiscreteScheduler(shift=5.0),
        conditioning,
        seeds=[seed],
        num_inference_steps=steps,
        should_stop=should_stop,
    )


@pytest.mark.parametrize('prediction', ['sample', 'flow'])
@pytest.mark.parametrize('steps', [1, 4, 13])
def test_reaches_what_a_perfect_predictor_predicts(prediction: str, steps: int) -> None:
    torch.testing.assert_close(sample(prediction, steps), CLEAN, rtol=0, atol=1e-5)


def test_stops_between_steps() -> None:
    asked = []

    def should_stop() -> bool:
        asked.append(None)
        return len(asked) == 3

    with pytest.raises(RolloutPreempted, match='after 2 of 4 denoising steps'):
        sample(should_stop=should_stop)
