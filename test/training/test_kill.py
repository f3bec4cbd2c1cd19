"""A training that is killed again and again ends as the undisturbed one."""

from __future__ import annotations

import json
import shutil

import pytest
from safetensors.torch import load_file
import torch

from test.support.sources import make_trainer, run_script, state_tensors, write_preset


@pytest.mark.slow
def test_kill_9_changes_neither_curve_nor_weights(tiny, episode, tmp_path):
    preset = write_preset(tmp_path, tiny, steps=40)
    run_script('train_killed.py', tmp_path, episode.parent, preset)
    kills = json.loads((tmp_path / 'kills.json').read_text())
    assert len(kills) >= 3 and any('.state.mtv-new-' in place for place in kills), kills
    curves, tensors = [], []
    for name in ('whole', 'killed'):
        rows = [json.loads(line) for line in (tmp_path / name / 'log.jsonl').open()]
        curves.append([(row['step'], row['loss'], row['grad_norm']) for row in rows])
        weights = tmp_path / name / 'checkpoint' / 'transformer'
        tensors.append(state_tensors(tmp_path / name))
        tensors[-1] |= load_file(weights / 'diffusion_pytorch_model.safetensors')
    assert curves[0] == curves[1]
    assert [step for step, *_ in curves[0]] == [10, 20, 30, 40]
    assert all(torch.equal(tensors[0][name], tensors[1][name]) for name in tensors[0])


def test_a_kill_between_the_two_renames_of_an_earlier_version_leaves_the_old_state(tiny, tmp_path):
    first = make_trainer(tiny, tmp_path)
    first.step = 7
    first.save_state()
    (tmp_path / 'state').rename(tmp_path / 'state.old')
    shutil.copytree(tmp_path / 'state.old', tmp_path / 'state.partial')
    resumed = make_trainer(tiny, tmp_path)
    assert resumed.load_state() and resumed.step == 7
    resumed.save_state()
    assert sorted(path.name for path in tmp_path.iterdir()) == ['state']
