"""Training by the command line: resumed as it began, one view, with and without masks."""

from __future__ import annotations

import json
from pathlib import Path
import shutil

import pytest
import torch

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.model.checkpoint import checkpoint_folder
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.training.objective import pooled_weights
from mtv_world_ros.training.training_config import TrainingConfig, TrainingRun
from mtv_world_ros.training.training_run import train
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter
from test.support.sources import make_source, ONE_STEP


def run(config: TrainingConfig, episode: Path, out: Path, robot: RobotModel, **options) -> Path:
    training = TrainingRun(config=config, dataset=episode.parent, out=out, **options)
    return train(training, robot=robot, segmenter=ColourSegmenter())


def weights(folder: Path) -> dict[str, torch.Tensor]:
    from safetensors.torch import load_file

    return load_file(folder / 'transformer' / 'diffusion_pytorch_model.safetensors')


@pytest.mark.slow
def test_a_run_cut_in_two_ends_as_the_whole_one(episode, tiny, robot, tmp_path):
    config = tiny.replace(optimizer=tiny.optimizer.replace(decay_share=0.0))
    whole = run(config, episode, tmp_path / 'whole', robot)
    half = config.replace(optimizer=config.optimizer.replace(steps=2))
    run(half, episode, tmp_path / 'cut', robot)
    cut = weights(run(config, episode, tmp_path / 'cut', robot))
    for name, value in weights(whole).items():
        assert torch.equal(cut[name], value), name
    card = (tmp_path / 'cut' / 'checkpoint' / 'world_model.json').read_bytes()
    assert card == (whole / 'world_model.json').read_bytes()


def test_object_masks_off_leaves_them_out_of_the_trajectory_video(recording, tiny, robot):
    def drawn_pixels(object_mask: bool) -> int:
        drawn = tiny.replace(video=tiny.video.replace(object_mask=object_mask))
        source = make_source([recording], drawn, robot)
        batch = source.batch(0)
        source.close()
        assert batch.inputs.video is not None
        return int((batch.inputs.video > 0).sum())

    assert drawn_pixels(True) > drawn_pixels(False)


@pytest.mark.slow
def test_one_view_from_the_command_line_trains_and_evaluates(episode, tmp_path, capsys):
    out = tmp_path / 'run'
    command = ['train', str(episode.parent), '--out', str(out), '--threads', '1', *ONE_STEP]
    options = ['--views', 'low', '--object-mask', 'off']
    assert main([*command, *options, '--dtype', 'float32']) == 0
    card = json.loads((out / 'checkpoint' / 'world_model.json').read_text())
    assert (card['views'], card['object_mask'], card['control']) == (
        ['low'],
        False,
        'trajectory_video',
    )
    evaluation = ['evaluate', str(out / 'checkpoint'), str(episode.parent), '--episodes', '1']
    scores = tmp_path / 'scores'
    assert main([*evaluation, '--out', str(scores), '--steps', '1', '--threads', '1']) == 0
    assert list(json.loads((scores / 'metrics.json').read_text())['views']) == ['low']
    assert main(command) == 1
    assert 'give --preset and --set as before, or another --out' in capsys.readouterr().err


def test_training_needs_a_dataset_and_a_folder(capsys):
    assert main(['train']) == 1
    assert 'mtv-world train DATASET --out DIR' in capsys.readouterr().err


def test_a_checkpoint_of_another_control_is_refused(tmp_path):
    shutil.copytree(checkpoint_folder('bundled'), tmp_path / 'old')
    card = tmp_path / 'old' / 'world_model.json'
    card.write_text(card.read_text().replace('trajectory_video', 'ee_mlp'))
    with pytest.raises(CheckpointError, match=r"no control.json, which control 'ee_mlp' needs"):
        Pipeline.load(tmp_path / 'old')


def test_a_control_whose_inputs_the_transformer_does_not_take_is_refused(tmp_path, monkeypatch):
    folder = tmp_path / 'outside'
    folder.mkdir()
    shutil.copy(Path(__file__).parents[1] / 'control' / 'own_control.py', folder / 'pixels.py')
    monkeypatch.syspath_prepend(folder)
    shutil.copytree(checkpoint_folder('bundled'), tmp_path / 'old')
    card = tmp_path / 'old' / 'world_model.json'
    card.write_text(card.read_text().replace('trajectory_video', 'pixels:ToolPixels'))
    with pytest.raises(CheckpointError, match=r"feeds 'frame'.*takes none"):
        Pipeline.load(tmp_path / 'old')


def test_latents_of_four_frames_weigh_their_pixels_mean():
    weights = torch.rand(1, 2, 8, 16, 24, generator=torch.Generator().manual_seed(0))
    found = pooled_weights(weights, (1, 2, 16, 3, 2, 3))
    assert found.shape == (1, 2, 16, 3, 2, 3)
    assert (found[:, :, :, 0] == 1).all()
    expected = weights[0, 1, 4:8, 8:16, 16:24].mean()
    torch.testing.assert_close(found[0, 1, :, 2, 1, 2], expected.expand(16))
