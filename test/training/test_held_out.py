"""Held-out episodes during a training: scored as by evaluation, shown, and the best kept."""

from __future__ import annotations

from argparse import Namespace
import json
from pathlib import Path
import re
import shlex
import shutil

import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.cli.train import _evaluation_advice
from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.recording import motion_digest
from mtv_world_ros.model.card import read_card
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.training.distributed import Processes
from mtv_world_ros.training.training_config import TrainingRun
from mtv_world_ros.training.training_run import HeldOut, HeldOutScores, train
from mtv_world_ros.viewing.video import decode_video
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter
from test.support.launched import torchrun
from test.support.sources import ONE_STEP, set_options, TINY_MODEL

NOT_GIVEN = {'describer': None, 'topics': None, 'calibration': None}


def test_the_best_checkpoint_by_the_judge_is_kept(episode, tiny, robot, tmp_path):
    scores = {1: float('nan'), 2: 0.3, 3: 0.5, 4: 0.4}

    def judge(checkpoint: Path, step: int, _: Processes) -> HeldOutScores:
        assert read_card(checkpoint).trained_on['steps'] == step
        return HeldOutScores(score=scores[step], numbers={'j_moving': scores[step]})

    train(
        TrainingRun(config=tiny, dataset=episode.parent, out=tmp_path),
        robot=robot,
        segmenter=ColourSegmenter(),
        held_out=HeldOut(judge, 1),
    )
    assert json.loads((tmp_path / 'best.json').read_text()) == {'step': 3, 'score': 0.5}
    assert read_card(tmp_path / 'checkpoint-best').trained_on['steps'] == 3
    assert read_card(tmp_path / 'checkpoint').trained_on['steps'] == 4
    rows = [json.loads(line) for line in (tmp_path / 'log.jsonl').open()]
    assert [row['j_moving'] for row in rows if 'j_moving' in row][1:] == [0.3, 0.5, 0.4]


def test_the_card_names_the_episodes_of_a_training_and_of_what_it_began_with(
    episode, tiny, robot, tmp_path
):
    def trained(name: str, **more):
        run = TrainingRun(config=tiny, dataset=(episode,), out=tmp_path / name, **more)
        folder = train(run, robot=robot, segmenter=ColourSegmenter())
        return Checkpoint.open(folder)

    digest = motion_digest(read_episode(episode))
    first = trained('first')
    assert first.trained_episodes.sentence([digest, 'another']) == 'trained on 1 of these 2'
    told = first.card.trained_on | {'digests': ['earlier'], 'digests_complete': True}
    first.card.replace(trained_on=told).write(first.folder)
    second = trained('second', initial=Checkpoint.open(first.folder)).trained_episodes
    assert second.digests == {digest, 'earlier'} and second.is_complete
    first.card.replace(trained_on={'episodes': 1, 'steps': 1}).write(first.folder)
    third = trained('third', initial=Checkpoint.open(first.folder)).trained_episodes
    assert third.digests == {digest} and not third.is_complete


@pytest.mark.slow
def test_the_command_scores_held_out_episodes_as_evaluate_does(episode, tmp_path, capsys):
    data = tmp_path / 'data'
    for name in ('seen', 'unseen'):
        shutil.copytree(episode, data / name)
    (data / 'dataset.json').write_text(
        json.dumps({'splits': {'train': ['seen'], 'test': ['unseen']}})
    )
    out = tmp_path / 'run'
    command = ['train', str(data), '--out', str(out), '--threads', '1', '--dtype', 'float32']
    command += [*ONE_STEP, '--sample-every', '5']
    assert main([*command, '--split', 'all']) == 1
    assert 'would be trained on and held out' in capsys.readouterr().err
    assert main(command) == 0
    folder = out / 'held_out' / '0000001'
    video = decode_video((folder / 'unseen.mp4').read_bytes())
    assert video.shape[1:] == (2 * 40, 3 * 48, 3)  # views below each other
    row = next(r for r in map(json.loads, (out / 'log.jsonl').open()) if 'j_moving' in r)
    scores = tmp_path / 'scores'
    command = ['evaluate', str(out / 'checkpoint'), str(data), '--out', str(scores)]
    command += ['--threads', '1', '--dtype', 'float32', '--no-report', '--no-ceiling']
    assert main([*command, '--actions', 'true']) == 0
    expected = json.loads((scores / 'metrics.json').read_text())
    assert row['j_moving'] == pytest.approx(expected['overall']['j_moving'], abs=1e-4)
    # a copy of an episode is the same episode, whatever the split says
    assert expected['provenance']['training episodes'] == 'trained on 1 of these 1'
    assert row['j_moving_low'] == pytest.approx(expected['views']['low']['j_moving'], abs=1e-4)


