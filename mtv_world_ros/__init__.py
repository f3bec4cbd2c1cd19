"""An online embodied world model for ROS 2: trajectory in, imagined camera streams out.

Five names are enough to begin with; they are imported when they are asked for:

    load_pipeline    checkpoint and options -> Pipeline
    Pipeline         `begin(observation)` -> ImaginedEpisode
    ImaginedEpisode  `extend(trajectory)` imagines chunk after chunk
    read_episode     a rosbag2 folder -> images, joint states, commands, cameras
    judge            the success estimate on the real frames of a recording
"""

from __future__ import annotations

from importlib import import_module
import os
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from mtv_world_ros.assembly import load_pipeline
    from mtv_world_ros.data.episode_reader import read_episode
    from mtv_world_ros.imagined_episode import ImaginedEpisode
    from mtv_world_ros.pipeline import Pipeline
    from mtv_world_ros.replay.offline import judge

__all__ = ['ImaginedEpisode', 'judge', 'load_pipeline', 'Pipeline', 'read_episode']
_PLACES = {
    'ImaginedEpisode': 'imagined_episode',
    'judge': 'replay.offline',
    'load_pipeline': 'assembly',
    'Pipeline': 'pipeline',
    'read_episode': 'data.episode_reader',
}

# Threads of torch that wait for one another sleep. By default they spin: where another process
# takes a core, those that wait use up the time that the last one needs, and all is many times as
# slow. The library reads this as it is loaded.
os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')
# NumPy's matrices are small here, and its threads spin, too: several of them take more time of the
# processor than one, four times as much in a search, and no less time by the clock.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')


def __getattr__(name: str) -> Any:
    """Imports one of the five names."""
    if name not in _PLACES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'{__name__}.{_PLACES[name]}'), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_PLACES])
