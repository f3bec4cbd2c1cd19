"""The trainer: it learns, resumes to the bit, and stops with the last good state whole."""

from __future__ import annotations

from dataclasses import replace
import json
import re
import sys

import numpy as np
import pytest
import torch

from mtv_world_ros.core.errors import ConfigError, TrainingError
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.training.trainer import learning_rate
from mtv_world_ros.training.training_config import (
    load_training_config,
    OptimizerConfig,
    TrainingRun,
)
from mtv_world_ros.training.training_run import train
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter
from test.support.sources import losses_of, make_source, make_trainer


def test_a_killed_run_continues_as_if_nothing_had_happened(tiny, source, tmp_path):
    whole = make_trainer(tiny, tmp_path / 'whole')
    losses = losses_of(whole, source)
    cut = make_trainer(tiny, tmp_path / 'cut')
    reports = cut.run(source, save_every=2, on_save=lambda _: None)
    first = [next(reports).loss, next(reports).loss, next(reports).loss]
    reports.close()  # the third step is lost: the state is that of the second
    resumed = make_trainer(tiny, tmp_path / 'cut')
    assert resumed.load_state()
    assert resumed.step == 2
    assert first[:2] + losses_of(resumed, source) == losses
    for one, other in zip(whole.weights.parameters, resumed.weights.parameters, strict=True):
        assert torch.equal(one, other)
    for one, other in zip(
        whole.weights.ema.shadow_params, resumed.weights.ema.shadow_params, strict=True
    ):
        assert torch.equal(one, other)


def test_a_compiled_run_learns_as_a_plain_one(tiny, source, tmp_path, monkeypatch):
    """`eager` traces as inductor does, and leaves the minute that g++ takes to the benchmark."""
    compiles, calls = MultiViewWanTransformer.compile_repeated_blocks, []

    def traced(self: MultiViewWanTransformer, **how: object) -> None:
        calls.append(how)
        compiles(self, **how, backend='eager')

    monkeypatch.setenv('CXX', sys.executable)
    monkeypatch.setattr(MultiViewWanTransformer, 'compile_repeated_blocks', traced)
    for checkpointing in (False, True):
        chosen = tiny.optimizer.replace(gradient_checkpointing=checkpointing)
        compiled = tiny.replace(optimizer=chosen.replace(compile=True))
        trainer = make_trainer(compiled, tmp_path / f'compiled{checkpointing}')
        plain = make_trainer(tiny.replace(optimizer=chosen), tmp_path / f'plain{checkpointing}')
        assert losses_of(trainer, source) == pytest.approx(losses_of(plain, source), rel=1e-4)
        trainer.export(tmp_path / f'checkpoint{checkpointing}')
    assert len(calls) == 2


@pytest.mark.gpu
def test_a_killed_run_continues_on_a_gpu(tiny, source, tmp_path):
    config = tiny.replace(optimizer=tiny.optimizer.replace(gradient_checkpointing=True))
    reports = make_trainer(config, tmp_path, device='cuda').run(
        source, save_every=2, on_save=lambda _: None
    )
    first = [next(reports).loss for _ in range(3)]
    reports.close()
    resumed = make_trainer(config, tmp_path, device='cuda')
    assert resumed.load_state() and resumed.step == 2
    assert losses_of(resumed, source)[0] == pytest.approx(first[2], rel=0.01)
    resumed.export(tmp_path / 'checkpoint')
    assert {p.device.type for p in resumed.weights.parameters} == {'cuda'}


def test_a_lack_of_memory_says_what_to_set(tiny, source, tmp_path, monkeypatch):
    def fail(*_: object) -> None:
        raise torch.OutOfMemoryError('CUDA out of memory. Tried to allocate 2.00 GiB.')

    trainer = make_trainer(tiny, tmp_path)
    monkeypatch.setattr(trainer, 'gradients', fail)
    with pytest.raises(TrainingError, match=r'out of memory on cpu: .*accumulation.*2\.00 GiB'):
        losses_of(trainer, source)


