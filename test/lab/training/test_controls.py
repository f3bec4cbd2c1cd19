"""Training with each control representation: from a folder to a checkpoint that serves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from sources import make_source, ONE_STEP, with_batch_size
import torch

from mtv_world_ros.assembly import load_pipeline
from mtv_world_ros.cli import main
from mtv_world_ros.data.recording import clip_starts, cut_clip, Recording
from mtv_world_ros.data_types import JointTrajectory, Observation
from mtv_world_ros.errors import ConfigError, TrainingError
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.lab.training.clips.fit_actions import fit_actions
from mtv_world_ros.lab.training.objective import NoiseDraws, pooled_weights
from mtv_world_ros.lab.training.trainer import _kept
from mtv_world_ros.lab.training.training_config import (
    load_training_config,
    TrainingConfig,
    TrainingRun,
)
from mtv_world_ros.lab.training.training_run import train
from mtv_world_ros.model.actions import ActionEncoding
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter

ACTION_CONTROLS = ['policy2vec', 'ee_mlp', 'fast_tokens']


def with_control(config: TrainingConfig, control: str, **video: object) -> TrainingConfig:
    return config.replace(video=config.video.replace(control=control, **video))


def run(config: TrainingConfig, episode: Path, out: Path, robot: RobotModel, **options) -> Path:
    training = TrainingRun(config=config, dataset=episode.parent, out=out, **options)
    return train(training, robot=robot, segmenter=ColourSegmenter())


def weights(folder: Path) -> dict[str, torch.Tensor]:
    from safetensors.torch import load_file

    return load_file(folder / 'transformer' / 'diffusion_pytorch_model.safetensors')


def test_a_run_cut_in_two_ends_as_the_whole_one(
    episode: Path, tiny: TrainingConfig, robot: RobotModel, tmp_path: Path
) -> None:
    """Of `fast_tokens`, which has most to carry over: percentiles and a vocabulary."""
    config = with_control(tiny, 'fast_tokens')
    config = config.replace(optimizer=config.optimizer.replace(decay_share=0.0))
    whole = run(config, episode, tmp_path / 'whole', robot)
    half = config.replace(optimizer=config.optimizer.replace(steps=2))
    run(half, episode, tmp_path / 'cut', robot)
    cut = weights(run(config, episode, tmp_path / 'cut', robot))
    for name, value in weights(whole).items():
        assert torch.equal(cut[name], value), name
    for file in ('action_statistics.json', 'action_tokenizer.json', 'world_model.json'):
        assert (tmp_path / 'cut' / 'checkpoint' / file).read_bytes() == (whole / file).read_bytes()


@pytest.mark.parametrize('control', ACTION_CONTROLS)
def test_the_pipeline_hands_the_model_what_training_saw(
    episode: Path,
    recording: Recording,
    tiny: TrainingConfig,
    robot: RobotModel,
    control: str,
    tmp_path: Path,
) -> None:
    pipeline = load_pipeline(
        run(with_control(tiny, control), episode, tmp_path, robot), dtype='float32'
    )
    spec, given = pipeline.spec, []
    encoding = pipeline.world_model.actions
    assert encoding.control == control
    clip = cut_clip(recording, int(clip_starts(recording, spec)[5]), spec)

    class Listening(ActionEncoding):
        def encode(self, robot, positions):
            given.append(super().encode(robot, positions))
            return given[-1]

    pipeline.world_model.actions = Listening(
        control=control, scaling=encoding.scaling, tokenizer=encoding.tokenizer
    )
    observation = Observation(
        cameras=clip.cameras, frames=clip.frames[:, 0], positions=clip.positions[0], stamp_ns=0
    )
    trajectory = JointTrajectory(
        joint_names=robot.joint_names, times=clip.times[1:], positions=clip.positions[1:]
    )
    list(pipeline.begin(observation, num_inference_steps=1).extend(trajectory))
    np.testing.assert_allclose(given[0], encoding.encode(robot, clip.positions), atol=1e-6)


def test_batches_carry_actions_and_no_trajectory_video(
    recording: Recording, tiny: TrainingConfig, robot: RobotModel
) -> None:
    spec = tiny.spec
    actions = fit_actions('fast_tokens', [recording], spec, robot)
    source = make_source([recording], with_batch_size(tiny, 3), robot, actions=actions)
    batch = source.batch(0)
    source.close()
    assert batch.trajectory is None
    assert batch.actions.shape[0] == 3 and batch.actions.dtype == torch.int64
    assert batch.actions.min() >= -1 and (batch.actions[:, 0] >= 0).all()


def test_object_masks_off_leaves_them_out_of_the_trajectory_video(
    recording: Recording, tiny: TrainingConfig, robot: RobotModel
) -> None:
    def drawn_pixels(object_mask: bool) -> int:
        drawn = tiny.replace(video=tiny.video.replace(object_mask=object_mask))
        source = make_source([recording], drawn, robot)
        batch = source.batch(0)
        source.close()
        assert batch.trajectory is not None
        return int((batch.trajectory > 0).sum())

    assert drawn_pixels(True) > drawn_pixels(False)


def test_one_view_from_the_command_line_trains_and_evaluates(
    episode: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / 'run'
    command = ['train', str(episode.parent), '--out', str(out), '--threads', '1', *ONE_STEP]
    options = ['--views', 'low', '--object-mask', 'off', '--control', 'ee_mlp']
    assert main([*command, *options, '--dtype', 'float32']) == 0
    card = json.loads((out / 'checkpoint' / 'world_model.json').read_text())
    assert (card['views'], card['object_mask'], card['control']) == (['low'], False, 'ee_mlp')
    evaluation = ['evaluate', str(out / 'checkpoint'), str(episode.parent), '--episodes', '1']
    scores = tmp_path / 'scores'
    assert main([*evaluation, '--out', str(scores), '--steps', '1', '--threads', '1']) == 0
    assert list(json.loads((scores / 'metrics.json').read_text())['views']) == ['low']
    assert main([*command, '--control', 'policy2vec']) == 1
    assert 'give --preset and --set as before, or another --out' in capsys.readouterr().err


def test_training_needs_a_dataset_and_a_folder(capsys: pytest.CaptureFixture) -> None:
    assert main(['train', '--control', 'ee_mlp']) == 1
    assert 'mtv-world train DATASET --out DIR' in capsys.readouterr().err


def test_a_run_of_another_control_is_not_resumed(
    episode: Path, tiny: TrainingConfig, robot: RobotModel, tmp_path: Path
) -> None:
    run(with_control(tiny, 'policy2vec'), episode, tmp_path, robot)
    with pytest.raises(
        TrainingError, match='video.control policy2vec, this preset has trajectory_video'
    ):
        run(tiny, episode, tmp_path, robot)


def test_weights_bring_the_statistics_they_were_trained_with(
    episode: Path, tiny: TrainingConfig, robot: RobotModel, tmp_path: Path
) -> None:
    config = with_control(tiny, 'policy2vec')
    first = run(config, episode, tmp_path / 'first', robot)
    statistics = json.loads((first / 'action_statistics.json').read_text())
    statistics['low'][0] -= 1.0
    (first / 'action_statistics.json').write_text(json.dumps(statistics))
    second = run(config, episode, tmp_path / 'second', robot, seed=1, initial=first)
    found = json.loads((second / 'action_statistics.json').read_text())
    assert found['low'] == statistics['low']


def test_one_action_in_twenty_is_dropped_with_ee_mlp_alone(tiny: TrainingConfig) -> None:
    draws = NoiseDraws(0, 0, range(4000))
    kept = _kept(draws, with_control(tiny, 'ee_mlp'), torch.device('cpu'))
    # three standard deviations of 4,000 draws
    assert 1 - kept.float().mean().item() == pytest.approx(0.05, abs=0.0104)
    assert _kept(draws, with_control(tiny, 'policy2vec'), torch.device('cpu')) is None


def test_an_unknown_control_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"'ee_mpl'.*did you mean 'ee_mlp'.*--control"):
        load_training_config('small', {'video.control': 'ee_mpl'})


def test_latents_of_four_frames_weigh_their_pixels_mean() -> None:
    weights = torch.rand(1, 2, 8, 16, 24, generator=torch.Generator().manual_seed(0))
    found = pooled_weights(weights, (1, 2, 16, 3, 2, 3))
    assert found.shape == (1, 2, 16, 3, 2, 3)
    assert (found[:, :, :, 0] == 1).all()
    expected = weights[0, 1, 4:8, 8:16, 16:24].mean()
    torch.testing.assert_close(found[0, 1, :, 2, 1, 2], expected.expand(16))
