"""`mtv-world train --preset wan-1.3b --init BASE`, at tiny width: learns, resumes, serves."""

from __future__ import annotations

from dataclasses import replace
import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file
import torch

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.cli import main
from mtv_world_ros.control.control import ControlInputs, ControlScene
from mtv_world_ros.core.errors import CheckpointError, TrainingError
from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.lora import BESIDE_FILE
from mtv_world_ros.model.trained_model import load_trained_model
from mtv_world_ros.model.world_model import DiffusionWorldModel
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.training.base_checkpoint import load_base
from mtv_world_ros.training.trainer import Trainer
from mtv_world_ros.training.training_config import (
    load_training_config,
    TrainingConfig,
    TrainingRun,
)
from mtv_world_ros.training.training_run import train
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter
from test.support.sources import losses_of, make_source, make_trainer
from test.support.wan_base import make_base, tiny_preset

CPU = torch.device('cpu')


@pytest.fixture(scope='module')
def preset(tmp_path_factory) -> Path:
    return tiny_preset(tmp_path_factory.mktemp('preset'))


@pytest.fixture(scope='module')
def config(preset) -> TrainingConfig:
    return load_training_config(preset)


@pytest.fixture(scope='module')
def base(tmp_path_factory, config) -> Path:
    return make_base(tmp_path_factory.mktemp('wan'), config)


@pytest.fixture(scope='module')
def clips(episode, config, robot) -> Recording:
    return load_recording(episode, config.spec, robot)


@pytest.fixture
def batches(clips, config, robot):
    source = make_source([clips], config, robot)
    yield source
    source.close()


def make(config: TrainingConfig, folder: Path, base: Path, device: str = 'cpu') -> Trainer:
    dtype = torch.float32 if device == 'cpu' else torch.bfloat16
    loaded = load_base(config, Checkpoint.open(base), torch.device(device), dtype, seed=0)
    return make_trainer(config, folder, device=device, base=loaded)


def predict(model: DiffusionWorldModel, clip: np.ndarray) -> np.ndarray:
    return model.predict(
        clip[:, 0],
        ControlInputs.drawn(clip),
        seed=0,
        num_inference_steps=2,
        should_stop=lambda: False,
    )


@pytest.mark.slow
def test_the_command_trains_an_adapter_that_changes_the_prediction(
    preset, base, episode, clips, tmp_path, capsys
):
    command = ['train', str(episode.parent), '--preset', str(preset), '--init', str(base)]
    options = ['--dtype', 'float32', '--threads', '1', '--set', 'optimizer.steps=2']
    assert main([*command, '--out', str(tmp_path), *options]) == 0
    adapter = tmp_path / 'adapter'
    assert f'adapter for {base}: {adapter}' in capsys.readouterr().out
    assert not (tmp_path / 'checkpoint').exists()
    card = json.loads((adapter / 'world_model.json').read_text())
    assert card['trained_on']['steps'] == 2 and card['prompt'] == 'pick the block'
    model = DiffusionWorldModel(load_trained_model(Checkpoint.open(base)))
    plain = predict(model, clips.frames[:, :5])
    model.use_adapter(adapter)
    assert np.abs(predict(model, clips.frames[:, :5]).astype(int) - plain).max() > 0
    model.use_adapter(None)
    np.testing.assert_array_equal(predict(model, clips.frames[:, :5]), plain)