@pytest.mark.slow
def test_learns_one_clip(recording, tiny, robot, tmp_path):
    """The loss on the first frames of one episode halves within 60 steps."""
    config = tiny.replace(optimizer=tiny.optimizer.replace(steps=60))
    augment = config.augment.replace(start_noise=0.0, colour_permutation=0.0)
    source = make_source([recording], config.replace(augment=augment), robot)
    trainer = make_trainer(config, tmp_path)
    batch = source.batch(0)
    before = trainer.loss(batch).mean.item()
    for step in range(60):
        trainer.train_step(replace(batch, step=step))
        trainer.step += 1
    source.close()
    assert trainer.loss(batch).mean.item() < 0.5 * before


def test_a_loss_that_is_not_finite_stops_and_leaves_the_last_state(tiny, source, tmp_path):
    trainer = make_trainer(tiny, tmp_path)
    reports = trainer.run(source, save_every=1, on_save=lambda _: None)
    next(reports)
    next(reports)
    with torch.no_grad():
        next(trainer.weights.worker.parameters()).fill_(float('nan'))
    with pytest.raises(TrainingError, match=r'the loss is nan at step 2.*learning_rate'):
        next(reports)
    state = json.loads((tmp_path / 'state' / 'state.json').read_text())
    assert state['step'] == 1 or state['step'] == 2
    resumed = make_trainer(tiny, tmp_path)
    assert resumed.load_state()
    assert all(torch.isfinite(p).all() for p in resumed.weights.parameters)


def test_a_state_of_another_seed_is_refused(tiny, source, tmp_path):
    losses_of(make_trainer(tiny, tmp_path), source)
    with pytest.raises(TrainingError, match='trained with seed 0, this run has 1'):
        make_trainer(tiny, tmp_path, seed=1).load_state()


def test_the_same_step_gives_the_same_batch(source):
    first, again, other = source.batch(3), source.batch(3), source.batch(4)
    assert torch.equal(first.frames, again.frames)
    assert torch.equal(first.start_frame, again.start_frame)
    assert torch.equal(first.inputs.video, again.inputs.video)
    assert not torch.equal(first.frames, other.frames)


def test_the_learning_rate_warms_up_holds_and_falls_to_zero():
    config = OptimizerConfig(learning_rate=1.0, warmup_steps=4, steps=100, decay_share=0.2)
    assert [learning_rate(step, config) for step in (0, 3, 50, 79, 90)] == pytest.approx(
        [0.25, 1.0, 1.0, 1.0, 0.5]
    )
    assert 0 < learning_rate(99, config) <= 0.05


def test_trains_from_a_folder_to_a_checkpoint_that_serves(episode, tiny, robot, tmp_path):
    out = tmp_path / 'run'
    run = TrainingRun(config=tiny, dataset=episode.parent, out=out, save_every=2)
    folder = train(run, robot=robot, segmenter=ColourSegmenter())
    pipeline = Pipeline.load(folder, dtype='float32')
    assert pipeline.spec.num_frames == 2
    assert json.loads((folder / 'world_model.json').read_text())['trained_on']['steps'] == 4
    assert json.loads((out / 'skipped.json').read_text()) == {}
    assert len((out / 'log.jsonl').read_text().splitlines()) == 1


@pytest.mark.parametrize(
    ('override', 'message'),
    [
        ({'optimizer.step': 5}, r"unknown key 'step' \(did you mean 'steps'\?\)"),
        ({'optimiser.steps': 5}, r"unknown key 'optimiser' \(did you mean 'optimizer'\?\)"),
        ({'augment.start_noise_std': 0.1}, "'start_noise_std' is gone: it is 0.04 in every"),
        ({'steps': 5}, 'must look like section.key'),
        ({'rendering.half_life_s': -1.0}, 'half_life_s'),
        ({'sampling.num_inference_steps': 0}, 'num_inference_steps is 0; it must be at least 1'),
    ],
)
def test_a_wrong_setting_names_the_nearest(override, message):
    with pytest.raises(ConfigError, match=message):
        load_training_config('small', override)


