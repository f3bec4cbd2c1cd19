"""Clips cut from recordings on the model's clock, a cache of recordings, names by a describer.

V views, N recorded frames, T frames a chunk, J joints, H W the model's size.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
import hashlib
from io import BytesIO
import json
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.core.bounded_input import parse_json, read_arrays, require_regular
from mtv_world_ros.core.data_types import (
    ByteArray,
    CameraModel,
    FloatArray,
    JointTrajectory,
    WorldModelSpec,
)
from mtv_world_ros.core.errors import DescriptionError, EpisodeError
from mtv_world_ros.core.files import write_whole
from mtv_world_ros.data.bag_mapping import EpisodeSource
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.recording import (
    commands_from,
    DEFAULT,
    frame_indices,
    load_recording,
    Recording,
)
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.resample import cut_off, resample
from mtv_world_ros.vision.describers.describer import Describer, name_objects

#: reads the arrays of an .npz file by name, within a field of `Limits`
ArrayReader = Callable[[Path, str], dict[str, np.ndarray]]
#: to be increased when the stored data or their computation change
_VERSION = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Clip:
    """One chunk: the observed frame and the T frames that follow, with their commands.

    Attributes:
        cameras: V cameras at the model's size.
        objects: names; `object_ids` number them from 1.
        masks_by: the segmenter that made `object_ids`; empty = they are the simulator's.
        times: (1 + T,) [s] since the clip's start.
        frames: (V, 1 + T, H, W, 3) uint8 RGB.
        object_ids: (V, 1 + T, H, W) uint8 or None.
        positions: (1 + T, J); row 0 measured, row k the command of frame k.
        object_poses: (1 + T, O, 4, 4) T_base_object [m], or None.
        origin: the episode's first frame; None where object poses are not known.
    """

    cameras: tuple[CameraModel, ...]
    objects: tuple[str, ...]
    times: FloatArray
    frames: ByteArray
    object_ids: ByteArray | None
    positions: FloatArray
    object_poses: FloatArray | None = None
    origin: Origin | None = None
    masks_by: str = ''


@dataclass(frozen=True, slots=True)
class Origin:
    """The frame in which the objects of a clip were found.

    Attributes:
        frames: (V, H, W, 3) uint8 RGB.
        positions: (J,) measured joint positions.
        object_poses: (O, 4, 4) T_base_object [m].
        object_ids: (V, H, W) uint8 like those of the clip, or None.
    """

    frames: ByteArray
    positions: FloatArray
    object_poses: FloatArray
    object_ids: ByteArray | None


def clip_starts(recording: Recording, spec: WorldModelSpec) -> np.ndarray:
    """Return the frames from which a whole clip can be cut."""
    count = len(recording.times)
    whole = [i for i in range(count) if frame_indices(recording, i, spec) is not None]
    return np.array(whole, dtype=int)


def cut_clip(
    recording: Recording, start: int, spec: WorldModelSpec, num_frames: int | None = None
) -> Clip:
    """Cut the clip that starts at recorded frame `start`.

    Args:
        recording: recording of the episode.
        start: number of the recorded frame that the clip starts from.
        spec: spec of the model; its clock counts.
        num_frames: frames that follow the first one; default: those of a chunk.

    Raises:
        EpisodeError: the recording ends or has a gap within the clip.
    """
    count = spec.num_frames if num_frames is None else num_frames
    index = frame_indices(recording, start, spec, count)
    if index is None:
        raise EpisodeError(
            f"'{recording.path}': no whole clip of {count} frames at {spec.fps} Hz "
            f'starts at frame {start}'
        )
    times = np.arange(count + 1) / spec.fps
    ids = recording.object_ids
    return Clip(
        cameras=recording.cameras_at(start),
        objects=recording.objects,
        times=times,
        frames=recording.frames[:, index],
        object_ids=None if ids is None else ids[:, index],
        positions=commanded(recording, start, times),
        object_poses=None if recording.object_poses is None else recording.object_poses[index],
        origin=_origin(recording),
        masks_by=recording.masks_by,
    )


def _origin(recording: Recording) -> Origin | None:
    if recording.object_poses is None:
        return None
    ids = recording.object_ids
    return Origin(
        recording.frames[:, 0],
        recording.positions[0],
        recording.object_poses[0],
        None if ids is None else ids[:, 0],
    )


def commanded(recording: Recording, start: int, times: FloatArray) -> FloatArray:
    """Return (len(times), J) positions: measured at frame `start`, commanded after it.

    Args:
        recording: recording of the episode.
        start: recorded frame that is time zero.
        times: [s] since that frame, from 0 on.
    """
    shifted = commands_from(recording, start)
    positions = resample(shifted, recording.positions[start], times)
    return np.concatenate([recording.positions[start][None], positions[1:]])


def commands_until(recording: Recording, start: int, seconds: float) -> JointTrajectory:
    """Return the commands after frame `start`, relative to its time, cut off at `seconds`.

    No command is resampled, because motion between two frames can decide about contact. After the
    last command the arms hold their position.
    """
    return cut_off(commands_from(recording, start), recording.positions[start], seconds)


def commands_at(recording: Recording, rows: np.ndarray) -> FloatArray:
    """Return the joint positions (N, J) last commanded at rows, or measured before any [rad or m].

    Args:
        recording: recorded frames, joints and commands.
        rows: (N,) numbers of frames.
    """
    commands = recording.commands
    due = np.searchsorted(commands.times, recording.times[rows], side='right') - 1
    last = commands.positions[np.maximum(due, 0)]
    return np.where(due[:, None] >= 0, last, recording.positions[rows])


def described_objects(
    path: Path, describer: Describer, view: str, source: EpisodeSource = DEFAULT
) -> tuple[str, ...]:
    """Return the names that a describer gives to the objects of an episode's first frame.

    Raises:
        EpisodeError: the episode cannot be read, the describer failed, or saw no object.
    """
    episode = read_episode(
        path, views=[view], with_cameras=False, with_masks=False, mapping=source.mapping
    )
    try:
        names = name_objects(
            episode.info.instruction,
            describer=describer,
            first_frame=lambda: np.asarray(episode.images[view].frames[0]),
        )
    except DescriptionError as error:
        raise EpisodeError(f'its objects could not be named ({error.status}): {error}') from error
    if not names:
        raise EpisodeError('no object was seen in its first frame')
    return names


def cached_recording(
    path: Path,
    spec: WorldModelSpec,
    robot: RobotModel,
    cache: Path,
    source: EpisodeSource = DEFAULT,
    read: ArrayReader = read_arrays,
) -> Recording:
    """Return `load_recording`'s result, from the cache where it is current.

    The key holds the bag's files (name, size, time), views, size, and robot: a changed episode
    or setting misses the cache instead of using stale data.

    Args:
        path: folder of the episode.
        spec: views and size of the frames.
        robot: robot of the episode.
        cache: folder of the cache.
        source: topics and calibration of the episode.
        read: reads a file of the cache, as `read_arrays` does.
    """
    stored = cache / f'{recording_key(path, spec, robot, source)}.npz'
    if stored.is_file():
        with suppress(OSError, ValueError, LookupError, TypeError):
            return _load(stored, path, read)  # where it is damaged it is made anew
    recording = load_recording(path, spec, robot, source=source)
    archive = BytesIO()
    _save(archive, recording)
    write_whole(stored, archive.getvalue())
    # a reader that maps files must not leave the first recordings in memory
    return replace(recording, recorded=()) if read is read_arrays else _load(stored, path, read)


def recording_key(
    path: Path, spec: WorldModelSpec, robot: RobotModel, source: EpisodeSource = DEFAULT
) -> str:
    """Return the name of an episode's file in a cache, without its suffix; see `cached_recording`.

    Raises:
        OSError: the folder or its calibration cannot be read.
    """
    files = sorted((f.name, f.stat().st_size, f.stat().st_mtime_ns) for f in path.iterdir())
    parts = [_VERSION, str(path.resolve()), files, spec.views, spec.width, spec.height,
             robot.name, robot.joint_names]  # fmt: skip
    if source != DEFAULT:
        calibration = source.calibration
        require_regular(*filter(None, [calibration]))
        parts += [
            source.mapping.model_dump() if source.mapping else None,
            calibration.read_text() if calibration else None,
        ]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]


#: fields of a recording, of its commands and of a camera, as they are stored
_TEXT = ('task', 'outcome', 'instruction', 'objects', 'masks_by', 'place', 'stamp_ns', 'digest')
_ARRAYS = ('times', 'frames', 'positions', 'object_ids', 'object_poses')
_OF_COMMANDS = ('times', 'positions', 'velocities')
_OF_CAMERA = ('view', 'width', 'height', 'distortion_model', 'mount_link', 'error_px')


def _save(file: BytesIO, recording: Recording) -> None:
    cameras, commands = recording.cameras, recording.commands
    text = {name: getattr(recording, name) for name in _TEXT}
    text['joint_names'] = commands.joint_names
    text['cameras'] = [{name: getattr(one, name) for name in _OF_CAMERA} for one in cameras]
    arrays = {name: getattr(recording, name) for name in _ARRAYS}
    arrays |= {f'command_{name}': getattr(commands, name) for name in _OF_COMMANDS}
    arrays |= {f'track_{view}': track for view, track in recording.camera_tracks.items()}
    for index, camera in enumerate(cameras):
        arrays[f'K_{index}'] = camera.K
        arrays[f'distortion_{index}'] = camera.distortion
        arrays[f'pose_{index}'] = camera.T_mount_camera
    known = {name: array for name, array in arrays.items() if array is not None}
    np.savez(file, text=np.array(json.dumps(text)), **known)


def _load(file: Path, path: Path, read: ArrayReader) -> Recording:
    stored = read(file, 'video_bytes')
    text = parse_json(str(stored['text']), f"'{file}'")
    cameras = tuple(
        CameraModel(
            K=stored[f'K_{i}'],
            distortion=stored[f'distortion_{i}'],
            T_mount_camera=stored[f'pose_{i}'],
            **row,
        )
        for i, row in enumerate(text.pop('cameras'))
    )
    commands: dict[str, Any] = {name: stored.get(f'command_{name}') for name in _OF_COMMANDS}
    tracks = {camera.view: stored.get(f'track_{camera.view}') for camera in cameras}
    return Recording(
        path=path,
        cameras=cameras,
        commands=JointTrajectory(joint_names=text.pop('joint_names'), **commands),
        camera_tracks={view: track for view, track in tracks.items() if track is not None},
        **{name: stored.get(name) for name in _ARRAYS},
        **text | {'objects': tuple(text['objects'])},
    )
