"""A training that loses a process goes on with another number of processes."""

from __future__ import annotations

import json
import os
from pathlib import Path
import signal
import time

import pytest
from safetensors.torch import load_file, save_file
import torch

from mtv_world_ros.core.errors import TrainingError
from mtv_world_ros.training.training_config import load_training_config
from test.support.launched import rank_pid, start_torchrun, torchrun
from test.support.sources import (
    losses_of,
    make_trainer,
    set_options,
    state_tensors,
    TINY_MODEL,
)

STEPS = 12
#: trainings until one is killed in its middle, which a busy machine may come too late for
MOST_TRIES = 3
VALUES = {**TINY_MODEL, 'optimizer.batch_size': 5, 'optimizer.steps': STEPS}
SHARDED = ['--set=optimizer.fully_shard=true']


def words_of(episode: Path, out: Path) -> list[str]:
    words = ['train', str(episode), '--out', str(out), '--save-every', '2', '--threads', '1']
    return [*words, '--peak-tflops', '1', '--dtype', 'float32', *set_options(VALUES)]


@pytest.fixture(scope='module')
def whole(episode, tmp_path_factory) -> Path:
    """The training of one process that nothing disturbs."""
    out = tmp_path_factory.mktemp('whole') / 'out'
    status, _, errors = torchrun(1, words_of(episode, out))
    assert status == 0, errors
    return out


def step_of(out: Path) -> int:
    try:
        return json.loads((out / 'state' / 'state.json').read_text())['step']
    except FileNotFoundError:
        return 0


def kill_second(out: Path, words: list[str]) -> tuple[int, str]:
    """Kill the second of two processes after two steps; return status and stderr."""
    end_s = time.monotonic() + 600
    with start_torchrun(2, words) as launcher:
        while step_of(out) < 2:
            assert launcher.poll() is None and time.monotonic() < end_s
            time.sleep(0.01)
        if step_of(out) < STEPS:
            os.kill(rank_pid(launcher.pid, 1), signal.SIGKILL)
        _, errors = launcher.communicate(timeout=600)
    return launcher.returncode, errors


@pytest.mark.slow
@pytest.mark.parametrize(
    ('first', 'then', 'count'), [([], [], 4), (SHARDED, SHARDED, 3), (SHARDED, [], 1)]
)
def test_a_killed_process_is_named_and_another_count_goes_on(
    episode, whole, tmp_path, first, then, count
):
    out, status, errors = tmp_path, 0, ''
    for number in range(MOST_TRIES):
        out = tmp_path / f'out_{number}'
        status, errors = kill_second(out, [*words_of(episode, out), *first])
        if step_of(out) < STEPS:  # else the training was over before it was killed
            break
    assert status != 0
    assert 'rank      : 1' in errors and 'lost process 1' in errors, errors
    assert 2 <= step_of(out) < STEPS
    status, said, errors = torchrun(count, [*words_of(episode, out), *then])
    assert status == 0, errors
    assert f'{count} processes' in said + errors and 'resumed at step' in said + errors
    expected, found = state_tensors(whole), state_tensors(out) if not then else {}
    for name, tensor in found.items():
        torch.testing.assert_close(tensor, expected[name], rtol=1e-3, atol=2e-5)
    weights = 'checkpoint/transformer/diffusion_pytorch_model.safetensors'
    expected = load_file(whole / weights)
    for name, tensor in load_file(out / weights).items():
        torch.testing.assert_close(tensor, expected[name], rtol=1e-3, atol=2e-4)
    losses = [
        [json.loads(row)['loss'] for row in (folder / 'log.jsonl').open()]
        for folder in (whole, out)
    ]
    assert losses[1] == pytest.approx(losses[0], abs=5e-6)


@pytest.mark.slow
def test_more_processes_than_clips_are_refused_before_the_work(episode, tmp_path):
    words = [*words_of(episode, tmp_path / 'out'), '--set=optimizer.batch_size=1']
    status, _, errors = torchrun(2, words)
    assert status != 0
    assert 'optimizer.batch_size is 1, less than 2 processes' in errors
    assert not (tmp_path / 'out').exists()


def test_a_state_in_one_file_of_an_earlier_version_is_read(tiny, source, tmp_path):
    trainer = make_trainer(tiny, tmp_path)
    reports = trainer.run(source, save_every=2, on_save=lambda _: None)
    for _ in range(3):
        next(reports)
    reports.close()
    (mine,) = (tmp_path / 'state').glob('*.safetensors')
    tensors = load_file(mine)
    mine.unlink()
    save_file(tensors, tmp_path / 'state' / 'state.safetensors')
    resumed = make_trainer(tiny, tmp_path)
    assert resumed.load_state() and resumed.step == 2
    assert resumed.weights.ema.optimization_step == 2
    assert all(
        torch.equal(tensors[f'ema.{i}'], p)
        for i, p in enumerate(resumed.weights.ema.shadow_params)
    )
    assert len(losses_of(resumed, source)) == tiny.optimizer.steps - 2


def test_a_state_that_lacks_a_file_of_a_process_is_damaged(tiny, tmp_path):
    make_trainer(tiny, tmp_path).save_state()
    (mine,) = (tmp_path / 'state').glob('*.safetensors')
    tensors = load_file(mine)
    save_file(dict(list(tensors.items())[1:]), mine)
    with pytest.raises(TrainingError, match='is damaged or of another model: .*Missing key'):
        make_trainer(tiny, tmp_path).load_state()


def test_one_process_shares_nothing_out(tiny, tmp_path):
    shared = tiny.replace(optimizer=tiny.optimizer.replace(fully_shard=True))
    with pytest.raises(TrainingError, match='fully_shard shares weights out over several'):
        make_trainer(shared, tmp_path)


def test_weights_that_are_shared_out_imagine_no_clips():
    values = {'optimizer.fully_shard': True, 'self_rollout.share': 0.5}
    with pytest.raises(Exception, match=r'fully_shard is true and self_rollout.share 0\.5'):
        load_training_config('small', values)
