"""Tracks of objects in recorded episodes, and the commands they moved under.

T steps, O objects, V views, J joints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from mtv_world_ros.cameras.camera import camera_poses
from mtv_world_ros.cameras.mask_geometry import centroids, locate_all
from mtv_world_ros.core.data_types import BoolArray, CameraModel, FloatArray
from mtv_world_ros.core.errors import EpisodeError, MtvWorldError
from mtv_world_ros.core.progress import Progress
from mtv_world_ros.data.episode import Episode, JointStates
from mtv_world_ros.data.recording import stitched_commands
from mtv_world_ros.physics.arms.arm_response import PERIOD_S
from mtv_world_ros.physics.solid_foresight import COMMANDS_A_STEP, STEP_S
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.resample import nearest_rows, resample

Read = TypeVar('Read')


@dataclass(frozen=True, slots=True, kw_only=True)
class FirstFrame:
    """The first masks (V, O, H, W) of an episode, with V cameras and their T_base_camera."""

    masks: BoolArray
    cameras: tuple[CameraModel, ...]
    poses: tuple[FloatArray, ...]

    def points(self) -> FloatArray:
        """Return the object positions (O, 3) [m]; NaN = not seen by two views."""
        return locate_all(self.cameras, self.poses, centroids(self.masks))


def read_each(
    paths: Sequence[Path], read: Callable[[Path], Read]
) -> tuple[list[Read], dict[str, str]]:
    """Read each episode; return the results, and the reasons for unusable ones, by path."""
    found, skipped = [], {}
    for path in Progress(paths, desc='reading episodes', unit='episode'):
        try:
            found.append(read(path))
        except MtvWorldError as error:
            skipped[str(path)] = str(error)
    return found, skipped


def object_displacements(episode: Episode, robot: RobotModel, views: Sequence[str]) -> FloatArray:
    """Return object displacements (1 + T, O, 3) since the first frame [m]; NaN = not known.

    Taken from `/object_poses`, or else from the masks.

    Raises:
        EpisodeError: it lacks masks, joint states or commands, a joint of the robot was not
            measured, or no object is seen by two views in the first frame.
    """
    path, states = episode.info.path, episode.joint_states
    if episode.masks is None or states is None or not episode.trajectories:
        raise EpisodeError(f"'{path}' has no object masks, joint states or commands")
    start = first_frame(episode, robot, views).points()
    seen = np.asarray(np.isfinite(start).all(-1))
    if not seen.any():
        raise EpisodeError(f"'{path}': no object is seen by two views in the first frame")
    times = fine_commands(episode, robot, views)[0][::COMMANDS_A_STEP]
    stamps_ns = episode.masks[views[0]].stamps_ns[0] + times * 1e9
    found = episode.object_poses
    if found is not None:
        points = found.T_base_object[nearest_rows(found.stamps_ns, stamps_ns)][..., :3, 3]
        return np.where(seen[:, None], points - points[0], np.nan)
    cameras = [episode.cameras[view] for view in views]
    joints = recorded_positions(states, robot, stamps_ns)
    poses = np.stack([camera_poses(camera, robot, joints) for camera in cameras])
    rows = [
        locate_all(cameras, list(poses[:, step]), centroids(_masks_at(episode, views, stamp)))
        for step, stamp in enumerate(stamps_ns)
    ]
    return np.stack(rows) - start


def first_frame(episode: Episode, robot: RobotModel, views: Sequence[str]) -> FirstFrame:
    """Return the first masks of an episode with masks and joint states."""
    assert episode.masks is not None and episode.joint_states is not None
    joints = episode.joint_states.positions[:1, _columns(episode.joint_states, robot)]
    numbers = np.arange(len(episode.info.objects))[:, None, None] + 1
    cameras = tuple(episode.cameras[view] for view in views)
    return FirstFrame(
        masks=np.stack([episode.masks[view].frames[0] == numbers for view in views]),
        cameras=cameras,
        poses=tuple(camera_poses(camera, robot, joints)[0] for camera in cameras),
    )


def fine_commands(
    episode: Episode, robot: RobotModel, views: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Return times (1 + T * n,) from the first masks on [s], and commands (1 + T * n, J) then."""
    assert episode.masks is not None and episode.joint_states is not None
    stamp = int(episode.masks[views[0]].stamps_ns[0])
    count = int(_last_ns(episode, views[0]) / 1e9 / STEP_S + 1e-6)
    times = np.arange(count * COMMANDS_A_STEP + 1, dtype=np.float64) * PERIOD_S
    first = episode.joint_states.positions[0][_columns(episode.joint_states, robot)]
    return times, resample(stitched_commands(episode, robot, stamp), first, times)


def recorded_positions(
    states: JointStates, robot: RobotModel, stamps_ns: FloatArray
) -> FloatArray:
    """Return joint positions (T, J) at stamps (T,), in the robot's order [rad or m].

    Raises:
        EpisodeError: a joint of the robot was not measured.
    """
    columns = _columns(states, robot)
    found = [np.interp(stamps_ns, states.stamps_ns, states.positions[:, c]) for c in columns]
    return np.stack(found, axis=-1)


def _columns(states: JointStates, robot: RobotModel) -> list[int]:
    """Return the column of each joint of the robot, in its order.

    Raises:
        EpisodeError: a joint of the robot was not measured.
    """
    missing = [name for name in robot.joint_names if name not in states.joint_names]
    if missing:
        raise EpisodeError(
            f"joint states have no '{', '.join(missing)}' of robot '{robot.name}'; they have "
            f'{", ".join(states.joint_names)}. Give the robot that was recorded (--robot), or '
            'import the recording with the missing joints as `constants` in the mapping'
        )
    return [states.joint_names.index(name) for name in robot.joint_names]


def _masks_at(episode: Episode, views: Sequence[str], stamp_ns: float) -> BoolArray:
    """Return (V, O, H, W) nearest to a stamp."""
    assert episode.masks is not None
    ids = []
    for view in views:
        track = episode.masks[view]
        ids.append(track.frames[int(nearest_rows(track.stamps_ns, np.array([stamp_ns]))[0])])
    numbers = np.arange(len(episode.info.objects))[:, None, None] + 1
    return np.stack([frame == numbers for frame in ids])


def _last_ns(episode: Episode, view: str) -> float:
    assert episode.masks is not None
    found = episode.object_poses
    shown = episode.masks[view].stamps_ns
    return float((shown if found is None else found.stamps_ns)[-1] - shown[0])
