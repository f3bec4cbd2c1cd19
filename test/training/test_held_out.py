"""Held-out episodes during a training: scored as by evaluation, shown, and the best kept."""

from __future__ import annotations

import json
from pathlib import Path
import shutil

import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.model.card import read_card
from mtv_world_ros.training.training_config import TrainingRun
from mtv_world_ros.training.training_run import HeldOut, HeldOutScores, train
from mtv_world_ros.viewing.video import decode_video
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter
from test.support.sources import ONE_STEP


def test_the_best_checkpoint_by_the_judge_is_kept(episode, tiny, robot, tmp_path):
    scores = {1: float('nan'), 2: 0.3, 3: 0.5, 4: 0.4}

    def judge(checkpoint: Path, step: int) -> HeldOutScores:
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
    assert row['j_moving_low'] == pytest.approx(expected['views']['low']['j_moving'], abs=1e-4)


def test_without_held_out_episodes_the_command_says_what_to_give(episode, tmp_path, capsys):
    command = ['train', str(episode.parent), '--out', str(tmp_path), '--sample-every', '5']
    assert main(command) == 1
    assert 'no split val or test; give --held-out DIR' in capsys.readouterr().err


def test_a_negative_interval_is_refused():
    with pytest.raises(ConfigError, match='--sample-every is -1'):
        HeldOut(lambda folder, step: HeldOutScores(score=0.0, numbers={}), -1)
