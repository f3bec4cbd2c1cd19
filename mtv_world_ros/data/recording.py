"""Recorded episodes at the model's size, all views on one clock, and their commands.

V views, N recorded frames, T frames a chunk, J joints, H W the model's size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
import hashlib
from pathlib import Path

import numpy as np

from mtv_world_ros.cameras.camera import camera_poses, scaled
from mtv_world_ros.cameras.mask_geometry import centroids
from mtv_world_ros.core.data_types import (
    ByteArray,
    CameraModel,
    FloatArray,
    JointTrajectory,
    Observation,
    WorldModelSpec,
)
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.images import resize_frames, resize_labels
from mtv_world_ros.data.bag_mapping import BagMapping, EpisodeSource
from mtv_world_ros.data.episode import Episode, MASKS_BY, Track
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.joint_plans import complete_plans
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.resample import match_joints, nearest_rows
from mtv_world_ros.vision.describers.describer import name_objects
from mtv_world_ros.vision.object_tracks import track_points

DEFAULT = EpisodeSource()
#: largest distance of a frame from the wanted time, as a share of the model's period
MAX_FRAME_OFFSET = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """One episode at the model's size, all views on the first view's clock.

    Attributes:
        path: folder of the episode.
        task: name of the task.
        outcome: `success`, `failure` or `unknown`.
        instruction: text for the robot.
        objects: names of the objects by the episode; what `object_ids` stand for.
        described: names of the objects by a describer; empty = not described.
        masks_by: the segmenter that made `object_ids`; empty = they are the simulator's.
        camera_tracks: (N, 4, 4) T_mount_camera [m] of views whose camera moves against the
            robot's links; see `cameras_at`.
        cameras: V cameras at the model's size.
        times: (N,) [s] since the first frame, increasing.
        frames: (V, N, H, W, 3) uint8 RGB.
        object_ids: (V, N, H, W) uint8, 0 = none, i + 1 = objects[i]; None where not recorded.
        positions: (N, J) measured joint positions at `times`.
        commands: the policy's joint commands; times on the same clock.
        stamp_ns: stamp of the first frame.
        object_poses: (N, O, 4, 4) T_base_object [m] at `times`: recorded, or of masks in two
            views, then NaN until seen; None where neither is there.
        warnings: problems found and how the reader handled them.
        place: name of the robot cell; empty = not stated.
        digest: digest of the measured joint motion, by which an episode is known again: it stays
            the same in copies, in imports and with other cameras; empty = not known.
        recorded: frames and camera of each of the V views at the recorded size; empty = read from
            a cache.
    """

    path: Path
    task: str
    outcome: str
    instruction: str
    objects: tuple[str, ...]
    cameras: tuple[CameraModel, ...]
    times: FloatArray
    frames: ByteArray
    object_ids: ByteArray | None
    positions: FloatArray
    commands: JointTrajectory
    stamp_ns: int
    object_poses: FloatArray | None = None
    described: tuple[str, ...] = ()
    masks_by: str = ''
    place: str = ''
    digest: str = ''
    camera_tracks: Mapping[str, FloatArray] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    recorded: tuple[tuple[Track, CameraModel], ...] = ()

    def seen_at(self, frame: int) -> tuple[ByteArray, tuple[CameraModel, ...]]:
        """Return a frame (V, H, W, 3) and its V cameras, as the robot saw it.

        At the recorded size, which shows better where objects are; at the model's where the views
        differ in size, or are not known any more.
        """
        cameras = self.cameras_at(frame)
        stamp = np.array([self.stamp_ns + round(float(self.times[frame]) * 1e9)])
        shown = [t.frames[int(nearest_rows(t.stamps_ns, stamp)[0])] for t, _ in self.recorded]
        sizes = {image.shape[:2] for image in shown}
        if len(sizes) != 1 or sizes != {(c.height, c.width) for _, c in self.recorded}:
            return self.frames[:, frame], cameras
        posed = zip(self.recorded, cameras, strict=True)
        return np.stack(shown), tuple(
            replace(own, T_mount_camera=now.T_mount_camera) for (_, own), now in posed
        )

    def observation(self, frame: int) -> Observation:
        """Return the observation at a recorded frame: images and joint positions."""
        frames, cameras = self.seen_at(frame)
        return Observation(
            cameras=cameras,
            frames=frames,
            positions=self.positions[frame],
            stamp_ns=self.stamp_ns + round(float(self.times[frame]) * 1e9),
            place=self.place,
        )

    def cameras_at(self, frame: int) -> tuple[CameraModel, ...]:
        """Return the V cameras as they are at a frame.

        What starts there is drawn as if they stayed there, in training as in serving: where a
        camera that no joint of the robot moves will go is not known.
        """
        tracks = self.camera_tracks
        return tuple(
            replace(c, T_mount_camera=tracks[c.view][frame]) if c.view in tracks else c
            for c in self.cameras
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects that are drawn and scored."""
        return name_objects(self.instruction, given=self.described, stored=self.objects)


