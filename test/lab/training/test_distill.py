"""`distill`: from a checkpoint and episodes to a student that says how many steps it needs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from sources import make_source, with_batch_size
import torch

from mtv_world_ros.assembly import load_pipeline
from mtv_world_ros.cli import main
from mtv_world_ros.data.recording import Recording
from mtv_world_ros.errors import ConfigError, TrainingError
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.lab.training.clips.batches import BatchSource
from mtv_world_ros.lab.training.distillation import (
    distill,
    DistillConfig,
    DistillTrainer,
    student_config,
)
from mtv_world_ros.lab.training.trainer import Trainer
from mtv_world_ros.lab.training.training_config import HistoryConfig, TrainingConfig, TrainingRun
from mtv_world_ros.model.checkpoint import load_checkpoint
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter


@pytest.fixture(scope='module')
def teacher(tiny: TrainingConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model whose answer depends on its noise, unlike that of an untrained one."""
    return make_teacher(tiny, tmp_path_factory.mktemp('teacher'))


def make_teacher(config: TrainingConfig, folder: Path) -> Path:
    trainer = Trainer(
        config, folder, seed=0, device='cpu', dtype=torch.float32, trained_on={'steps': 0}
    )
    generator = torch.Generator().manual_seed(0)
    for averaged in trainer.weights.ema.shadow_params:
        averaged.add_(0.05 * torch.randn(averaged.shape, generator=generator))
    trainer.export(folder / 'checkpoint', dtype=torch.float32)
    return folder / 'checkpoint'


def make(folder: Path, teacher: Path, config: TrainingConfig, **settings: int) -> DistillTrainer:
    loaded = load_checkpoint(teacher)
    trainer = DistillTrainer(
        student_config(config, loaded),
        folder,
        seed=0,
        device='cpu',
        dtype=torch.float32,
        trained_on={},
        teacher=loaded,
        distill=DistillConfig(**{'num_steps': 2, 'teacher_steps': 4, **settings}),
    )
    if not trainer.load_state():
        trainer.start_from(teacher)
    return trainer


def run(trainer: Trainer, source: BatchSource) -> list[float]:
    return [r.loss for r in trainer.run(source, save_every=2, on_save=lambda _: None)]


def test_a_student_as_slow_as_its_teacher_has_nothing_to_learn(
    teacher: Path, tiny: TrainingConfig, source: BatchSource, tmp_path: Path
) -> None:
    same = make(tmp_path / 'same', teacher, tiny, num_steps=4, teacher_steps=4)
    faster = make(tmp_path / 'faster', teacher, tiny, num_steps=1, teacher_steps=4)
    batch = source.batch(0)
    assert same.loss(batch).mean.item() < 1e-7 < 1e-5 < faster.loss(batch).mean.item()


def test_a_teacher_with_history_has_a_student_with_history(
    tiny: TrainingConfig, recording: Recording, robot: RobotModel, tmp_path: Path
) -> None:
    settings = HistoryConfig(num_frames=2, reference='first_frame')
    teacher = make_teacher(tiny.replace(history=settings), tmp_path)
    same = make(tmp_path / 'same', teacher, tiny, num_steps=2, teacher_steps=2)
    assert same.config.history == settings
    source = make_source(
        [recording], with_batch_size(tiny.replace(history=same.config.history), 2), robot
    )
    assert same.loss(source.batch(0)).mean.item() < 1e-7
    source.close()


def test_learns_and_a_killed_run_continues_as_if_nothing_had_happened(
    teacher: Path, tiny: TrainingConfig, source: BatchSource, tmp_path: Path
) -> None:
    config = tiny.replace(optimizer=tiny.optimizer.replace(steps=12, learning_rate=5e-3))
    whole = make(tmp_path / 'whole', teacher, config, num_steps=1)
    losses = run(whole, source)
    assert sum(losses[-3:]) < 0.8 * sum(losses[:3])
    cut = make(tmp_path / 'cut', teacher, config, num_steps=1)
    reports = cut.run(source, save_every=2, on_save=lambda _: None)
    first = [next(reports).loss, next(reports).loss, next(reports).loss]
    reports.close()
    resumed = make(tmp_path / 'cut', teacher, config, num_steps=1)
    assert resumed.step == 2
    assert first[:2] + run(resumed, source) == losses


def test_command_makes_a_checkpoint_that_says_how_many_steps_it_needs(
    teacher: Path, episode: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / 'out'
    options = ['--steps', '2', '--teacher-steps', '4', '--dtype', 'float32', '--threads', '1']
    command = ['distill', str(teacher), str(episode.parent), '--out', str(out), *options,
               '--set', 'optimizer.steps=2', '--set', 'optimizer.batch_size=1']  # fmt: skip
    assert main(command) == 0
    assert 'for 2 denoising steps' in capsys.readouterr().out
    card = json.loads((out / 'checkpoint' / 'world_model.json').read_text())
    assert card['num_inference_steps'] == 2
    assert card['trained_on']['distilled'] == {'num_steps': 2, 'teacher_steps': 4}
    assert load_pipeline(out / 'checkpoint', dtype='float32').spec.num_inference_steps == 2
    assert main([*command[:5], '--steps', '4', '--threads', '1']) == 1
    assert 'another --out' in capsys.readouterr().err


def test_another_teacher_into_the_same_folder_is_refused(
    teacher: Path, episode: Path, tiny: TrainingConfig, robot: RobotModel, tmp_path: Path
) -> None:
    (tmp_path / 'distillation.json').write_text(
        json.dumps({'num_steps': 4, 'teacher_steps': 32, 'teacher': {'steps': 7}})
    )
    with pytest.raises(TrainingError, match='another distillation: its teacher differ'):
        distill(
            teacher,
            TrainingRun(config=tiny, dataset=episode.parent, out=tmp_path),
            DistillConfig(),
            robot=robot,
            segmenter=ColourSegmenter(),
        )


@pytest.mark.parametrize(
    ('steps', 'teacher_steps', 'message'),
    [(0, 4, '--steps is 0'), (4, 6, '--teacher-steps is 6.*e.g. 32'), (4, 2, 'multiple')],
)
def test_steps_that_do_not_divide_are_refused(
    steps: int, teacher_steps: int, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        DistillConfig(num_steps=steps, teacher_steps=teacher_steps)
