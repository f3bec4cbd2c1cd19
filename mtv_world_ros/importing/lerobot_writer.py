"""Writer of episodes as a LeRobot dataset of format v3.0: parquet, MP4 or PNG, and metadata.

Layout as in huggingface/lerobot 0.4 (`src/lerobot/datasets/utils.py`, `lerobot_dataset.py`): files
of one episode each, which the format allows. A mapping is written next to the dataset; with it,
`import lerobot` reads the dataset back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
import json
from pathlib import Path
import tempfile
from typing import Any

import av
import numpy as np
import yaml

from mtv_world_ros.cameras.camera import scaled
from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray, WorldModelSpec
from mtv_world_ros.core.errors import EpisodeError, TrajectoryError
from mtv_world_ros.core.files import check_free, write_json
from mtv_world_ros.core.images import encode_png, resize_frames
from mtv_world_ros.data.episode_reader import read_episode, read_info
from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.importing.parquet_tables import pyarrow_modules
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.resample import nearest_rows, resample

#: maximum number of files in a folder
_CHUNK = 1000
#: encoder of videos
_CODEC = 'libx264'
#: pixel format of videos: the one that every player shows
_PIXEL_FORMAT = 'yuv420p'
#: bf: frames in the order in which they are shown; Rerun 0.41 plays no others without ffmpeg
_CODEC_OPTIONS = {'crf': '18', 'g': '2', 'bf': '0'}
_QUANTILES = {'q01': 0.01, 'q10': 0.1, 'q50': 0.5, 'q90': 0.9, 'q99': 0.99}
#: frames of a video that its statistics are of, spread evenly
_STATISTICS_FRAMES = 20
_DATA = 'data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet'
_VIDEO = 'videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4'
_EPISODES = 'meta/episodes/chunk-000/file-000.parquet'
_CAMERAS = 'meta/cameras/episode_{episode_index:06d}.json'
MAPPING = 'meta/mapping.yaml'


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rows:
    """An episode on the dataset's clock.

    Attributes:
        times: (T,) times of the rows [s].
        state: (T, J) measured joint positions [rad or m].
        action: (T, J) joint positions commanded one period later [rad or m].
        frames: (V, T, H, W, 3) uint8 RGB recorded frames.
        outcome: `success`, `failure` or `unknown`.
        task: text for the robot.
        cameras: cameras of the V views.
    """

    times: FloatArray
    state: FloatArray
    action: FloatArray
    frames: ByteArray
    outcome: str
    task: str
    cameras: tuple[CameraModel, ...]


def export_dataset(
    episodes: Sequence[Path],
    out: Path,
    robot: RobotModel,
    robot_name: str,
    fps: int,
    progress: Callable[[Sequence[Path]], Iterable[Path]] = iter,
    *,
    size: tuple[int, int] | None = None,
    as_videos: bool = True,
) -> int:
    """Write a dataset folder; return the number of episodes.

    Row k has the state and the images of time k / fps, and as action the command for the row
    after it. The folder is there once it is complete.

    Args:
        episodes: folders of episodes with the same views and image sizes.
        out: folder of the dataset.
        robot: robot whose order of joints is written.
        robot_name: bundled name or file of the robot, for the mapping.
        fps: rows a second [Hz].
        progress: wraps the episodes, e.g. in a progress bar.
        size: width and height of the images [px]; None = as recorded.
        as_videos: MP4 files; else PNG images in the tables, lossless and read without a decoder
            of videos.

    Raises:
        ConfigError: the folder exists, or pyarrow is not installed.
        EpisodeError: there is no episode, one lacks joint states or commands, or its views are
            not those of the others.
    """
    check_free(out, overwrite=None)
    pyarrow_modules()
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f'.{out.name}.') as folder:
        writer = _Writer(Path(folder) / 'dataset', robot, robot_name, fps, as_videos)
        writer.has_outcomes = all(read_info(path).outcome != 'unknown' for path in episodes)
        for path in progress(episodes):
            writer.add(_resized(_rows(path, robot, fps), size))
        writer.finish()
        writer.root.rename(out)
    return writer.num_episodes


def _rows(path: Path, robot: RobotModel, fps: int) -> _Rows:
    found = read_episode(path, with_masks=False)
    first = found.images[found.views[0]].frames
    if len(first) == 0:
        raise EpisodeError(f"episode '{path}' has no frames of view '{found.views[0]}'")
    height, width = first[0].shape[:2]
    spec = WorldModelSpec(
        views=found.views, fps=fps, num_frames=1, width=width, height=height, robot=robot.name
    )
    try:
        recording = load_recording(path, spec, robot)
    except TrajectoryError as error:
        raise EpisodeError(f"episode '{path}': {error}") from error
    if recording.camera_tracks:
        raise EpisodeError(
            f"episode '{path}': the camera of view '{min(recording.camera_tracks)}' moves by "
            'itself; a data set has one pose of each camera: leave the episode out'
        )
    count = int(recording.times[-1] * fps + 1e-6) + 1
    times = np.arange(count) / fps
    nearest = nearest_rows(recording.times, times)
    return _Rows(
        times=times,
        state=recording.positions[nearest],
        action=_commanded(recording, times + 1 / fps),
        frames=recording.frames[:, nearest],
        outcome=recording.outcome,
        task=recording.instruction or recording.task,
        cameras=recording.cameras,
    )


def _resized(rows: _Rows, size: tuple[int, int] | None) -> _Rows:
    if size is None:
        return rows
    return replace(
        rows,
        frames=np.stack([resize_frames(frames, *size) for frames in rows.frames]),
        cameras=tuple(scaled(camera, *size) for camera in rows.cameras),
    )


def _commanded(recording: Recording, times: FloatArray) -> FloatArray:
    """Return the commands (T, J); before the first command the measured start position."""
    return resample(recording.commands, recording.positions[0], times)


class _Writer:
    """Writer that adds episodes to a dataset.

    Attributes:
        root: folder of the dataset.
        num_episodes: number of written episodes.
        has_outcomes: the outcome of every episode is known.
    """

    def __init__(
        self, root: Path, robot: RobotModel, robot_name: str, fps: int, as_videos: bool
    ) -> None:
        self.root, self.num_episodes, self.has_outcomes = root, 0, False
        self._robot, self._robot_name, self._fps = robot, robot_name, fps
        self._as_videos = as_videos
        self._cameras: tuple[CameraModel, ...] = ()
        self._entries: list[dict[str, Any]] = []
        self._tasks: dict[str, int] = {}
        self._num_rows = 0
        self._samples: dict[str, list[np.ndarray]] = {}

    def add(self, rows: _Rows) -> None:
        """Write an episode's rows, videos and cameras."""
        self._check(rows)
        number = self.num_episodes
        place = {'chunk_index': number // _CHUNK, 'file_index': number % _CHUNK}
        task = self._tasks.setdefault(rows.task, len(self._tasks))
        count = len(rows.times)
        columns = {
            'observation.state': rows.state.astype(np.float32),
            'action': rows.action.astype(np.float32),
            'timestamp': rows.times.astype(np.float32),
            'frame_index': np.arange(count),
            'episode_index': np.full(count, number),
            'index': self._num_rows + np.arange(count),
            'task_index': np.full(count, task),
        }
        if self.has_outcomes:
            is_last = np.arange(count) == count - 1
            columns['next.success'] = is_last & (rows.outcome == 'success')
        pictures = {
            _image_key(camera): frames
            for camera, frames in zip(rows.cameras, rows.frames, strict=True)
        }
        cells = {} if self._as_videos else {key: _cells(x) for key, x in pictures.items()}
        _write_table(self.root / _DATA.format(**place), columns | cells)
        entry: dict[str, Any] = {
            'episode_index': number,
            'tasks': [rows.task],
            'length': count,
            'dataset_from_index': self._num_rows,
            'dataset_to_index': self._num_rows + count,
            'data/chunk_index': place['chunk_index'],
            'data/file_index': place['file_index'],
            'meta/episodes/chunk_index': 0,
            'meta/episodes/file_index': 0,
        }
        for key, frames in pictures.items():
            if self._as_videos:
                path = self.root / _VIDEO.format(video_key=key, **place)
                _write_video(path, frames, self._fps)
                entry |= {f'videos/{key}/{name}': value for name, value in place.items()}
                entry |= {f'videos/{key}/from_timestamp': 0.0}
                entry |= {f'videos/{key}/to_timestamp': count / self._fps}
            shown = frames[np.unique(np.linspace(0, count - 1, _STATISTICS_FRAMES).astype(int))]
            columns[key] = np.moveaxis(shown, -1, 0)[:, :, ::4, ::4].reshape(3, -1).T / 255.0
        for name, values in columns.items():
            self._samples.setdefault(name, []).append(values.reshape(len(values), -1))
        path = self.root / _CAMERAS.format(episode_index=number)
        write_json(path, {camera.view: _camera(camera) for camera in rows.cameras})
        self._entries.append(entry)
        self._num_rows += count
        self.num_episodes += 1

    def finish(self) -> None:
        """Write the metadata."""
        if not self._entries:
            raise EpisodeError('there is no episode to export; name a folder that holds some')
        names = list(self._entries[0])
        _write_table(
            self.root / _EPISODES, {name: [row[name] for row in self._entries] for name in names}
        )
        self._write_tasks()
        write_json(self.root / 'meta/info.json', self._info())
        statistics = {
            name: _statistics(np.concatenate(parts), name) for name, parts in self._samples.items()
        }
        write_json(self.root / 'meta/stats.json', statistics)
        text = yaml.safe_dump(self._mapping(), sort_keys=False)
        (self.root / MAPPING).write_text(text, encoding='utf-8')

    def _check(self, rows: _Rows) -> None:
        def look(cameras: Sequence[CameraModel]) -> list[tuple[str, int, int]]:
            return [(camera.view, camera.width, camera.height) for camera in cameras]

        self._cameras = self._cameras or rows.cameras
        if look(self._cameras) != look(rows.cameras):
            raise EpisodeError(
                f'episode {self.num_episodes} has the views {look(rows.cameras)}, the first one '
                f'{look(self._cameras)}; a dataset has one set of views and sizes'
            )
        is_odd = any(camera.width % 2 or camera.height % 2 for camera in rows.cameras)
        if self._as_videos and is_odd:
            raise EpisodeError(
                f'the images are {look(rows.cameras)}; MP4 needs an even width and height; '
                'give --size, or --images for PNG'
            )

    def _info(self) -> dict[str, Any]:
        joints = list(self._robot.joint_names)
        vector = {'dtype': 'float32', 'shape': [len(joints)], 'names': joints}
        features: dict[str, Any] = {'observation.state': vector, 'action': vector}
        for camera in self._cameras:
            features[_image_key(camera)] = {
                'dtype': 'video' if self._as_videos else 'image',
                'shape': [camera.height, camera.width, 3],
                'names': ['height', 'width', 'channels'],
            }
            if self._as_videos:
                features[_image_key(camera)]['info'] = {
                    'video.height': camera.height, 'video.width': camera.width,
                    'video.codec': 'h264', 'video.pix_fmt': _PIXEL_FORMAT,
                    'video.is_depth_map': False, 'video.fps': self._fps,
                    'video.channels': 3, 'has_audio': False,
                }  # fmt: skip
        if self.has_outcomes:
            features['next.success'] = {'dtype': 'bool', 'shape': [1], 'names': None}
        features['timestamp'] = {'dtype': 'float32', 'shape': [1], 'names': None}
        for name in ('frame_index', 'episode_index', 'index', 'task_index'):
            features[name] = {'dtype': 'int64', 'shape': [1], 'names': None}
        return {
            'codebase_version': 'v3.0',
            'robot_type': self._robot.name,
            'total_episodes': self.num_episodes,
            'total_frames': self._num_rows,
            'total_tasks': len(self._tasks),
            'chunks_size': _CHUNK,
            'data_files_size_in_mb': 100,
            'video_files_size_in_mb': 200,
            'fps': self._fps,
            'splits': {'train': f'0:{self.num_episodes}'},
            'data_path': _DATA,
            'video_path': _VIDEO if self._as_videos else None,
            'features': features,
        }

    def _write_tasks(self) -> None:
        """Write the texts as the index of a pandas table, as LeRobot looks them up."""
        table = {'task_index': list(self._tasks.values()), '__index_level_0__': list(self._tasks)}
        names = {'task_index': ('int64', 'int64'), '__index_level_0__': ('unicode', 'object')}
        pandas = {
            'index_columns': ['__index_level_0__'],
            'column_indexes': [],
            'columns': [
                {'name': name if kind == 'int64' else None, 'field_name': name,
                 'pandas_type': kind, 'numpy_type': numpy, 'metadata': None}
                for name, (kind, numpy) in names.items()
            ],
        }  # fmt: skip
        _write_table(self.root / 'meta/tasks.parquet', table, {'pandas': json.dumps(pandas)})

    def _mapping(self) -> dict[str, Any]:
        joints = {name: name for name in self._robot.joint_names}
        return {
            'robot': self._robot_name,
            'views': {
                camera.view: {
                    'feature': _image_key(camera),
                    'camera': {
                        'file': _CAMERAS,
                        'intrinsics': f'{camera.view}.K',
                        'extrinsics': f'{camera.view}.T_mount_camera',
                        'mount_link': camera.mount_link,
                        **(
                            {
                                'distortion': f'{camera.view}.distortion',
                                'distortion_model': camera.distortion_model,
                            }
                            if len(camera.distortion)
                            else {}
                        ),
                    },
                }
                for camera in self._cameras
            },
            'state': {'feature': 'observation.state', 'joints': joints},
            'action': {'feature': 'action', 'joints': joints, 'delay_frames': 1.0},
            **({'outcome_feature': 'next.success'} if self.has_outcomes else {}),
        }


def _image_key(camera: CameraModel) -> str:
    return f'observation.images.{camera.view}'


def _camera(camera: CameraModel) -> dict[str, Any]:
    return {
        'K': camera.K.tolist(),
        'T_mount_camera': camera.T_mount_camera.tolist(),
        'distortion': camera.distortion.tolist(),
    }


def _write_table(
    path: Path, columns: Mapping[str, Any], metadata: Mapping[str, str] | None = None
) -> None:
    pyarrow, parquet = pyarrow_modules()
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {}
    for name, values in columns.items():
        if isinstance(values, np.ndarray) and values.ndim == 2:
            kind = pyarrow.list_(pyarrow.float32(), values.shape[1])
            arrays[name] = pyarrow.array(values.tolist(), kind)
        else:
            arrays[name] = pyarrow.array(values)
    table = pyarrow.table(arrays)
    parquet.write_table(table.replace_schema_metadata(metadata) if metadata else table, path)


def _cells(frames: ByteArray) -> list[dict[str, bytes | str]]:
    """Return the images of a table, as `datasets.Image` stores them."""
    return [
        {'bytes': encode_png(frame), 'path': f'frame-{k:06d}.png'}
        for k, frame in enumerate(frames)
    ]


def _write_video(path: Path, frames: ByteArray, fps: int) -> None:
    """Write frames (T, H, W, 3), the first one at time 0."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), 'w') as container:
        stream = container.add_stream(_CODEC, rate=fps, options=_CODEC_OPTIONS)
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt, stream.time_base = _PIXEL_FORMAT, Fraction(1, fps)
        for number, image in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format='rgb24')
            frame.pts, frame.time_base = number, Fraction(1, fps)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _statistics(values: np.ndarray, name: str) -> dict[str, Any]:
    """Return the statistics for normalisation of (N, C) values.

    Those of images are (C, 1, 1) in [0, 1].
    """
    values = values.astype(np.float64)
    found = {
        'min': values.min(0), 'max': values.max(0), 'mean': values.mean(0), 'std': values.std(0),
        **{key: np.quantile(values, share, axis=0) for key, share in _QUANTILES.items()},
    }  # fmt: skip
    is_image = name.startswith('observation.images.')
    shaped = {key: value.reshape(-1, 1, 1) if is_image else value for key, value in found.items()}
    return {**{key: value.tolist() for key, value in shaped.items()}, 'count': [len(values)]}
