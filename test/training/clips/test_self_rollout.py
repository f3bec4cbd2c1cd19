"""Self-rollout: clips start from the model's own prediction, their target stays the recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mtv_world_ros.core.data_types import History, JointTrajectory, Observation
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.data.recording import frame_indices, Recording
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.trained_model import load_trained_model
from mtv_world_ros.model.world_model import DiffusionWorldModel
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.success_judge import SuccessJudge
from mtv_world_ros.success.estimator import SuccessEstimator
from mtv_world_ros.training.clips import self_rollout
from mtv_world_ros.training.clips.batches import BatchSource
from mtv_world_ros.training.trainer import Trainer
from mtv_world_ros.training.training_config import (
    HistoryConfig,
    load_training_config,
    SelfRolloutConfig,
    TrainingConfig,
)
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter
from test.support.sources import make_source, make_trainer


@pytest.fixture
def rolling(tiny: TrainingConfig) -> TrainingConfig:
    """Every clip that has room for it starts from a rollout of one or two chunks."""
    return tiny.replace(
        augment=tiny.augment.replace(colour_permutation=0.0, start_noise=0.0),
        sampling=tiny.sampling.replace(num_inference_steps=1),
        self_rollout=SelfRolloutConfig(share=1.0, max_chunks=2),
        optimizer=tiny.optimizer.replace(batch_size=3),
    )


def run(trainer: Trainer, source: BatchSource) -> list[float]:
    return [r.loss for r in trainer.run(source, save_every=2, on_save=lambda _: None)]


def seen_batches(monkeypatch: pytest.MonkeyPatch) -> list:
    """Collect what the trainer's rollouts take and give."""
    seen = []
    apply = self_rollout.SelfRollout.apply

    def watched(self, batch, transformer):
        given = apply(self, batch, transformer)
        seen.append((batch, given))
        return given

    monkeypatch.setattr(self_rollout.SelfRollout, 'apply', watched)
    return seen


