"""Few-step distillation: straight lines between points of the teacher's own sampling path.

The student's n steps each have to lead where the teacher gets in m steps of its own. A training
step draws noise, follows the teacher down all n * m noise levels, and asks of the student, at each
of the n levels where it will be evaluated, for the straight flow to the next one. With every line
learned, n Euler steps of the student end where n * m of the teacher do; sampler, schedule and the
model's form stay what they are.

Followed: PeRFlow (Yan et al. 2024, arXiv:2405.07510), which straightens a flow within windows; and
FlowSteer (arXiv:2511.18834), which found that PeRFlow fell behind because its windows begin at
noised data, which sampling does not meet, and begins them on the teacher's own path from noise, as
is done here. A guided teacher is followed with its guidance, so that the student needs none (Meng
et al. 2023, arXiv:2210.03142).

Not followed: DMD2 (arXiv:2405.14867; FastWan, LightX2V) and rCM (arXiv:2510.08431), with which the
public 4-step Wan models were made. DMD2 trains a second network for the score of the student's
samples and pulls them towards likely ones (FastWan: 64 H200 for 12 hours); rCM takes derivatives
through the attention kernels and adds that loss. Both match a distribution, where a world model is
asked for the one video that its actions lead to; lines need the teacher and nothing else.

Shape letters: B batch, n the student's steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from diffusers import FlowMatchEulerDiscreteScheduler
import torch
from torch import Tensor

from mtv_world_ros.model.parts import build_scheduler, Scheduler
from mtv_world_ros.model.sampler import set_timesteps

#: (B, ...) noisy latents and their noise level -> the flow (noise - clean)
Flow = Callable[[Tensor, Tensor], Tensor]


def straight_scheduler(scheduler: Scheduler) -> FlowMatchEulerDiscreteScheduler:
    """Returns the schedule of Euler steps with another one's shift; lines need no more."""
    config = scheduler.config
    shift = config['shift'] if 'shift' in config else config['flow_shift']
    return build_scheduler({'shift': shift})  # type: ignore[return-value]


def path_sigmas(scheduler: Scheduler, num_steps: int, substeps: int) -> Tensor:
    """Returns (num_steps * substeps + 1,) noise levels from 1 to 0, as sampling has them.

    Every `substeps`-th one is a level of sampling in `num_steps` steps.
    """
    euler = straight_scheduler(scheduler)
    set_timesteps(euler, num_steps * substeps, torch.device('cpu'))
    return torch.as_tensor(euler.sigmas)


@torch.no_grad()
def follow(flow: Flow, noise: Tensor, sigmas: Tensor, substeps: int) -> list[Tensor]:
    """Returns the n + 1 points of the path from noise to a sample where a line starts or ends.

    Args:
        flow: the teacher.
        noise: (B, ...) at noise level 1.
        sigmas: of `path_sigmas`.
        substeps: Euler steps between two points.
    """
    points = [noise]
    latents = noise
    for index, (now, after) in enumerate(zip(sigmas[:-1], sigmas[1:], strict=True), 1):
        latents = latents + (after - now) * flow(latents, now)
        if index % substeps == 0:
            points.append(latents)
    return points


def straight_flows(points: Sequence[Tensor], sigmas: Tensor) -> list[Tensor]:
    """Returns the n flows that lead from each point to the next one in one Euler step.

    Args:
        points: n + 1 of them.
        sigmas: (n + 1,) their noise levels.
    """
    return [
        (start - end) / (sigma - after)
        for start, end, sigma, after in zip(
            points[:-1], points[1:], sigmas[:-1], sigmas[1:], strict=True
        )
    ]


def as_predicted(prediction: str, flow: Tensor, latents: Tensor, sigma: Tensor) -> Tensor:
    """Returns a flow in the form in which the transformer predicts it: itself, or the sample.

    Args:
        prediction: `flow` or `sample`.
        flow: noise - clean.
        latents: at noise level `sigma`.
        sigma: > 0.
    """
    return flow if prediction == 'flow' else latents - sigma * flow
