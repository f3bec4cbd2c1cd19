"""Trains a preset on an episode and keeps the clips and gradients of the first step, a process.

python [-m torch.distributed.run --nproc-per-node 2] train_recorded.py OUT EPISODES PRESET
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
import sys

from safetensors.torch import save_file
import torch

from mtv_world_ros.training.clips.batches import ClipBatch
from mtv_world_ros.training.trainer import Trainer
from test.support.sources import run_training


def record(out: Path) -> None:
    """Make every trainer write down its first step."""
    computed = Trainer.gradients

    def gradients(trainer: Trainer, batch: ClipBatch) -> float:
        loss = computed(trainer, batch)
        if trainer.step == 0:
            tensors = {f'gradient.{n}': p.grad for n, p in trainer.weights.master.items()}
            found = {f.name: getattr(batch, f.name) for f in fields(batch)}
            tensors |= {k: v for k, v in found.items() if isinstance(v, torch.Tensor)}
            out.mkdir(parents=True, exist_ok=True)
            file = out / f'first-{trainer.processes.number}.safetensors'
            save_file({k: v.contiguous() for k, v in tensors.items()}, file)
        return loss

    Trainer.gradients = gradients  # type: ignore[method-assign]


if __name__ == '__main__':
    folder, episodes, preset = (Path(argument) for argument in sys.argv[1:])
    record(folder)
    run_training(folder, episodes, preset)