@pytest.mark.slow
@pytest.mark.parametrize('control', ['ee_mlp', 'fast_tokens'])
def test_an_adapter_brings_its_own_control(preset, base, episode, clips, robot, tmp_path, control):
    """A base of the paper's control is trained and served with a baseline's."""
    command = ['train', str(episode.parent), '--preset', str(preset), '--init', str(base)]
    options = ['--dtype', 'float32', '--threads', '1', '--set', f'video.control={control}']
    steps = ['--set', 'optimizer.steps=1', '--set', 'transformer.frames_per_token=4']
    assert main([*command, '--out', str(tmp_path), *options, *steps]) == 0
    adapter = tmp_path / 'adapter'
    assert (adapter / 'control.json').is_file()
    assert any(name.startswith('control_tokens') for name in load_file(adapter / BESIDE_FILE))
    pipeline = Pipeline.load(base, adapter=adapter, dtype='float32', num_threads=1)
    assert pipeline.control.layout.names == ('frame' if control == 'ee_mlp' else 'context',)
    frames = []
    for shift in (0.0, 0.05):
        positions = np.linspace(clips.positions[0], clips.positions[0] + shift, 5)
        motion = Motion.of(robot, clips.cameras, positions)
        start = clips.frames[:, 0]
        scene = ControlScene(motion=motion, times=np.arange(5) / 5, start_frames=start)
        inputs = pipeline.control.make(scene)
        assert inputs.video is None
        frames.append(
            pipeline.world_model.predict(
                clips.frames[:, 0],
                inputs,
                positions=positions,
                seed=0,
                num_inference_steps=1,
                should_stop=lambda: False,
            )
        )
    assert not np.array_equal(*frames)
    plain = Pipeline.load(base, dtype='float32', num_threads=1)
    with pytest.raises(CheckpointError, match=f"'control' {control}"):
        plain.world_model.use_adapter(adapter)


@pytest.mark.slow
def test_the_loss_falls_and_the_frozen_weights_stay(config, base, batches, tmp_path):
    """On one batch with the same noise; the base's weights are those of its files."""
    still = config.augment.replace(control_dropout=0, reference_dropout=0, image_dropout=0)
    steady = config.objective.replace(sigma_weighting='uniform')
    trainer = make(config.replace(augment=still, objective=steady), tmp_path, base)
    batch = batches.batch(0)
    before = trainer.loss(batch).mean.item()
    for _ in range(25):
        trainer.train_step(batch)
    assert trainer.loss(batch).mean.item() < 0.8 * before
    held = load_file(base / 'transformer' / 'diffusion_pytorch_model.safetensors')
    named = dict(trainer.weights.worker.named_parameters())
    frozen = {n.replace('.base_layer', ''): p for n, p in named.items() if not p.requires_grad}
    assert len(frozen) > 50
    for name, parameter in frozen.items():
        assert torch.equal(parameter, held[name]), name
    moved = {n for n, p in named.items() if p.requires_grad and '.lora_' not in n}
    beside = {'ref_conv.weight', 'ref_conv.bias', 'patch_embedding.weight', 'view_embedding'}
    assert moved == beside | {'patch_embedding.bias'}
    for name in moved:
        assert not torch.equal(named[name], held[name]), name


def test_only_what_is_trained_takes_memory_for_training(config, base, tmp_path):
    trainer = make(config, tmp_path, base)
    trained = [p for p in trainer.weights.worker.parameters() if p.requires_grad]
    shapes = [p.shape for p in trained]
    assert [p.shape for p in trainer.weights.parameters] == shapes
    assert [p.shape for p in trainer.weights.ema.shadow_params] == shapes
    assert [p.shape for g in trainer.optimizer.param_groups for p in g['params']] == shapes


def test_a_killed_run_continues_to_the_bit_and_exports_the_averages(
    config, base, batches, tmp_path
):
    whole = make(config, tmp_path / 'whole', base)
    losses = losses_of(whole, batches)
    cut = make(config, tmp_path / 'cut', base)
    reports = cut.run(batches, save_every=2, on_save=lambda _: None)
    first = [next(reports).loss, next(reports).loss, next(reports).loss]
    reports.close()  # the third step is lost: the state is that of the second
    resumed = make(config, tmp_path / 'cut', base)
    assert resumed.load_state() and resumed.step == 2
    assert first[:2] + losses_of(resumed, batches) == losses
    for trainer in (whole, resumed):
        trainer.export(trainer.result)
    stored, again = (
        load_file(t.result / 'pytorch_lora_weights.safetensors') for t in (whole, resumed)
    )
    assert stored.keys() == again.keys()
    assert all(torch.equal(stored[name], again[name]) for name in stored)
    averages = whole.weights.averages()
    key = 'blocks.0.attn1.to_q.lora_B'
    assert torch.equal(stored[f'{key}.weight'], averages[f'{key}.adapter.weight'])
    beside = load_file(whole.result / 'beside.safetensors')
    assert torch.equal(beside['view_embedding'], averages['view_embedding'])


