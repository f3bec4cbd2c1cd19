"""How objects moved in recorded episodes, and under which commands.

T steps, O objects, A tools, V views.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from tqdm import tqdm

from mtv_world_ros.data.episode import Episode, JointStates, Track
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.recording import stitched_commands
from mtv_world_ros.data_types import BoolArray, CameraModel, FloatArray
from mtv_world_ros.errors import EpisodeError, MtvWorldError
from mtv_world_ros.geometry.camera import camera_poses
from mtv_world_ros.geometry.mask_geometry import centroids, locate_all
from mtv_world_ros.geometry.object_shape import object_shapes
from mtv_world_ros.geometry.resample import nearest_rows, resample
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.model.object_motion.arm_response import ArmResponse, PERIOD_S
from mtv_world_ros.model.object_motion.network import COMMANDS_A_STEP, STEP_S

Read = TypeVar('Read')


@dataclass(frozen=True, slots=True, kw_only=True)
class FirstFrame:
    """What the first masks of an episode show.

    Attributes:
        masks: (V, O, H, W).
        cameras: V.
        poses: V of T_base_camera (4, 4).
    """

    masks: BoolArray
    cameras: tuple[CameraModel, ...]
    poses: tuple[FloatArray, ...]

    def points(self) -> FloatArray:
        """Returns (O, 3) where the objects are [m], NaN = not seen by two views."""
        return locate_all(self.cameras, self.poses, centroids(self.masks))


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectTracks:
    """An episode, or the rest of one, at the network's steps; row 0 is the frame it begins with.

    Attributes:
        features: (O, V, F) of `object_shapes`.
        tools: (T + 1, A, 4, 4) T_base_tool as expected of the commands if nothing is touched.
        gaps: (T + 1, A) from a tool to its fingers, as commanded [m].
        recorded_tools: (T + 1, A, 4, 4) where they really were.
        recorded_gaps: (T + 1, A) likewise.
        points: (T + 1, O, 3) [m], from where the first frame's masks have the objects.
        rotations: (T + 1, O, 3, 3) from the start.
        known: (T + 1, O) bool.
        turns_known: the rotations are recorded, not taken to be none.
        scene: of siblings, whose rows are of the same times; empty = it has none, or begins later.
    """

    features: FloatArray
    tools: FloatArray
    gaps: FloatArray
    recorded_tools: FloatArray
    recorded_gaps: FloatArray
    points: FloatArray
    rotations: FloatArray
    known: BoolArray
    turns_known: bool
    scene: str = ''


def read_each(
    paths: Sequence[Path], read: Callable[[Path], Read]
) -> tuple[list[Read], dict[str, str]]:
    """Returns what is read of each episode, and why others cannot be used, by path."""
    found, skipped = [], {}
    for path in tqdm(paths, desc='reading episodes', unit='ep'):
        try:
            found.append(read(path))
        except MtvWorldError as error:
            skipped[str(path)] = str(error)
    return found, skipped


def object_tracks(
    path: Path,
    robot: RobotModel,
    views: Sequence[str],
    num_starts: int = 1,
    response: ArmResponse | None = None,
) -> list[ObjectTracks]:
    """Reads an episode; see `tracks_of`."""
    episode = read_episode(path, views=tuple(views))
    return tracks_of(episode, robot, views, num_starts, response)


def tracks_of(
    episode: Episode,
    robot: RobotModel,
    views: Sequence[str],
    num_starts: int = 1,
    response: ArmResponse | None = None,
) -> list[ObjectTracks]:
    """Returns the tracks of an episode: from its first frame on, and from later ones with masks.

    Where the objects are is taken from its `/object_poses`, or else from its masks.

    Args:
        episode: as read with these views.
        robot: whose commands it has.
        views: whose masks are used.
        num_starts: frames to begin with at most, spread evenly over those that have masks.
        response: how the arms follow their commands; None = at once.

    Raises:
        EpisodeError: it lacks masks in the first frame, joint states or commands, or no object is
            seen by two views.
    """
    path = episode.info.path
    states = episode.joint_states
    if episode.masks is None or states is None or not episode.trajectories:
        raise EpisodeError(f"'{path}' has no object masks, joint states or commands")
    masks = {view: episode.masks[view] for view in views}
    stamps = masks[views[0]].stamps_ns
    times, positions = fine_commands(episode, robot, views)
    count = (len(times) - 1) // COMMANDS_A_STEP
    expected = positions if response is None else response.follow(robot, positions)[0]
    times, positions, expected = (rows[::COMMANDS_A_STEP] for rows in (times, positions, expected))
    stamps_ns = stamps[0] + times * 1e9
    recorded = recorded_positions(states, robot, stamps_ns)
    cameras = [episode.cameras[view] for view in views]
    recording = _Recording(
        episode=episode,
        masks=masks,
        cameras=cameras,
        poses=np.stack([camera_poses(camera, robot, positions) for camera in cameras]),
        tools=robot.tool_poses(expected).transpose(1, 0, 2, 3),
        gaps=robot.finger_gaps(positions),
        recorded_tools=robot.tool_poses(recorded).transpose(1, 0, 2, 3),
        recorded_gaps=robot.finger_gaps(recorded),
        stamps_ns=stamps_ns,
    )
    # the last second shows nothing new
    frames = np.flatnonzero(stamps - stamps[0] < (count - 10) * STEP_S * 1e9)
    chosen = np.linspace(0, len(frames), num_starts, endpoint=False).astype(int)
    tracks = [recording.tracks_from(int(frame)) for frame in sorted({0, *chosen.tolist()})]
    if not tracks[0].known[0].any():
        raise EpisodeError(f"'{path}': no object is seen by two views in the first frame")
    return [track for track in tracks if track.known[0].any()]


def first_frame(episode: Episode, robot: RobotModel, views: Sequence[str]) -> FirstFrame:
    """Returns the first masks of an episode, which has them and joint states."""
    assert episode.masks is not None and episode.joint_states is not None
    columns = [episode.joint_states.joint_names.index(name) for name in robot.joint_names]
    joints = episode.joint_states.positions[:1, columns]
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
    """Returns times (1 + T * n,) from the first masks on [s], and commands (1 + T * n, J) then.

    Args:
        episode: with masks, joint states and commands.
        robot: gives the order of joints.
        views: whose masks are used.
    """
    assert episode.masks is not None and episode.joint_states is not None
    stamp = int(episode.masks[views[0]].stamps_ns[0])
    count = int(_last_ns(episode, views[0]) / 1e9 / STEP_S + 1e-6)
    times = np.arange(count * COMMANDS_A_STEP + 1, dtype=np.float64) * PERIOD_S
    columns = [episode.joint_states.joint_names.index(name) for name in robot.joint_names]
    first = episode.joint_states.positions[0][columns]
    return times, resample(stitched_commands(episode, robot, stamp), first, times)


def recorded_positions(
    states: JointStates, robot: RobotModel, stamps_ns: FloatArray
) -> FloatArray:
    """Returns (T, J) where joints were at stamps (T,), in the robot's order [rad or m]."""
    columns = [states.joint_names.index(name) for name in robot.joint_names]
    found = [np.interp(stamps_ns, states.stamps_ns, states.positions[:, c]) for c in columns]
    return np.stack(found, axis=-1)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Recording:
    """An episode on the network's clock.

    Attributes:
        episode: as read.
        masks: of each view.
        cameras: V.
        poses: (V, T + 1, 4, 4) T_base_camera.
        tools: see `ObjectTracks`.
        gaps: see `ObjectTracks`.
        recorded_tools: see `ObjectTracks`.
        recorded_gaps: see `ObjectTracks`.
        stamps_ns: (T + 1,).
    """

    episode: Episode
    masks: dict[str, Track]
    cameras: Sequence[CameraModel]
    poses: FloatArray
    tools: FloatArray
    gaps: FloatArray
    recorded_tools: FloatArray
    recorded_gaps: FloatArray
    stamps_ns: FloatArray

    def tracks_from(self, frame: int) -> ObjectTracks:
        """Returns what follows one frame of the masks."""
        stamp = next(iter(self.masks.values())).stamps_ns[frame : frame + 1]
        row = int(nearest_rows(self.stamps_ns, stamp)[0])
        seen = self._masks_at(stamp)
        start = locate_all(self.cameras, list(self.poses[:, row]), centroids(seen))
        points, rotations, known = self._moved(start, row)
        return ObjectTracks(
            features=object_shapes(seen, start, self.cameras, list(self.poses[:, row])),
            tools=self.tools[row:],
            gaps=self.gaps[row:],
            recorded_tools=self.recorded_tools[row:],
            recorded_gaps=self.recorded_gaps[row:],
            points=np.nan_to_num(points),
            rotations=rotations,
            known=known & np.isfinite(start).all(-1),
            turns_known=self.episode.object_poses is not None,
            scene='' if row else str(self.episode.info.metadata.get('scene', '')),
        )

    def _moved(self, start: FloatArray, row: int) -> tuple[FloatArray, FloatArray, BoolArray]:
        found, wanted_ns = self.episode.object_poses, self.stamps_ns[row:]
        if found is not None:
            T = found.T_base_object[nearest_rows(found.stamps_ns, wanted_ns)]
            points = start + T[..., :3, 3] - T[0, :, :3, 3]
            turns = T[..., :3, :3] @ np.swapaxes(T[0, :, :3, :3], -1, -2)
            return points, turns, np.ones(points.shape[:2], bool)
        points = np.stack(
            [
                locate_all(
                    self.cameras,
                    list(self.poses[:, row + step]),
                    centroids(self._masks_at(wanted_ns[step : step + 1])),
                )
                for step in range(len(wanted_ns))
            ]
        )
        known = np.asarray(np.isfinite(points).all(-1))
        turns = np.broadcast_to(np.eye(3), (*points.shape[:2], 3, 3))
        return np.where(known[..., None], points, start), np.array(turns), known

    def _masks_at(self, stamp_ns: np.ndarray) -> BoolArray:
        """(V, O, H, W) nearest to a stamp (1,)."""
        ids = np.stack(
            [
                track.frames[int(nearest_rows(track.stamps_ns, stamp_ns)[0])]
                for track in self.masks.values()
            ]
        )
        numbers = range(1, len(self.episode.info.objects) + 1)
        return np.stack([ids == number for number in numbers], axis=1)


def _last_ns(episode: Episode, view: str) -> float:
    assert episode.masks is not None
    found = episode.object_poses
    shown = episode.masks[view].stamps_ns
    return float((shown if found is None else found.stamps_ns)[-1] - shown[0])
