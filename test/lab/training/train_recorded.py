"""Trains a preset on an episode and keeps the clips and gradients of the first step, a process.

python [-m torch.distributed.run --nproc-per-node 2] train_recorded.py OUT EPISODES PRESET
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
import sys

from safetensors.torch import save_file
import torch

from mtv_world_ros.files import share_path
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.lab.training.clips.batches import ClipBatch
from mtv_world_ros.lab.training.trainer import Trainer
from mtv_world_ros.lab.training.training_config import load_training_config, TrainingRun
from mtv_world_ros.lab.training.training_run import train
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter


def record(out: Path) -> None:
    """Makes every trainer write down its first step."""
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
    torch.set_num_threads(1)
    folder, episodes, preset = (Path(argument) for argument in sys.argv[1:])
    record(folder)
    train(
        TrainingRun(config=load_training_config(preset), dataset=episodes, out=folder),
        robot=load_robot(share_path('config', 'robots', 'yam_bimanual.yaml')),
        segmenter=ColourSegmenter(),
    )
