"""The documented Wan recipe in miniature, by commands only: import, train, evaluate, node."""

from __future__ import annotations

import json
from pathlib import Path
import shlex
import shutil

import pytest
import torch

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.model.card import check_same_model, HistorySettings, read_card
from mtv_world_ros.training.training_config import load_training_config
from test.support.wan_base import tiny_preset
from test.support.wan_files import write_videox

SMALL = ['--dtype', 'float32', '--threads', '1']


def printed(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What a command prints that has to succeed."""
    capsys.readouterr()
    assert main(words) == 0, capsys.readouterr().err
    return capsys.readouterr().out


@pytest.fixture(scope='module')
def recipe(tmp_path_factory, episode) -> dict[str, Path]:
    """Folders of the imported checkpoint and of the adapter, and what the commands printed."""
    from contextlib import redirect_stdout
    from io import StringIO

    folder = tmp_path_factory.mktemp('recipe')
    preset, said = tiny_preset(folder), StringIO()
    public = write_videox(folder / 'public', dtype=torch.float32)
    with redirect_stdout(said):
        imported = ['import', 'wan', str(public), '--preset', str(preset)]
        assert main([*imported, '--out', str(folder / 'base')]) == 0
        # the command that it prints, with the data set and the folder filled in
        words = shlex.split(said.getvalue().partition('train it with: ')[2])[1:]
        filled = {'DATASET': str(episode.parent), 'DIR': str(folder / 'lora')}
        words = [filled.get(word, word) for word in words]
        assert main([*words, *SMALL, '--set', 'optimizer.steps=2']) == 0
    (folder / 'said.txt').write_text(said.getvalue())
    return {name: folder / name for name in ('base', 'lora', 'said.txt', 'tiny.yaml')}


def test_the_history_of_the_preset_goes_through_import_and_training(recipe):
    config = load_training_config(recipe['tiny.yaml'])
    assert config.history == load_training_config('wan-1.3b').history.replace()
    assert config.history.num_frames == 5
    for folder in (recipe['base'], recipe['lora'] / 'adapter'):
        assert read_card(folder).history.num_frames == 5
        assert read_card(folder).guidance_scale == config.sampling.guidance_scale


@pytest.mark.slow
def test_the_printed_evaluation_of_the_adapter_runs(recipe, episode):
    line = recipe['said.txt'].read_text().partition('evaluate it with: ')[2].splitlines()[0]
    words = shlex.split(line.replace('EPISODES', str(episode.parent)))
    more = ['--steps', '1', '--no-report', '--no-ceiling', '--actions', 'true', *SMALL]
    assert main([*words[1:], *more]) == 0
    out = Path(words[words.index('--out') + 1])
    metrics = json.loads((out / 'metrics.json').read_text())
    assert metrics['num_episodes'] == 1 and 'adapter' in metrics['name']


@pytest.mark.slow
def test_the_node_imagines_with_the_adapter(recipe, tmp_path, capsys):
    pytest.importorskip('rclpy')
    served = tmp_path / 'served'
    shutil.copytree(recipe['base'], served)
    shutil.copytree(recipe['lora'] / 'adapter', served / 'adapter')
    words = ['demo', '--checkpoint', str(served), '--steps', '1', '--threads', '1']
    said = printed([*words, '--out', str(tmp_path / 'out')], capsys)
    report = json.loads((tmp_path / 'out' / 'report.json').read_text())
    assert report['chunks'] > 0, said
    assert report['frames_received'] == report['frames_published'] == report['chunks'] * 4 * 2


@pytest.mark.parametrize('base', [True, False])
def test_an_adapter_of_another_history_is_refused(recipe, tmp_path, base):
    card = read_card(recipe['base'])
    other = card.replace(history=HistorySettings())
    held, theirs = (card, other) if base else (other, card)
    theirs.write(tmp_path)
    with pytest.raises(CheckpointError, match='trained with history .num_frames'):
        check_same_model(held, tmp_path)
    held.write(tmp_path)
    check_same_model(held, tmp_path)
