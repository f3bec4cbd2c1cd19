"""The observation of a recorded episode at a time: frames of all views, and joint positions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mtv_world_ros.core.data_types import FloatArray, JointTrajectory, Observation
from mtv_world_ros.core.errors import EpisodeError, ObservationError
from mtv_world_ros.data.episode import Episode
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.resample import match_joints

#: largest age of the newest frames at the time of an observation [s]
IMAGE_AGE_S = 0.5
#: largest age of the newest joint states then [s]
JOINT_STATE_AGE_S = 0.5
#: largest time between the frames of two views of one observation [s]
VIEW_SKEW_S = 0.05


def newest_observation(
    episode: Episode, views: Sequence[str], robot: RobotModel, stamp_ns: int
) -> Observation:
    """Return the newest frames and joint positions before a time, as the node observes them.

    Args:
        episode: the episode.
        views: names of the V views.
        robot: robot whose order of joints is taken.
        stamp_ns: the time [ns].

    Raises:
        ObservationError: nothing was seen yet, too long ago, or at different times by the views.
    """
    newest = [_last_before(episode.images[view].stamps_ns, stamp_ns) for view in views]
    for view, index in zip(views, newest, strict=True):
        if index < 0:
            raise ObservationError(f"view '{view}' has no frame before the trajectory starts")
    common = min(int(episode.images[v].stamps_ns[i]) for v, i in zip(views, newest, strict=True))
    picked = [int(np.abs(episode.images[view].stamps_ns - common).argmin()) for view in views]
    stamps = [int(episode.images[v].stamps_ns[i]) for v, i in zip(views, picked, strict=True)]
    _check('the newest frames are', stamp_ns - min(stamps), IMAGE_AGE_S, 'old')
    _check('the views are', max(stamps) - min(stamps), VIEW_SKEW_S, 'apart')
    states = episode.joint_states
    index = -1 if states is None else _last_before(states.stamps_ns, stamp_ns)
    if states is None or index < 0:
        raise ObservationError('there are no joint_states before the trajectory starts')
    age_ns = stamp_ns - int(states.stamps_ns[index])
    _check('the newest joint states are', age_ns, JOINT_STATE_AGE_S, 'old')
    return _observation(episode, views, robot, picked, index, min(stamps))


def observation_after(
    episode: Episode, views: Sequence[str], robot: RobotModel, start_s: float
) -> Observation:
    """Return the frames and joint positions nearest to a time after the first frame [s].

    Args:
        episode: the episode.
        views: names of the V views.
        robot: robot whose order of joints is taken.
        start_s: the time [s].

    Raises:
        EpisodeError: the episode has no joint states, or ends before.
    """
    stamps = np.asarray(episode.images[views[0]].stamps_ns)
    stamp_ns, states = int(stamps[0]) + round(start_s * 1e9), episode.joint_states
    if states is None:
        raise EpisodeError(f"episode '{episode.info.path}' has no joint_states")
    if stamp_ns > stamps[-1]:
        raise EpisodeError(
            f"episode '{episode.info.path}' is {(stamps[-1] - stamps[0]) / 1e9:.2f} s long; it "
            f'has no frame at {start_s:g} s'
        )
    picked = [_nearest(episode.images[view].stamps_ns, stamp_ns) for view in views]
    index = _nearest(states.stamps_ns, stamp_ns)
    return _observation(episode, views, robot, picked, index, stamp_ns)


def _observation(
    episode: Episode,
    views: Sequence[str],
    robot: RobotModel,
    frames: Sequence[int],
    state: int,
    stamp_ns: int,
) -> Observation:
    """Return the observation of a frame of each view and one joint state, by their indices."""
    chosen = list(zip(views, frames, strict=True))
    return Observation(
        cameras=tuple(episode.camera(view, index) for view, index in chosen),
        frames=np.stack([episode.images[view].frames[index] for view, index in chosen]),
        positions=_positions(episode, robot, state),
        stamp_ns=stamp_ns,
        place=episode.info.place,
    )


def _positions(episode: Episode, robot: RobotModel, index: int) -> FloatArray:
    states = episode.joint_states
    assert states is not None
    row = JointTrajectory(
        joint_names=states.joint_names,
        times=np.zeros(1),
        positions=states.positions[index][None],
    )
    return match_joints(row, robot).positions[0]


def _last_before(stamps_ns: np.ndarray, stamp_ns: int) -> int:
    """Return the index of the last stamp not after a moment, -1 if there is none."""
    return int(np.searchsorted(stamps_ns, stamp_ns, side='right')) - 1


def _nearest(stamps_ns: np.ndarray, stamp_ns: int) -> int:
    return int(np.abs(np.asarray(stamps_ns) - stamp_ns).argmin())


def _check(what: str, value_ns: int, limit_s: float, how: str) -> None:
    if value_ns > limit_s * 1e9:
        raise ObservationError(f'{what} {value_ns / 1e9:.3f} s {how}; allowed are {limit_s:g} s')


def instruction_at(episode: Episode, stamp_ns: int) -> str:
    """Return the instruction that held at a moment, or the episode's."""
    before = [text for stamp, text in episode.instructions if stamp <= stamp_ns]
    return before[-1] if before else episode.info.instruction
