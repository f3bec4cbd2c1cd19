"""The small episodes, for every test of the replay, and the bundled model on its episode."""

import pytest

import mtv_world_ros
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import load_recording
from test.support.gantry import make_camera, one_arm
from test.support.small_episodes import episodes, make_episode, make_pipeline, oracle, recordings

__all__ = [
    'episodes',
    'make_camera',
    'make_episode',
    'make_pipeline',
    'one_arm',
    'oracle',
    'recordings',
]


@pytest.fixture(scope='module')
def pipeline():
    return mtv_world_ros.Pipeline.load(segmenter='colour', num_threads=1)


@pytest.fixture(scope='module')
def recording(pipeline):
    return load_recording(share_path('resource', 'demo_episode'), pipeline.spec, pipeline.robot)