@pytest.mark.gpu
def test_an_adapter_trains_and_continues_on_a_gpu(config, base, batches, tmp_path):
    reports = make(config, tmp_path, base, 'cuda').run(
        batches, save_every=2, on_save=lambda _: None
    )
    first = [next(reports).loss for _ in range(3)]
    reports.close()
    resumed = make(config, tmp_path, base, 'cuda')
    assert resumed.load_state() and resumed.step == 2
    assert losses_of(resumed, batches)[0] == pytest.approx(first[2], rel=0.01)
    resumed.export(resumed.result)
    assert load_file(resumed.result / 'pytorch_lora_weights.safetensors')


def test_a_state_on_top_of_other_weights_is_refused(config, base, tmp_path):
    make(config, tmp_path, base).save_state()
    other = load_base(config, Checkpoint.open(base), CPU, torch.float32, seed=0)
    changed = replace(other, digest='of other weights')
    trainer = make(config, tmp_path, base)
    trainer.base = changed
    with pytest.raises(TrainingError, match='on top of other weights than those of --init'):
        trainer.load_state()


def test_an_adapter_of_another_clock_is_refused_when_it_is_loaded(config, base, tmp_path):
    trainer = make(config, tmp_path, base)
    trainer.export(trainer.result)
    checkpoint = load_trained_model(Checkpoint.open(base))
    slower = replace(checkpoint, card=checkpoint.card.replace(fps=2.5))
    model = DiffusionWorldModel(slower)
    with pytest.raises(CheckpointError, match=r"'fps' 5.0, this checkpoint's is 2.5"):
        model.use_adapter(trainer.result)


@pytest.mark.parametrize(
    ('section', 'changes', 'message'),
    [
        ('video', {'fps': 2.5}, r'says fps 5.0 in .*, the preset 2.5; set video.fps'),
        ('rendering', {'half_life_s': 0.9}, 'set rendering to the same'),
        ('transformer', {'num_layers': 3}, 'has num_layers 2, the preset 3; give --preset'),
    ],
)
def test_a_base_of_another_kind_is_refused(config, base, section, changes, message):
    held = getattr(config, section)
    other = {**held, **changes} if isinstance(held, dict) else held.replace(**changes)
    with pytest.raises(TrainingError, match=message):
        load_base(
            config.replace(**{section: other}), Checkpoint.open(base), CPU, torch.float32, seed=0
        )


def test_without_a_base_the_command_to_make_one_is_named(config, episode, robot, tmp_path):
    with pytest.raises(TrainingError, match=r'--init FOLDER.*import wan'):
        train(
            TrainingRun(config=config, dataset=episode.parent, out=tmp_path),
            robot=robot,
            segmenter=ColourSegmenter(),
        )


def test_the_presets_are_the_papers_setting():
    """Implementation Details: rank 32, 1e-4, batch 8, 8 epochs, 2 views, 81 frames, 288 x 384."""
    for name in ('wan-1.3b', 'wan-14b'):
        config = load_training_config(name)
        optimizer, video = config.optimizer, config.video
        assert (config.lora.rank, config.lora.alpha) == (32, 32)
        assert (optimizer.learning_rate, optimizer.batch_size, optimizer.epochs) == (1e-4, 8, 8)
        assert (len(video.views), 1 + video.num_frames) == (2, 81)
        assert (video.height, video.width) == (288, 384)
        assert config.with_steps(100).optimizer.steps == 100
        assert config.with_steps(101).optimizer.steps == 101
