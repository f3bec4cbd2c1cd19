"""The small episodes, for every test of the reports."""

from test.support.small_episodes import episodes, make_episode, make_pipeline, oracle, recordings

__all__ = [
    'episodes',
    'make_episode',
    'make_pipeline',
    'oracle',
    'recordings',
]