@pytest.mark.parametrize(
    'history',
    [
        HistoryConfig(),
        HistoryConfig(num_frames=4, noise_level=0.1, reference='first_frame', dropout=0.0),
    ],
    ids=['plain', 'history'],
)
def test_the_start_is_the_models_own_rollout_and_the_target_the_recording(
    history: HistoryConfig,
    recording: Recording,
    rolling: TrainingConfig,
    robot: RobotModel,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Serving the exported weights over the same chunks gives the start frames bit for bit.

    And so the history that the clip is shown, behind the same anchor.
    """
    rolling = rolling.replace(history=history)
    trainer = make_trainer(rolling, tmp_path)
    with torch.no_grad():  # an untrained model holds its start frame; this one does not
        for averaged in trainer.weights.ema.shadow_params:
            averaged.add_(0.05 * torch.randn_like(averaged))
    trainer.export(tmp_path / 'checkpoint', dtype=torch.float32)
    seeds = []
    noise_seed = self_rollout.noise_seed
    monkeypatch.setattr(
        self_rollout,
        'noise_seed',
        lambda *parts: seeds.append((parts[2], noise_seed(*parts))) or seeds[-1][1],
    )
    seen = seen_batches(monkeypatch)
    source = make_source([recording], rolling, robot)
    next(trainer.run(source, save_every=100, on_save=lambda _: None))
    source.close()
    before, after = seen[0]
    assert torch.equal(before.frames, after.frames)
    rolled = [i for i, lead in enumerate(before.lead_ins) if lead is not None]
    assert rolled
    model = DiffusionWorldModel(load_trained_model(Checkpoint.open(tmp_path / 'checkpoint')))
    spec = rolling.spec
    segmenter, estimator = ColourSegmenter(), SuccessEstimator({})
    pipeline = Pipeline(
        robot=robot,
        world_model=model,
        segmenter=segmenter,
        judge=SuccessJudge(robot=robot, estimator=estimator),
        control=trainer.control,
    )
    for index in rolled:
        lead = before.lead_ins[index]
        clip, last = lead.clip, lead.num_chunks * spec.num_frames
        # the target follows the rollout's last frame on the recording's own clock
        first = next(
            s
            for s in range(len(recording.times))
            if (found := frame_indices(recording, s, spec, len(clip.times) - 1)) is not None
            and np.array_equal(recording.frames[:, found], clip.frames)
        )
        index_of = frame_indices(recording, first, spec, len(clip.times) - 1)
        assert np.array_equal(after.frames[index], recording.frames[:, index_of[last:]])
        own_seeds = [seed for number, seed in seeds if number == index]
        observation = Observation(
            cameras=clip.cameras,
            frames=clip.frames[:, 0],
            positions=clip.positions[0],
            stamp_ns=0,
        )
        episode = pipeline.begin(
            observation, RolloutOptions(instruction=recording.instruction, num_inference_steps=1)
        )
        shown = [clip.frames[:, :1]]
        for chunk, seed in enumerate(own_seeds):
            first = chunk * spec.num_frames
            trajectory = JointTrajectory(
                joint_names=robot.joint_names,
                times=clip.times[1 : spec.num_frames + 1],
                positions=clip.positions[first + 1 : first + spec.num_frames + 1],
            )
            episode.options = replace(episode.options, seed=seed - chunk)
            (prediction,) = episode.extend(trajectory)
            shown.append(prediction.video.frames)
        frame = episode.observation.frames
        # the embedding of two noise levels rounds otherwise in a batch: a byte shows at most 1
        apart = np.abs(after.start_frame[index].numpy().astype(int) - frame)
        assert apart.max() <= (1 if history.on else 0) and apart.mean() < 1e-3
        assert not np.array_equal(after.start_frame[index], after.frames[index][:, 0])
        assert lead.num_chunks == len(own_seeds)
        if history.on:
            before_last = np.concatenate(shown, axis=1)[:, :-1]
            past = History(anchor=clip.frames[:, 0], frames=before_last[:, -4:])
            apart = np.abs(after.history[index].numpy().astype(int) - past.filled(4))
            assert apart.max() <= 1
            assert np.array_equal(after.anchor[index], past.anchor)
            assert 0 <= after.history_sigmas[index] <= history.max_noise


def test_a_killed_run_continues_as_if_nothing_had_happened(
    recording: Recording, rolling: TrainingConfig, robot: RobotModel, tmp_path: Path
) -> None:
    source = make_source([recording], rolling, robot)
    whole = make_trainer(rolling, tmp_path / 'whole')
    losses = run(whole, source)
    cut = make_trainer(rolling, tmp_path / 'cut')
    reports = cut.run(source, save_every=2, on_save=lambda _: None)
    first = [next(reports).loss, next(reports).loss, next(reports).loss]
    reports.close()
    resumed = make_trainer(rolling, tmp_path / 'cut')
    assert resumed.load_state()
    assert first[:2] + run(resumed, source) == losses
    source.close()


def test_off_or_before_its_step_it_changes_nothing(
    recording: Recording, rolling: TrainingConfig, robot: RobotModel, source: BatchSource
) -> None:
    later = rolling.replace(self_rollout=rolling.self_rollout.replace(start_step=3))
    sources = {
        'off': make_source([recording], rolling.replace(self_rollout=SelfRolloutConfig()), robot),
        'later': make_source([recording], later, robot),
    }
    for step in range(3):
        off, late = sources['off'].batch(step), sources['later'].batch(step)
        assert not any(off.lead_ins) and not any(late.lead_ins)
        assert torch.equal(off.frames, late.frames)
    assert any(sources['later'].batch(3).lead_ins)
    for made in sources.values():
        made.close()


def test_colours_are_exchanged_in_start_and_target_alike(
    recording: Recording, rolling: TrainingConfig, robot: RobotModel, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """A model that holds its start frame gives back the frame before, in the clip's colours."""
    config = rolling.replace(augment=rolling.augment.replace(colour_permutation=1.0))
    seen = seen_batches(monkeypatch)
    source = make_source([recording], config, robot)
    monkeypatch.setattr(
        self_rollout,
        'sample_latents',
        lambda transformer, scheduler, conditioning, **_: conditioning.start.float(),
    )
    next(make_trainer(config, tmp_path).run(source, save_every=100, on_save=lambda _: None))
    source.close()
    before, after = seen[0]
    exchanged = 0
    for index, lead in enumerate(before.lead_ins):
        if lead is not None:
            exchanged += lead.colours != (0, 1, 2)
            expected = lead.clip.frames[:, 0][..., list(lead.colours)]
            assert np.abs(after.start_frame[index].numpy().astype(int) - expected).max() <= 1
    assert exchanged


@pytest.mark.parametrize(
    ('override', 'message'),
    [
        ({'self_rollout.share': 1.5}, 'self_rollout.share is 1.5; it must be in .0, 1.'),
        ({'self_rollout.max_chunks': 0}, 'self_rollout.max_chunks is 0; it must be'),
        ({'self_rollout.chunks': 2}, "unknown key 'chunks'"),
    ],
)
def test_wrong_settings_are_refused(override: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_training_config('small', override)
