"""The small episodes, for every test of the evaluation."""

from test.support.small_episodes import (
    blurred_oracle,
    episodes,
    make_episode,
    make_pipeline,
    oracle,
    recordings,
)

__all__ = [
    'blurred_oracle',
    'episodes',
    'make_episode',
    'make_pipeline',
    'oracle',
    'recordings',
]
