"""What `mtv-world fit success` ends with where an episode cannot be scored."""

import json
import shutil

import pytest
import torch

from mtv_world_ros.cli import main
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_reader import list_episodes, read_episode
from mtv_world_ros.evaluation.evaluate_episodes import make_jobs

DEMO = share_path('resource', 'demo_episode')


def copy(path, outcome):
    """A copy of the bundled episode, a success, with another outcome of as many letters."""
    shutil.copytree(DEMO, path)
    for file in (next(path.glob('*.mcap')), path / 'metadata.yaml'):
        text = file.read_bytes()
        for said in (b'outcome: ', b'outcome\7\0\0\0'):
            text = text.replace(said + b'success', said + outcome.encode())
        file.write_bytes(text)
    assert read_episode(path).info.outcome == outcome


@pytest.fixture
def same_threads():
    """torch has as many afterwards."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.slow
@pytest.mark.usefixtures('same_threads')
def test_an_episode_that_fails_is_named_and_in_the_exit_status(tmp_path, capsys):
    """First where too few others are left for a fit, then, as the run goes on, beside a fit."""
    data, out = tmp_path / 'data', tmp_path / 'out'
    copy(data / 'good0', 'success')
    garbage = shutil.copytree(DEMO, data / 'garbage')
    next(garbage.glob('*.mcap')).write_bytes(b'no recording at all')
    command = ['fit', 'success', 'bundled', str(data), '--out', str(out), '--no-store']
    command += ['--steps', '1', '--threads', '1', '--segmenter', 'colour']
    assert main(command) == 1
    first, last = (line for line in capsys.readouterr().err.splitlines() if 'mtv-world: ' in line)
    assert f'{garbage} was not scored: ' in first
    assert '1 episodes have a known outcome' in last
    # copies of an episode have its result, as if this run had imagined them before
    results = out / 'seed_0' / 'episodes'
    outcomes = {f'good{number}': ('success', 'failure')[number % 2] for number in range(1, 8)}
    for name, outcome in outcomes.items():
        copy(data / name, outcome)
    for job in make_jobs(list_episodes(data), {}, seed=0):
        stored = json.loads((results / 'good0.json').read_text())
        stored['settings'] |= {'path': str(job.path), 'donor': str(job.donors[0])}
        if job.name in outcomes:
            stored['result'] |= {'episode': job.name, 'outcome': outcomes[job.name]}
            shutil.copy(results / 'good0.rollout.npz', results / f'{job.name}.rollout.npz')
        if job.path != garbage:
            (results / f'{job.name}.json').write_text(json.dumps(stored))
    assert main(command) == 1
    said = capsys.readouterr()
    assert said.err.count(f'mtv-world: {garbage} was not scored: ') == 1
    assert '8 imagined episodes of 1 tasks' in said.out
    scores = json.loads((out / 'calibration.json').read_text())['scores']['before']
    assert scores['num_outcomes_known'] == 8 and scores['real_success_rate'] == 0.5
