"""The distillation objective on Gaussian data, whose flow and its solution are known exactly."""

from __future__ import annotations

import pytest
import torch
from torch import nn, Tensor

from mtv_world_ros.lab.training.distillation import (
    as_predicted,
    follow,
    path_sigmas,
    straight_flows,
    straight_scheduler,
)
from mtv_world_ros.model.conditioning import Conditioning
from mtv_world_ros.model.parts import build_scheduler, Scheduler
from mtv_world_ros.model.sampler import sample_latents

MEAN, STD = 0.7, 0.3
SHAPE = (2, 3, 2, 4, 4)
EULER = {'_class_name': 'FlowMatchEulerDiscreteScheduler', 'shift': 5.0}
UNIPC = {
    '_class_name': 'UniPCMultistepScheduler',
    'prediction_type': 'flow_prediction',
    'use_flow_sigmas': True,
    'flow_shift': 3.0,
}


def gaussian_flow(latents: Tensor, sigma: Tensor) -> Tensor:
    """E[noise - clean | latents] for clean ~ N(MEAN, STD^2), by the Gaussian conditional."""
    variance = (1 - sigma) ** 2 * STD**2 + sigma**2
    away = latents - (1 - sigma) * MEAN
    return (sigma - (1 - sigma) * STD**2) / variance * away - MEAN


class Teacher:
    """A transformer that knows the flow."""

    dtype, prediction, start_image = torch.float32, 'flow', 'both'

    def __call__(self, latents: Tensor, timestep: Tensor, **_: object) -> Tensor:
        return gaussian_flow(latents, timestep[0] / 1000)


class Student(nn.Module):
    """A transformer of a gain and an offset for every noise level, as the level is written."""

    dtype = torch.float32
    start_image = 'both'

    def __init__(self, prediction: str, num_steps: int) -> None:
        super().__init__()
        self.prediction = prediction
        self.levels = path_sigmas(build_scheduler(EULER), num_steps, 1)[:-1]
        self.gain = nn.Parameter(torch.zeros(num_steps))
        self.offset = nn.Parameter(torch.zeros(num_steps))

    def forward(self, latents: Tensor, timestep: Tensor, **_: object) -> Tensor:
        level = (self.levels - timestep[0] / 1000).abs().argmin()
        return self.gain[level] * latents + self.offset[level]


def sample(model: object, scheduler: Scheduler, steps: int) -> Tensor:
    condition = Conditioning(
        control=torch.zeros(1, *SHAPE),
        start_control=torch.zeros(1, 2, 3, 4, 4),
        start=torch.zeros(1, *SHAPE),
        reference=torch.zeros(1, 2, 3, 4, 4),
    )
    return sample_latents(
        model,
        scheduler,
        condition,
        seeds=range(8),
        num_inference_steps=steps,
        should_stop=lambda: False,
    )


def distilled(prediction: str, num_steps: int) -> Student:
    torch.manual_seed(0)
    student = Student(prediction, num_steps)
    substeps = 32 // num_steps
    sigmas = path_sigmas(build_scheduler(EULER), num_steps, substeps)
    optimizer = torch.optim.Adam(student.parameters(), lr=0.1)
    for _ in range(120):
        points = follow(gaussian_flow, torch.randn(4, *SHAPE), sigmas, substeps)
        levels = sigmas[::substeps]
        loss = torch.zeros(())
        for x, sigma, flow in zip(
            points[:-1], levels[:-1], straight_flows(points, levels), strict=True
        ):
            target = as_predicted(prediction, flow, x, sigma)
            loss = loss + (student(x, 1000 * sigma[None]) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return student


@pytest.mark.parametrize('prediction', ['flow', 'sample'])
@pytest.mark.parametrize('num_steps', [1, 2, 4])
def test_the_student_ends_where_the_flow_leads(prediction: str, num_steps: int) -> None:
    """The flow takes noise z to MEAN + STD * z exactly; the teacher in few steps does not."""
    noise = torch.cat(
        [torch.randn(1, *SHAPE, generator=torch.Generator().manual_seed(s)) for s in range(8)]
    )
    exact = MEAN + STD * noise
    scheduler = build_scheduler(EULER)

    def error(samples: Tensor) -> float:
        return (samples - exact).square().mean().sqrt().item()

    student = error(
        sample(distilled(prediction, num_steps), straight_scheduler(scheduler), num_steps)
    )
    teacher = error(sample(Teacher(), scheduler, num_steps))
    many = error(sample(Teacher(), scheduler, 32))
    assert student < 0.35 * teacher
    assert abs(student - many) < 0.01


@pytest.mark.parametrize(('config', 'shift'), [(EULER, 5.0), (UNIPC, 3.0)])
def test_the_path_passes_the_levels_of_the_students_own_sampling(
    config: dict, shift: float
) -> None:
    scheduler = build_scheduler(config)
    few = path_sigmas(scheduler, 4, 1)
    plain = torch.tensor([1.0, 0.75, 0.5, 0.25, 0.0])
    torch.testing.assert_close(few, shift * plain / (1 + (shift - 1) * plain))
    torch.testing.assert_close(path_sigmas(scheduler, 4, 8)[::8], few)
