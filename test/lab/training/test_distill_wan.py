"""Distillation of a Wan checkpoint: text, images, guidance and an adapter of the teacher."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from wan_predictions import imported

from mtv_world_ros.assembly import load_pipeline
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.lab.training.distillation import distill, DistillConfig
from mtv_world_ros.lab.training.training_config import load_training_config, TrainingRun
from mtv_world_ros.model.checkpoint import load_checkpoint
from mtv_world_ros.model.lora import add_adapter, save_adapter
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter

SHORT = {'optimizer.steps': 1, 'optimizer.batch_size': 1, 'optimizer.learning_rate': 1e-8}


@pytest.fixture(scope='module')
def teacher(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights in the published layout, with an adapter that matters."""
    folder = imported(tmp_path_factory.mktemp('wan'))
    adapted = load_checkpoint(folder).transformer
    add_adapter(adapted, rank=2)
    with torch.no_grad():
        for name, parameter in adapted.named_parameters():
            if 'lora_B' in name:
                parameter.fill_(0.3)
    save_adapter(adapted, folder / 'adapter')
    return folder


def first_loss(
    teacher: Path, episode: Path, robot: RobotModel, out: Path, **card: object
) -> tuple[float, Path]:
    """Of a student as slow as its teacher, and its checkpoint."""
    file = teacher / 'world_model.json'
    before = json.loads(file.read_text())
    file.write_text(json.dumps({**before, 'fps': 5.0, **card}))
    student = distill(
        teacher,
        TrainingRun(config=load_training_config('small', SHORT), dataset=episode.parent, out=out),
        DistillConfig(num_steps=2, teacher_steps=2),
        robot=robot,
        segmenter=ColourSegmenter(),
    )
    file.write_text(json.dumps(before))
    log = (out / 'log.jsonl').read_text().splitlines()
    return json.loads(log[-1])['loss'], student


def test_the_student_begins_as_the_adapted_teacher_and_learns_its_guidance(
    teacher: Path, episode: Path, robot: RobotModel, tmp_path: Path
) -> None:
    plain, _ = first_loss(teacher, episode, robot, tmp_path / 'plain')
    guided, student = first_loss(
        teacher, episode, robot, tmp_path / 'guided', guidance_scale=5.0, negative_prompt='red'
    )
    assert plain < 1e-5 < 1e-3 < guided
    card = json.loads((student / 'world_model.json').read_text())
    assert 'guidance_scale' not in card and card['prompt'] == 'pick the block'
    assert not (student / 'adapter').exists()
    world_model = load_pipeline(student, dtype='float32', segmenter='colour').world_model
    assert world_model.spec.num_inference_steps == 2
    assert type(world_model.scheduler).__name__ == 'FlowMatchEulerDiscreteScheduler'
    assert world_model.scheduler.config['shift'] == 3.0
