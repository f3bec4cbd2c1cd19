"""Several processes make the steps that one makes."""

from __future__ import annotations

from datetime import timedelta
import json
from pathlib import Path
import runpy
import sys

import pytest
from safetensors.torch import load_file
import torch

from mtv_world_ros.core.errors import TrainingError
from mtv_world_ros.training.distributed import Processes
from mtv_world_ros.training.trainer import Trainer
from mtv_world_ros.training.training_config import TrainingConfig
from test.support.sources import (
    make_source,
    make_trainer,
    run_script,
    state_tensors,
    with_batch_size,
    write_preset,
)

SCRIPT = Path(__file__).parents[1] / 'support' / 'train_recorded.py'
#: of two processes one gets two of the clips of a step
THREE_CLIPS = {'batch_size': 3, 'max_grad_norm': 1e6}


@pytest.mark.slow
def test_two_processes_make_the_steps_of_one(tiny, episode, tmp_path, monkeypatch):
    arguments = [episode.parent, write_preset(tmp_path, tiny, steps=3, **THREE_CLIPS)]
    two, one = tmp_path / 'two', tmp_path / 'one'
    launcher = ['-m', 'torch.distributed.run', '--standalone', '--nproc-per-node', '2']
    run_script(SCRIPT.name, two, *arguments, launcher=launcher)
    computed = Trainer.gradients
    monkeypatch.setattr(sys, 'argv', [str(part) for part in (SCRIPT, one, *arguments)])
    try:
        runpy.run_path(str(SCRIPT), run_name='__main__')
    finally:
        Trainer.gradients = computed
    whole = load_file(one / 'first-0.safetensors')
    parts = [load_file(two / f'first-{number}.safetensors') for number in (0, 1)]
    assert sorted(len(part['frames']) for part in parts) == [1, 2]
    for name, expected in whole.items():
        if not name.startswith('gradient.'):  # the clips, to the byte
            assert torch.equal(torch.cat([part[name] for part in parts]), expected)
            continue
        assert torch.equal(parts[0][name], parts[1][name])
        torch.testing.assert_close(parts[0][name], expected, rtol=1e-4, atol=1e-6)
    states = [state_tensors(folder) for folder in (one, two)]
    assert states[0].keys() == states[1].keys()
    for name, expected in states[0].items():
        torch.testing.assert_close(states[1][name], expected, rtol=1e-3, atol=1e-5)
    logs = [json.loads((f / 'log.jsonl').read_text().splitlines()[-1]) for f in (one, two)]
    assert logs[0]['loss'] == pytest.approx(logs[1]['loss'], abs=2e-6)
    assert len((two / 'log.jsonl').read_text().splitlines()) == 1  # one process writes


def test_accumulated_parts_have_the_gradients_of_the_whole(tiny, recording, robot, tmp_path):
    source = make_source([recording], with_batch_size(tiny, 3), robot)
    batch = source.batch(0)
    source.close()
    whole = gradients(tiny, batch, tmp_path)
    settings = tiny.optimizer.replace(batch_size=3, accumulation=2)
    parts = gradients(tiny.replace(optimizer=settings), batch, tmp_path)
    again = gradients(
        tiny.replace(optimizer=settings.replace(gradient_checkpointing=True)), batch, tmp_path
    )
    for name, expected in whole.items():
        torch.testing.assert_close(parts[name], expected, rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(again[name], parts[name])


def gradients(config: TrainingConfig, batch, folder: Path) -> dict[str, torch.Tensor]:
    trainer = make_trainer(config, folder)
    trainer.gradients(batch)
    return {n: p.grad for n, p in trainer.weights.master.items() if p.grad is not None}


def test_shares_are_even_and_leave_nothing_out():
    processes = Processes('cpu')
    shares = []
    for number in range(3):
        processes.number, processes.count = number, 3
        shares.append(list(processes.share(8)))
    assert sum(shares, []) == list(range(8))
    assert sorted(map(len, shares)) == [2, 3, 3]


def test_processes_wait_for_the_main_one_longer_than_nccl_does(monkeypatch):
    given = {}
    monkeypatch.setattr(
        'torch.distributed.init_process_group', lambda name, **more: given.update(more, name=name)
    )
    monkeypatch.setenv('WORLD_SIZE', '3')
    monkeypatch.setenv('RANK', '2')
    found = Processes('cpu')
    assert (found.number, found.count, given['name']) == (2, 3, 'gloo')
    assert given['timeout'] > 10 * timedelta(minutes=10)


def test_a_process_that_sees_other_files_is_named(monkeypatch):
    def gather(found: list[str], mine: str) -> None:
        found[:] = [mine, mine, 'others']

    processes = Processes('cpu')
    processes.count = 3
    monkeypatch.setattr('torch.distributed.all_gather_object', gather)
    with pytest.raises(TrainingError, match='the episodes of process 2 differ from those of pro'):
        processes.check_same('the episodes', 'mine')


def test_fewer_clips_than_processes_are_refused(tiny, tmp_path):
    processes = Processes('cpu')
    processes.count = 2
    with pytest.raises(TrainingError, match=r'batch_size is 1, less than 2 processes'):
        make_trainer(tiny, tmp_path, processes=processes)


@pytest.mark.slow
def test_a_process_whose_sister_was_killed_says_so_and_the_state_is_whole(tiny, episode, tmp_path):
    preset = write_preset(tmp_path, tiny, steps=10**6, **THREE_CLIPS)
    run_script('train_lost.py', tmp_path, episode.parent, preset)
    said = (tmp_path / 'said').read_text()
    assert said.startswith('TrainingError: process 0 of 2 lost process 1: ')
    assert 'run the same command again' in said
    state = json.loads((tmp_path / 'state' / 'state.json').read_text())
    assert state['step'] > 0 and state['step'] % 5 == 0
    assert state_tensors(tmp_path)
