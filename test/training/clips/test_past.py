"""Clips with a history: what training shows is what serving shows."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mtv_world_ros.core.errors import CheckpointError, ConfigError
from mtv_world_ros.data.recording import frame_indices, Recording
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.trained_model import load_trained_model
from mtv_world_ros.model.world_model import DiffusionWorldModel
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.training.clips.batches import BatchSource
from mtv_world_ros.training.clips.clip_controls import draw_past, history_before
from mtv_world_ros.training.trainer import Trainer
from mtv_world_ros.training.training_config import (
    HistoryConfig,
    load_training_config,
    TrainingConfig,
)
from test.support.sources import make_source, with_batch_size

HISTORY = HistoryConfig(num_frames=4, reference='first_frame')


def source_of(config: TrainingConfig, recording: Recording, robot: RobotModel) -> BatchSource:
    return make_source([recording], with_batch_size(config, 4), robot)


def position(recording: Recording, frame: np.ndarray) -> int:
    """The recorded frame that looks like it."""
    (same,) = np.nonzero((recording.frames == frame[:, None]).all(axis=(0, 2, 3, 4)))
    return int(same[-1])


def test_a_clip_is_shown_what_a_rollout_that_began_earlier_would_show(recording, tiny):
    """Every number of frames up to N comes, the anchor is never younger than the history."""
    spec, start = tiny.spec, 40
    clock = frame_indices(recording, 0, spec, int(recording.times[-1] * 5) - 1)
    assert clock is not None
    every = int(clock[1] - clock[0])
    rng = np.random.default_rng(0)
    counts: set[int] = set()
    for _ in range(200):
        history = history_before(recording, start, spec, HISTORY, rng)
        count = history.frames.shape[1]
        counts.add(count)
        wanted = [start - every * k for k in range(count, 0, -1)]
        assert np.array_equal(history.frames, recording.frames[:, wanted])
        if count < 4:  # all that the rollout has shown before this frame
            assert np.array_equal(history.anchor, recording.frames[:, start - every * count])
        else:
            assert position(recording, history.anchor) <= wanted[0]
    assert counts == {0, 1, 2, 3, 4}


def test_the_recordings_first_frame_has_nothing_before_it(recording, tiny):
    rng = np.random.default_rng(0)
    history = history_before(recording, 0, tiny.spec, HISTORY.replace(first_share=0.0), rng)
    assert history.frames.shape[1] == 0
    assert np.array_equal(history.anchor, recording.frames[:, 0])


def test_noise_levels_are_drawn_up_to_the_largest_and_one_means_nothing(recording, tiny):
    config = HISTORY.replace(first_share=0.0, dropout=0.25, max_noise=0.2)
    rng = np.random.default_rng(0)
    history = history_before(recording, 40, tiny.spec, config, rng)
    drawn = np.array([draw_past(history, config, rng).sigma for _ in range(400)])
    assert 0.2 < (drawn == 1.0).mean() < 0.3
    levels = drawn[drawn < 1]
    assert levels.min() < 0.02 and 0.18 < levels.max() <= 0.2
    begun = history_before(recording, 0, tiny.spec, config, rng)
    assert draw_past(begun, config, rng).sigma == 1.0


def test_switched_off_the_clips_are_those_of_before_and_carry_nothing(
    recording, tiny, robot, source
):
    off = source_of(tiny, recording, robot).batch(0)
    assert off.anchor is None and off.history is None
    assert torch.equal(off.frames[:1], source.batch(0).frames)


def test_a_batch_shows_colours_of_clip_and_past_alike(recording, tiny, robot):
    augment = tiny.augment.replace(colour_permutation=1.0, start_noise=0.0)
    config = tiny.replace(history=HISTORY.replace(first_share=1.0), augment=augment)
    made = source_of(config, recording, robot)
    batches = [made.batch(step) for step in range(2)]
    made.close()
    for batch in batches:
        assert torch.equal(batch.anchor, batch.start_frame)
        assert (batch.history_sigmas == 1).all()
        assert batch.history.shape[2] == 4


def test_a_model_trained_with_history_serves_with_it(recording, tiny, robot, tmp_path):
    config = tiny.replace(history=HISTORY)
    trainer = Trainer(config, tmp_path, seed=0, device='cpu', dtype=torch.float32, trained_on={})
    made = source_of(config, recording, robot)
    losses = [r.loss for r in trainer.run(made, save_every=9, on_save=lambda _: None)]
    made.close()
    assert np.isfinite(losses).all()
    trainer.export(tmp_path / 'checkpoint')
    served = DiffusionWorldModel(
        load_trained_model(Checkpoint.open(tmp_path / 'checkpoint'))
    ).history
    assert (served.num_frames, served.noise_level, served.reference) == (4, 0.05, 'first_frame')
    plain = Trainer(tiny, tmp_path / 'plain', seed=0, device='cpu', dtype=torch.float32,
                    trained_on={})  # fmt: skip
    plain.export(tmp_path / 'off')
    assert 'history' not in load_trained_model(Checkpoint.open(tmp_path / 'off')).card.plain()


@pytest.mark.parametrize(
    ('key', 'value', 'match'),
    [
        ('history.frames', 4, "unknown key 'frames'"),
        ('history.max_noise', 0.01, 'at least history.noise_level, 0.05'),
        ('history.first_share', 1.5, 'first_share is 1.5'),
        ('history.reference', 'first', "'first' is not one of chunk_start, first_frame"),
    ],
)
def test_wrong_settings_are_refused_by_name(key, value, match):
    with pytest.raises(ConfigError, match=match):
        load_training_config('small', {key: value})


def test_frames_that_do_not_divide_into_tokens_are_refused_before_the_first_step(tiny, tmp_path):
    config = tiny.replace(history=HISTORY.replace(num_frames=3))
    with pytest.raises(CheckpointError, match='num_frames to a multiple of 2'):
        Trainer(config, tmp_path, seed=0, device='cpu', dtype=torch.float32, trained_on={})
