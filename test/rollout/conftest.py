"""The small episodes, for every test of the replay."""

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