def stitch(trajectories: Sequence[tuple[int, JointTrajectory]], origin_ns: int) -> JointTrajectory:
    """Join trajectory messages into one; each counts until the next one starts.

    Args:
        trajectories: pairs of a start stamp [ns] and a trajectory, all with the same joint names,
            in any order.
        origin_ns: zero of the result's clock.

    Raises:
        EpisodeError: there is none.
    """
    if not trajectories:
        raise EpisodeError('the episode has no joint_trajectory message')
    ordered = sorted(trajectories, key=lambda item: item[0])
    times, positions, velocities = [], [], []
    for index, (stamp, trajectory) in enumerate(ordered):
        starts = (stamp - origin_ns) * 1e-9
        last = index + 1 == len(ordered)
        ends = np.inf if last else (ordered[index + 1][0] - origin_ns) * 1e-9
        absolute = trajectory.times + starts
        begins = times[-1][-1] if times else -np.inf
        kept = (absolute <= ends + 1e-9) & (absolute > begins + 1e-6)
        if not kept.any():
            continue
        times.append(absolute[kept])
        positions.append(trajectory.positions[kept])
        if trajectory.velocities is not None:
            velocities.append(trajectory.velocities[kept])
    whole = len(velocities) == len(times)
    return JointTrajectory(
        joint_names=ordered[0][1].joint_names,
        times=np.concatenate(times),
        positions=np.concatenate(positions),
        velocities=np.concatenate(velocities) if whole else None,
    )


def load_recording(
    path: Path, spec: WorldModelSpec, robot: RobotModel, *, source: EpisodeSource = DEFAULT
) -> Recording:
    """Read an episode at the model's size.

    Raises:
        EpisodeError: the episode lacks a view, joint states or commands.
        TrajectoryError: its joints are not the robot's.
    """
    episode = read_episode(
        path,
        views=spec.views,
        calibration=source.calibration,
        mapping=source.mapping,
        robot=robot,
    )
    stamps = episode.images[spec.views[0]][0]
    if len(stamps) == 0:
        raise EpisodeError(f"episode '{path}' has no frames of view '{spec.views[0]}'")
    frames = [_on_clock(episode, view, stamps, spec) for view in spec.views]
    origin = int(stamps[0])
    positions = measured_positions(episode, robot, stamps)
    return Recording(
        path=Path(path),
        task=episode.info.task,
        outcome=episode.info.outcome,
        instruction=episode.info.instruction,
        objects=episode.info.objects,
        cameras=tuple(
            scaled(episode.cameras[view], spec.width, spec.height) for view in spec.views
        ),
        times=np.asarray((stamps - origin) * 1e-9, np.float64),
        frames=np.stack(frames),
        object_ids=_object_ids(episode, stamps, spec),
        positions=positions,
        commands=stitched_commands(episode, robot, origin),
        stamp_ns=origin,
        object_poses=_object_poses(episode, robot, spec.views, stamps, positions),
        masks_by=episode.info.metadata.get(MASKS_BY, ''),
        place=episode.info.place,
        digest=motion_digest(episode),
        camera_tracks={
            view: track[nearest_rows(np.asarray(episode.images[view].stamps_ns), stamps)]
            for view, track in episode.camera_tracks.items()
        },
        warnings=episode.warnings,
        recorded=tuple((episode.images[view], episode.cameras[view]) for view in spec.views),
    )


def _on_clock(episode: Episode, view: str, stamps: np.ndarray, spec: WorldModelSpec) -> ByteArray:
    own_stamps, frames = episode.images[view]
    if len(own_stamps) == 0:
        raise EpisodeError(f"episode '{episode.info.path}' has no frames of view '{view}'")
    index = nearest_rows(np.asarray(own_stamps), stamps)
    return resize_frames(np.asarray(frames), spec.width, spec.height)[index]


