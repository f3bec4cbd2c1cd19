"""The bundled episode and a preset small enough to train in seconds."""

from __future__ import annotations

from pathlib import Path

import pytest

from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.training.training_config import load_training_config, TrainingConfig
from test.support.sources import make_source, TINY_MODEL

TINY = TINY_MODEL | {
    'transformer.frames_per_token': 2,
    'video.num_frames': 2,
    'optimizer.warmup_steps': 1,
    'optimizer.steps': 4,
    'optimizer.learning_rate': 2e-3,
}


@pytest.fixture(scope='session')
def episode() -> Path:
    return share_path('resource', 'demo_episode')


@pytest.fixture(scope='session')
def tiny() -> TrainingConfig:
    return load_training_config('small', TINY)


@pytest.fixture(scope='session')
def recording(episode, tiny, robot) -> Recording:
    return load_recording(episode, tiny.spec, robot)


@pytest.fixture
def source(recording, tiny, robot):
    batches = make_source([recording], tiny, robot)
    yield batches
    batches.close()
