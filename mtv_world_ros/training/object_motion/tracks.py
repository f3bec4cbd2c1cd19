"""How objects moved in recorded episodes, and under which commands.

T steps, O objects, A tools, V views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mtv_world_ros.data.episode import Episode, Track
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.recording import stitch
from mtv_world_ros.data_types import BoolArray, CameraModel, FloatArray
from mtv_world_ros.errors import EpisodeError
from mtv_world_ros.geometry.camera import camera_poses
from mtv_world_ros.geometry.mask_geometry import centroids, locate_all
from mtv_world_ros.geometry.object_shape import object_shapes
from mtv_world_ros.geometry.resample import match_joints, nearest_rows, resample
from mtv_world_ros.geometry.robot import RobotModel
from mtv_world_ros.model.object_motion.network import STEP_S


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectTracks:
    """One episode at the network's steps; row 0 is the first frame.

    Attributes:
        features: (O, V, F) of `object_shapes`.
        tools: (T + 1, A, 4, 4) T_base_tool as commanded.
        openings: (T + 1, A) as commanded.
        points: (T + 1, O, 3) [m], from where the first frame's masks have the objects.
        rotations: (T + 1, O, 3, 3) from the start.
        known: (T + 1, O) bool.
        turns_known: the rotations are recorded, not taken to be none.
    """

    features: FloatArray
    tools: FloatArray
    openings: FloatArray
    points: FloatArray
    rotations: FloatArray
    known: BoolArray
    turns_known: bool


def object_tracks(path: Path, robot: RobotModel, views: Sequence[str]) -> ObjectTracks:
    """Reads an episode.

    Where the objects are is taken from its `/object_poses`, or else from its masks.

    Raises:
        EpisodeError: it lacks masks in the first frame, joint states or commands, or no object is
            seen by two views.
    """
    episode = read_episode(path, views=tuple(views))
    states = episode.joint_states
    if episode.masks is None or states is None or not episode.trajectories:
        raise EpisodeError(f"'{path}' has no object masks, joint states or commands")
    masks = {view: episode.masks[view] for view in views}
    origin = int(masks[views[0]].stamps_ns[0])
    matched = [(stamp, match_joints(t, robot, None)) for stamp, t in episode.trajectories]
    columns = [states.joint_names.index(name) for name in robot.joint_names]
    commands = stitch(matched, origin)
    count = int(_last_ns(episode, masks, origin) / 1e9 / STEP_S + 1e-6)
    times = np.arange(count + 1, dtype=np.float64) * STEP_S
    positions = resample(commands, states.positions[0][columns], times)
    cameras = [episode.cameras[view] for view in views]
    poses = np.stack([camera_poses(camera, robot, positions) for camera in cameras])
    first = _ids_to_masks([masks[view].frames[0] for view in views], len(episode.info.objects))
    start = locate_all(cameras, list(poses[:, 0]), centroids(first))
    if not np.isfinite(start).any():
        raise EpisodeError(f"'{path}': no object is seen by two views in the first frame")
    points, rotations, known = _moved(episode, masks, start, cameras, poses, origin + times * 1e9)
    return ObjectTracks(
        features=object_shapes(first, start, cameras, list(poses[:, 0])),
        tools=robot.tool_poses(positions).transpose(1, 0, 2, 3),
        openings=robot.gripper_openings(positions).T,
        points=np.nan_to_num(points),
        rotations=rotations,
        known=known & np.isfinite(start).all(-1),
        turns_known=episode.object_poses is not None,
    )


def _last_ns(episode: Episode, masks: dict[str, Track], origin: int) -> float:
    found = episode.object_poses
    stamps = masks[next(iter(masks))].stamps_ns if found is None else found.stamps_ns
    return float(stamps[-1] - origin)


def _moved(
    episode: Episode,
    masks: dict[str, Track],
    start: FloatArray,
    cameras: Sequence[CameraModel],
    poses: FloatArray,
    wanted_ns: FloatArray,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    found, num = episode.object_poses, len(wanted_ns)
    if found is not None:
        rows = nearest_rows(found.stamps_ns, wanted_ns)
        T = found.T_base_object[rows]
        points = start + T[..., :3, 3] - found.T_base_object[0, :, :3, 3]
        turns = T[..., :3, :3] @ np.swapaxes(found.T_base_object[0, :, :3, :3], -1, -2)
        return points, turns, np.ones(points.shape[:2], bool)
    points = np.full((num, *start.shape), np.nan)
    for step in range(num):
        frames = [
            track.frames[int(nearest_rows(track.stamps_ns, wanted_ns[step : step + 1])[0])]
            for track in masks.values()
        ]
        seen = _ids_to_masks(frames, len(start))
        points[step] = locate_all(cameras, list(poses[:, step]), centroids(seen))
    known = np.asarray(np.isfinite(points).all(-1))
    turns = np.broadcast_to(np.eye(3), (num, len(start), 3, 3))
    return np.where(known[..., None], points, start), np.array(turns), known


def _ids_to_masks(ids: Sequence[np.ndarray], num_objects: int) -> BoolArray:
    return np.stack([np.stack(ids) == number + 1 for number in range(num_objects)], axis=1)