def _object_ids(episode: Episode, stamps: np.ndarray, spec: WorldModelSpec) -> ByteArray | None:
    if not episode.masks or any(view not in episode.masks for view in spec.views):
        return None
    rows = []
    for view in spec.views:
        own_stamps, ids = episode.masks[view]
        small = resize_labels(np.asarray(ids), spec.width, spec.height)
        rows.append(small[nearest_rows(np.asarray(own_stamps), stamps)])
    return np.stack(rows)


def _object_poses(
    episode: Episode,
    robot: RobotModel,
    views: Sequence[str],
    stamps: np.ndarray,
    positions: FloatArray,
) -> FloatArray | None:
    """Return (N, O, 4, 4) of the instants nearest to the frames.

    Not turned where masks alone tell.
    """
    found = episode.object_poses
    if found is not None and len(found.stamps_ns):
        return found.T_base_object[nearest_rows(found.stamps_ns, stamps)]
    still = [view for view in views if view not in episode.camera_tracks]
    seen = [view for view in still if episode.masks and view in episode.masks]
    if len(seen) < 2 or not episode.info.objects:
        return None
    cameras = [episode.cameras[view] for view in seen]
    poses = np.stack([camera_poses(camera, robot, positions) for camera in cameras])
    pixels = np.stack([_middles(episode, view, stamps) for view in seen])
    points = track_points(cameras, poses, pixels)
    if not np.isfinite(points).any():
        return None
    tracked = np.tile(np.eye(4), (*points.shape[:2], 1, 1))
    tracked[..., :3, 3] = points
    return tracked


def _middles(episode: Episode, view: str, stamps: np.ndarray) -> FloatArray:
    """Return (N, O, 2) middles of a view's masks at the frames [px], NaN = not seen."""
    assert episode.masks is not None
    own_stamps, ids = episode.masks[view]
    numbers = np.arange(len(episode.info.objects))[:, None, None] + 1
    rows = nearest_rows(np.asarray(own_stamps), stamps)
    return np.stack([centroids(np.asarray(ids[row]) == numbers) for row in rows])


def stitched_commands(episode: Episode, robot: RobotModel, origin_ns: int) -> JointTrajectory:
    """Return the commands in the robot's joint order; see `stitch`, `complete_plans`."""
    chunk_s = BagMapping().chunk_s
    whole, _ = complete_plans(episode.trajectories, episode.joint_states, robot, chunk_s)
    matched = [(s, match_joints(t, robot)) for s, t in whole]
    return stitch(matched, origin_ns)


def measured_positions(episode: Episode, robot: RobotModel, stamps: np.ndarray) -> FloatArray:
    """Return the joint states (T, J) at stamps (T,) [ns], in the robot's joint order.

    Raises:
        EpisodeError: the episode has no joint states.
        TrajectoryError: the joint states lack joints of the robot.
    """
    states = episode.joint_states
    if states is None or len(states.stamps_ns) == 0:
        raise EpisodeError(f"episode '{episode.info.path}' has no joint_states")
    return states.at(stamps, robot)


#: decimals of joint positions in a digest: rosbags and tables store more
_DIGEST_DECIMALS = 4


def motion_digest(episode: Episode) -> str:
    """Return a digest of the measured joint positions; empty without joint states.

    Stamps are left out, since imports of tables set them; so is the order of the joints.
    """
    states = episode.joint_states
    if states is None or len(states.stamps_ns) == 0:
        return ''
    order = np.argsort(states.joint_names)
    positions = np.round(states.positions[:, order], _DIGEST_DECIMALS) + 0.0  # no -0.0
    names = ','.join(sorted(states.joint_names))
    return hashlib.sha256(names.encode() + positions.astype('<f8').tobytes()).hexdigest()[:16]


def frame_indices(
    recording: Recording, start: int, spec: WorldModelSpec, num_frames: int | None = None
) -> np.ndarray | None:
    """Return the recorded frames that stand for the model's clock from frame `start` on.

    Returns:
        (1 + T,) indices, or None where the recording ends or has a gap.
    """
    count = spec.num_frames if num_frames is None else num_frames
    wanted = recording.times[start] + np.arange(count + 1) / spec.fps
    index = nearest_rows(recording.times, wanted)
    offset = np.abs(recording.times[index] - wanted)
    return index if (offset <= MAX_FRAME_OFFSET / spec.fps).all() else None


def commands_from(recording: Recording, start: int) -> JointTrajectory:
    """Return the commands that are due after frame `start`, counted from it."""
    times = recording.commands.times - recording.times[start]
    due = times > 1e-6
    if not due.any():
        due[-1] = True
        times = np.where(due, 1e-3, times)
    return recording.commands.points(due, times)
