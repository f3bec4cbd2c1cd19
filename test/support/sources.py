"""Tiny presets, batches of recordings, trainers of them, and trainings in other processes."""

from __future__ import annotations

from collections.abc import Sequence
import json
import os
from pathlib import Path
import subprocess
import sys
from typing import Any

from safetensors.torch import load_file
import torch
import yaml

from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import Recording
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.training.clips.batches import BatchSource
from mtv_world_ros.training.trainer import Trainer
from mtv_world_ros.training.training_config import (
    load_training_config,
    TrainingConfig,
    TrainingRun,
)
from mtv_world_ros.training.training_run import train
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter

#: a model that is trained in seconds
TINY_MODEL = {
    'transformer.num_attention_heads': 2,
    'transformer.attention_head_dim': 12,
    'transformer.ffn_dim': 32,
    'transformer.num_layers': 1,
    'transformer.stem_widths': [8, 16, 16],
    'transformer.freq_dim': 16,
    'video.width': 48,
    'video.height': 40,
    'optimizer.batch_size': 1,
}


def set_options(values: dict[str, Any]) -> list[str]:
    """Options of `train` that change a preset."""
    return [f'--set={key}={value}' for key, value in values.items()]


#: options of `train` for one step of a tiny model
ONE_STEP = set_options({**TINY_MODEL, 'optimizer.steps': 1})


def with_batch_size(config: TrainingConfig, batch_size: int) -> TrainingConfig:
    """The same with another batch size."""
    return config.replace(optimizer=config.optimizer.replace(batch_size=batch_size))


def make_source(
    recordings: Sequence[Recording], config: TrainingConfig, robot: RobotModel, **more: Any
) -> BatchSource:
    """Their batches, with colour masks and seed 0."""
    segmenter = ColourSegmenter()
    return BatchSource(recordings, config, robot=robot, segmenter=segmenter, seed=0, **more)


def make_trainer(
    config: TrainingConfig, folder: Path, seed: int = 0, device: str = 'cpu', **more: Any
) -> Trainer:
    """A trainer, in bfloat16 on a GPU."""
    dtype = torch.float32 if device == 'cpu' else torch.bfloat16
    return Trainer(config, folder, seed=seed, device=device, dtype=dtype, trained_on={}, **more)


def losses_of(trainer: Trainer, source: BatchSource) -> list[float]:
    """The losses of all steps that are left; none is saved."""
    reports = trainer.run(source, save_every=1000, on_save=lambda _: None)
    return [report.loss for report in reports]


def run_training(out: Path, episodes: Path, preset: Path, **options: Any) -> None:
    """Train the bundled robot's model on one thread of this process."""
    torch.set_num_threads(1)
    run = TrainingRun(config=load_training_config(preset), dataset=episodes, out=out, **options)
    robot = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
    train(run, robot=robot, segmenter=ColourSegmenter())


def state_tensors(out: Path) -> dict[str, torch.Tensor]:
    """The tensors of a training's saved state, whichever of its processes wrote them."""
    files = sorted((out / 'state').glob('*.safetensors'))
    return {name: tensor for file in files for name, tensor in load_file(file).items()}


def write_preset(folder: Path, config: TrainingConfig, **optimizer: Any) -> Path:
    """A preset with other values of its optimizer."""
    values = json.loads(json.dumps(config.model_dump()))
    values['optimizer'] |= optimizer
    file = folder / 'preset.yaml'
    file.write_text(yaml.safe_dump(values))
    return file


def run_script(name: str, *arguments: Path, launcher: Sequence[str] = ()) -> None:
    """Run a script of this folder to its end, without a GPU."""
    script = Path(__file__).with_name(name)
    ended = subprocess.run(
        [sys.executable, *launcher, str(script), *map(str, arguments)],
        env={
            **os.environ,
            'PYTHONPATH': str(Path(__file__).parents[2]),
            'CUDA_VISIBLE_DEVICES': '',
        },
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert ended.returncode == 0, ended.stderr
