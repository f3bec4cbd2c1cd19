"""The small episodes, for tests of tasks that episodes define."""

from test.support.small_episodes import make_episode

__all__ = ['make_episode']
