"""How fast a machine could train a preset at best: the ground of model-FLOP utilisation."""

from __future__ import annotations

from dataclasses import replace
import time

import torch

from mtv_world_ros.model.actions import ActionEncoding
from mtv_world_ros.training.config import TrainingConfig
from mtv_world_ros.training.dry_run import step_cost

#: rows and columns of the matrices that are multiplied
_SIZE = {'cpu': 1024, 'cuda': 8192}
#: products between two waits for the device: on a GPU waiting takes a share of one
_TOGETHER = {'cpu': 1, 'cuda': 10}
_REPEATS = 8


def measured_peak(device: torch.device, dtype: torch.dtype) -> float:
    """Returns operations a second of the fastest of some products of large matrices.

    On a CPU with the threads that torch has now; what else runs there at the time lowers it.
    """
    size = _SIZE.get(device.type, _SIZE['cuda'])
    together = _TOGETHER.get(device.type, _TOGETHER['cuda'])
    left, right = (torch.randn(size, size, device=device, dtype=dtype) for _ in range(2))
    fastest = float('inf')
    for _ in range(_REPEATS):
        started = time.perf_counter()
        for _ in range(together):
            product = left @ right
        product[0, 0].item()  # waits for the device
        fastest = min(fastest, time.perf_counter() - started)
    return together * 2 * size**3 / fastest


def ideal_seconds(
    config: TrainingConfig,
    actions: ActionEncoding | None,
    dtype: torch.dtype,
    flops: float,
) -> float:
    """Returns the time of a step whose forward and backward run at a peak of operations a second.

    The transformer's alone: encoding, and what gradient checkpointing computes again, is not the
    model's arithmetic.
    """
    dim = 0 if actions is None else actions.dim
    optimizer = replace(config.optimizer, gradient_checkpointing=False)
    config = replace(config, optimizer=optimizer)
    return step_cost(config, action_dim=dim, dtype=dtype).step_flop / flops
