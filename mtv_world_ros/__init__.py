"""An online embodied world model for ROS 2: trajectory in, imagined camera streams out.

The names below are enough to begin with; they are imported when they are asked for:

    Checkpoint       `open(name or folder)` reads the card of a checkpoint
    Pipeline         `load(checkpoint, ...)`; `begin(observation, options)` -> Rollout
    Rollout          `extend(trajectory)` imagines chunk after chunk
    RolloutOptions   instruction, seed, denoising steps, limits of a rollout
    Observation      camera frames and joint positions at one instant
    JointTrajectory  joint positions over time
    read_episode     a rosbag2 folder -> images, joint states, commands, cameras
    judge            the success estimate on the real frames of a recording
"""

from __future__ import annotations

from importlib import import_module
import os
from typing import Any, TYPE_CHECKING
import warnings

if TYPE_CHECKING:
    from mtv_world_ros.core.data_types import JointTrajectory, Observation
    from mtv_world_ros.data.episode_reader import read_episode
    from mtv_world_ros.model.checkpoint import Checkpoint
    from mtv_world_ros.rollout.offline import judge
    from mtv_world_ros.rollout.options import RolloutOptions
    from mtv_world_ros.rollout.pipeline import Pipeline
    from mtv_world_ros.rollout.rollout import Rollout

__all__ = [
    'Checkpoint',
    'JointTrajectory',
    'judge',
    'Observation',
    'Pipeline',
    'read_episode',
    'Rollout',
    'RolloutOptions',
]
#: public name -> module
_PLACES = {
    'Checkpoint': 'model.checkpoint',
    'JointTrajectory': 'core.data_types',
    'judge': 'rollout.offline',
    'Observation': 'core.data_types',
    'Pipeline': 'rollout.pipeline',
    'read_episode': 'data.episode_reader',
    'Rollout': 'rollout.rollout',
    'RolloutOptions': 'rollout.options',
}
#: names of version 0.1 -> what replaced them
_RENAMED = {'ImaginedEpisode': 'Rollout', 'load_pipeline': 'Pipeline.load'}

# Threads of torch that wait for one another sleep. By default they spin: where another process
# takes a core, those that wait use up the time that the last one needs, and all is many times as
# slow. The library reads this as it is loaded.
os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')
# NumPy's matrices are small here, and its threads spin, too: several of them take more time of the
# processor than one, four times as much in a search, and no less time by the clock.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')


def __getattr__(name: str) -> Any:
    """Imports one of the public names."""
    new = _RENAMED.get(name, name)
    if new != name:
        warnings.warn(
            f'mtv_world_ros.{name} is now mtv_world_ros.{new}; the old name goes with version 0.3',
            DeprecationWarning,
            stacklevel=2,
        )
    public, _, method = new.partition('.')
    if public not in _PLACES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    found = getattr(import_module(f'{__name__}.{_PLACES[public]}'), public)
    return getattr(found, method) if method else found


def __dir__() -> list[str]:
    return sorted([*globals(), *_PLACES])