@pytest.mark.parametrize(
    ('preset', 'steps'), [('small', 1), ('few_recordings', 1), ('wan-1.3b', 50), ('wan-14b', 50)]
)
def test_a_checkpoint_says_how_many_steps_it_is_made_for(preset, steps):
    assert load_training_config(preset).card({}).num_inference_steps == steps
    changed = load_training_config(preset, {'sampling.num_inference_steps': 7})
    assert changed.spec.num_inference_steps == 7


def test_a_run_may_start_from_the_weights_of_a_checkpoint(tiny, source, tmp_path):
    first = make_trainer(tiny, tmp_path / 'first')
    losses_of(first, source)
    first.export(tmp_path / 'checkpoint', dtype=torch.float32)
    second = make_trainer(tiny, tmp_path / 'second', seed=1)
    second.start_from(Checkpoint.open(tmp_path / 'checkpoint'))
    assert second.step == 0
    for averaged, weight, worker in zip(
        first.weights.ema.shadow_params,
        second.weights.parameters,
        second.weights.worker.parameters(),
        strict=True,
    ):
        assert torch.equal(averaged, weight) and torch.equal(weight, worker)


@pytest.mark.parametrize('name', ['yam_bimanual', 'franka'])
def test_the_object_motion_network_comes_along_to_the_same_robot_alone(
    name, tiny, source, tmp_path, capsys
):
    first = make_trainer(tiny, tmp_path / 'first')
    first.export(tmp_path / 'checkpoint')
    (tmp_path / 'checkpoint' / 'object_motion').mkdir()
    (tmp_path / 'checkpoint' / 'object_motion' / 'config.json').write_text('{}')
    tiny = tiny.replace(rendering=tiny.rendering.replace(object_motion=True))
    second = make_trainer(tiny.replace(video=tiny.video.replace(robot=name)), tmp_path / 'second')
    second.start_from(Checkpoint.open(tmp_path / 'checkpoint'))
    second.export(tmp_path / 'exported')
    is_same = tiny.video.robot == name
    assert (tmp_path / 'exported' / 'object_motion').is_dir() == is_same
    assert ("left out: it is of robot 'yam_bimanual'" in capsys.readouterr().out) != is_same


def test_a_model_that_is_shown_no_foreseen_objects_keeps_no_physics(tiny, source, tmp_path):
    first = make_trainer(tiny, tmp_path / 'first')
    first.export(tmp_path / 'checkpoint')
    (tmp_path / 'checkpoint' / 'object_motion').mkdir()
    second = make_trainer(tiny, tmp_path / 'second')
    assert not tiny.rendering.object_motion
    second.start_from(Checkpoint.open(tmp_path / 'checkpoint'))
    second.export(tmp_path / 'exported')
    assert not (tmp_path / 'exported' / 'object_motion').exists()


def test_weights_of_another_architecture_are_refused(tiny, source, tmp_path):
    first = make_trainer(tiny, tmp_path / 'first')
    first.export(tmp_path / 'checkpoint')
    layers = int(tiny.transformer['num_layers']) + 1
    deeper = tiny.replace(transformer={**tiny.transformer, 'num_layers': layers})
    said = f'num_layers is {layers - 1} there and {layers} here. Give --preset'
    with pytest.raises(TrainingError, match=re.escape(said)):
        make_trainer(deeper, tmp_path / 'second').start_from(
            Checkpoint.open(tmp_path / 'checkpoint')
        )


def test_failed_episodes_are_drawn_as_often_as_asked(recording, tiny, robot):
    failed = replace(recording, outcome='failure', frames=np.zeros_like(recording.frames))
    augment = tiny.augment.replace(start_noise=0.0, failure_share=0.5)
    drawn = tiny.replace(augment=augment, video=tiny.video.replace(object_mask=False))
    source = make_source([recording] * 9 + [failed], drawn, robot)
    black = [not source.batch(step).frames.any() for step in range(60)]
    source.close()
    # 0.5 + 0.5 / 10, three standard deviations of 60 draws
    assert 0.55 - 0.19 < np.mean(black) < 0.55 + 0.19
