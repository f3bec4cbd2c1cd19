"""Random numbers of a batch, each clip's own: the same in whatever process the clip is trained."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor


class Draws:
    """Numbers for the clips of a batch; a clip's depend on seed, step and its number alone.

    Args:
        seed: of the run.
        step: of the training.
        numbers: of the clips within the step's whole batch.
    """

    def __init__(self, seed: int, step: int, numbers: Sequence[int]) -> None:
        # 1: apart from the numbers that cut and disturb the same clip, see `clips/batches.py`
        seeds = [np.random.SeedSequence((seed, step, number, 1)) for number in numbers]
        self._generators = [
            torch.Generator().manual_seed(int(s.generate_state(1, np.uint64)[0] >> 1))
            for s in seeds
        ]

    def uniform(self, *shape: int) -> Tensor:
        """Returns (B, *shape) numbers in [0, 1), on the CPU."""
        return torch.stack([torch.rand(shape, generator=g) for g in self._generators])

    def normal(self, *shape: int) -> Tensor:
        """Returns (B, *shape) normally distributed numbers, on the CPU."""
        return torch.stack([torch.randn(shape, generator=g) for g in self._generators])
