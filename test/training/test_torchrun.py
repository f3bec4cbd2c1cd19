"""The command line of `torchrun`: one model of several processes."""

from __future__ import annotations

import os
import shlex

import pytest

from mtv_world_ros.core.writer_lock import only_writer
from mtv_world_ros.model.card import read_card
from mtv_world_ros.training.training_config import load_training_config
from test.support.launched import torchrun
from test.support.sources import set_options, TINY_MODEL
from test.support.wan_base import make_base, tiny_preset

#: options of a model that is trained in seconds, without the measurement of the machine's peak
TINY = [*set_options({**TINY_MODEL, 'optimizer.batch_size': 2}), '--peak-tflops', '1']


@pytest.mark.slow
def test_two_processes_train_a_model_and_end_well(episode, tmp_path):
    out = tmp_path / 'out'
    words = ['train', str(episode), '--out', str(out), *TINY, '--set', 'optimizer.steps=2']
    status, said, errors = torchrun(2, words)
    assert status == 0, errors
    assert said.count('checkpoint: ') == said.count('evaluate it with: ') == 1
    assert read_card(out / 'checkpoint').trained_on['steps'] == 2


@pytest.mark.slow
def test_two_processes_train_an_adapter_and_end_well(episode, tmp_path):
    preset = tiny_preset(tmp_path)
    base, out = make_base(tmp_path, load_training_config(preset)), tmp_path / 'out'
    words = ['train', str(episode), '--out', str(out), '--preset', str(preset)]
    words += ['--init', str(base), '--latent-cache', str(tmp_path / 'latents')]
    status, said, errors = torchrun(2, [*words, '--peak-tflops', '1', '--dtype', 'float32'])
    assert status == 0, errors
    assert said.count('adapter for ') == 1
    assert shlex.quote(str(out / 'adapter')) in said
    assert read_card(out / 'adapter').trained_on['steps'] == 4
    shards = sorted(file.name for file in (tmp_path / 'latents').rglob('*.safetensors'))
    assert shards == ['latents-000-00000.safetensors', 'latents-001-00000.safetensors']
    assert 'encoded by 2 processes' in said + errors


@pytest.mark.slow
def test_a_dry_run_is_printed_once():
    status, said, errors = torchrun(2, ['train', '--dry-run', *TINY])
    assert status == 0, errors
    assert said.count('per step, the transformer alone:') == 1


@pytest.mark.slow
def test_a_second_run_into_a_folder_that_is_written_is_told_at_once(episode, tmp_path):
    with only_writer(tmp_path / 'out'):
        status, said, errors = torchrun(2, ['train', str(episode), '--out', str(tmp_path / 'out')])
    assert status == 1
    assert f"'{tmp_path / 'out'}' is being written by process {os.getpid()}" in errors
    assert not (tmp_path / 'out').exists() and 'checkpoint: ' not in said