@pytest.mark.slow
def test_two_processes_share_the_held_out_episodes(tmp_path):
    data, out, scores = (tmp_path / name for name in ('data', 'run', 'scores'))
    words = ['collect', '--task', 'stack_blocks_two', '--episodes', '8', '--out', str(data)]
    words += ['--width', '96', '--height', '72']
    assert main([*words, '--seed', '0']) == 0
    test = read_json(data / 'dataset.json')['splits']['test']
    assert len(test) == 4
    (damaged,) = (data / test[1]).glob('*.mcap')
    damaged.write_bytes(b'damaged')
    options = ['--threads', '1', '--dtype', 'float32']
    words = ['train', str(data), '--out', str(out), *options, '--sample-every', '1']
    words += ['--peak-tflops', '1', *set_options({**TINY_MODEL, 'optimizer.batch_size': 2})]
    status, _, errors = torchrun(2, [*words, '--set=optimizer.steps=2'])
    assert status == 0, errors
    for step in (1, 2):
        folder = out / 'held_out' / f'{step:07d}'
        videos = sorted(path.stem for path in folder.glob('*.mp4'))
        assert videos == sorted({*test} - {test[1]})
        assert not (folder / 'episodes').exists()
    words = ['evaluate', str(out / 'checkpoint'), str(data), '--out', str(scores), *options]
    status = main([*words, '--no-report', '--no-ceiling', '--actions', 'true'])
    assert status == 1  # one was not scored
    found, expected = (read_json(path / 'metrics.json') for path in (folder, scores))
    assert list(found['failed']) == list(expected['failed']) == [str(data / test[1])]
    others = {'name', 'label', 'provenance', 'seconds_per_chunk', 'seconds_per_episode'}
    for name in expected.keys() - others - {'real_time_factor'}:
        assert found[name] == expected[name], name
    (row,) = (row for row in map(json.loads, (out / 'log.jsonl').open())
              if 'j_moving' in row and row['step'] == 2)  # fmt: skip
    assert row['j_moving'] == pytest.approx(expected['overall']['j_moving'], abs=1e-4)


def test_without_held_out_episodes_the_command_says_what_to_give(episode, tmp_path, capsys):
    command = ['train', str(episode.parent), '--out', str(tmp_path), '--sample-every', '5']
    assert main(command) == 1
    assert 'no split val or test; give --held-out DIR' in capsys.readouterr().err


def test_held_out_episodes_that_are_not_there_are_an_error_before_the_training(
    episode, tmp_path, capsys
):
    missing = tmp_path / 'missing'
    command = ['train', str(episode.parent), '--out', str(tmp_path / 'run')]
    assert main([*command, '--held-out', str(missing), *ONE_STEP]) == 1
    assert f"'{missing}' holds no episodes" in capsys.readouterr().err
    assert not (tmp_path / 'run').exists()


@pytest.mark.parametrize(
    ('card', 'has_episodes', 'says'),
    [
        ({'splits': {'train': ['seen'], 'test': ['gone']}}, True, "'test' of '.*' has no episode"),
        ({}, False, "holds no episodes"),
        ({'splits': 1}, True, "is not a data set card"),
        ({}, True, "it was on 1 of '.*', which tells how well it remembers them"),
    ],
)  # fmt: skip
def test_a_training_ends_with_advice_whatever_became_of_its_data_set(
    card, has_episodes, says, episode, tmp_path
):
    data = tmp_path / 'data'
    data.mkdir()
    if has_episodes:
        (data / 'seen').symlink_to(episode)
    (data / 'dataset.json').write_text(json.dumps(card))
    given = Namespace(
        dataset=data,
        held_out=None,
        segmenter='auto',
        describer=None,
        topics=None,
        calibration=None,
    )
    line, why = _evaluation_advice(given, ['run/checkpoint'], [data / 'seen'], Path('out'))
    assert line == 'evaluate it with: mtv-world evaluate run/checkpoint EPISODES --out out'
    assert why.startswith('(EPISODES: a folder of episodes that it was not trained on; ')
    assert re.search(says, why)


def test_a_training_ends_with_its_held_out_episodes_where_there_are_some(episode, tmp_path):
    data = tmp_path / 'data'
    data.mkdir()
    (data / 'unseen').symlink_to(episode)
    given = Namespace(
        dataset=None,
        held_out=data,
        segmenter='sam2',
        describer=None,
        topics=None,
        calibration=None,
    )
    lines = _evaluation_advice(given, ['base', '--adapter', 'run'], [], Path('out'))
    words = ['evaluate', 'base', str(data), '--adapter', 'run', '--out', 'out']
    assert lines == [f'evaluate it with: mtv-world {shlex.join(words)} --segmenter sam2']


def test_a_negative_interval_is_refused():
    with pytest.raises(ConfigError, match='--sample-every is -1'):
        HeldOut(lambda folder, step, processes: HeldOutScores(score=0.0, numbers={}), -1)
