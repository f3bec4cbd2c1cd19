"""Checkpoint folders: bit-equal round trip, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

from diffusers import FlowMatchEulerDiscreteScheduler
import numpy as np
import pytest
import torch

from mtv_world_ros.control.control import ControlInputs
from mtv_world_ros.core.errors import CheckpointError, ModelMemoryError, RolloutPreempted
from mtv_world_ros.model.autoencoders import SpaceToDepthAutoencoder
from mtv_world_ros.model.card import CheckpointCard
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.trained_model import load_trained_model, save_trained_model, TrainedModel
from mtv_world_ros.model.world_model import DiffusionWorldModel
from test.support.small_transformer import build, CARD, inputs, SMALL


@pytest.fixture
def folder(tmp_path) -> Path:
    checkpoint = TrainedModel(
        transformer=build(SMALL),
        autoencoder=SpaceToDepthAutoencoder(),
        scheduler=FlowMatchEulerDiscreteScheduler(shift=5.0),
        card=CheckpointCard(**CARD),
    )
    save_trained_model(checkpoint, tmp_path / 'checkpoint')
    return tmp_path / 'checkpoint'


def test_loads_bit_for_bit_what_was_saved(folder):
    loaded = load_trained_model(Checkpoint.open(folder))
    for name, value in build(SMALL).state_dict().items():
        assert torch.equal(loaded.transformer.state_dict()[name], value), name
    torch.testing.assert_close(loaded.transformer(**inputs()), build(SMALL)(**inputs()))
    assert loaded.scheduler.config['shift'] == 5.0
    assert loaded.card.plain() == CARD


def test_leaves_nothing_but_safetensors_and_json(folder):
    assert {path.suffix for path in folder.rglob('*') if path.is_file()} == {
        '.json',
        '.safetensors',
    }
    assert not list(folder.parent.glob('*.partial'))


def test_predicts_frames_of_the_cards_size_from_a_seed(folder):
    model = DiffusionWorldModel(load_trained_model(Checkpoint.open(folder)))
    first, again, other = (predict(model, seed) for seed in (1, 1, 2))
    assert first.shape == (2, 4, 32, 32, 3)
    assert first.dtype == np.uint8
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def predict(model: DiffusionWorldModel, seed: int = 0, should_stop=lambda: False) -> np.ndarray:
    generator = np.random.default_rng(0)
    return model.predict(
        generator.integers(0, 255, (2, 32, 32, 3), np.uint8),
        ControlInputs.drawn(generator.integers(0, 255, (2, 5, 32, 32, 3), np.uint8)),
        seed=seed,
        num_inference_steps=2,
        should_stop=should_stop,
    )


def test_a_preempted_prediction_is_given_up(folder):
    model = DiffusionWorldModel(load_trained_model(Checkpoint.open(folder)))
    with pytest.raises(RolloutPreempted):
        predict(model, should_stop=lambda: True)


@pytest.mark.parametrize(
    'error',
    [
        torch.OutOfMemoryError('CUDA out of memory'),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried 1 TB"),
    ],
)
def test_out_of_memory_is_a_clear_error_and_the_next_call_works(folder, monkeypatch, error):
    model = DiffusionWorldModel(load_trained_model(Checkpoint.open(folder)))

    def fail(*_: object, **__: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(model.transformer, 'forward', fail)
        with pytest.raises(ModelMemoryError, match='out of memory on cpu with 2 views of 5 '):
            predict(model)
    assert predict(model).shape == (2, 4, 32, 32, 3)


def _changed(folder, **values):
    file = folder / 'transformer' / 'config.json'
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


def _cut_off(folder):
    file = folder / 'transformer' / 'diffusion_pytorch_model.safetensors'
    file.write_bytes(file.read_bytes()[:100])


DAMAGES = {
    'is not a checkpoint: it has no world_model.json': lambda f: (f / 'world_model.json').unlink(),
    "has no folder 'scheduler/'": lambda f: (f / 'scheduler').rename(f / 'elsewhere'),
    'holds pickle files': lambda f: (f / 'transformer' / 'x.bin').write_bytes(b'x'),
    'does not fit its config': lambda f: _changed(f, ffn_dim=48),
    'holds a UNet, expected a MultiViewWan': lambda f: _changed(f, _class_name='UNet'),
    'cannot be loaded': _cut_off,
}


@pytest.mark.parametrize('message', DAMAGES)
def test_a_damaged_folder_is_refused_by_what_is_wrong(folder, message):
    DAMAGES[message](folder)
    with pytest.raises(CheckpointError, match=message):
        load_trained_model(Checkpoint.open(folder))


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'num_inference_steps': 0}, 'num_inference_steps is 0; it must be at least 1'),
        ({'fsp': 5.0}, r"unknown key 'fsp' \(did you mean 'fps'\?\)"),
        ({'fps': 'five'}, "'fps' is 'five'"),
        ({'views': None}, "'views' is None"),
    ],
)
def test_a_wrong_card_is_refused(folder, change, message):
    (folder / 'world_model.json').write_text(json.dumps({**CARD, **change}))
    with pytest.raises(CheckpointError, match=message):
        load_trained_model(Checkpoint.open(folder))
