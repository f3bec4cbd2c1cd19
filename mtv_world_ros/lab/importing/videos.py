"""Recordings that are video files and tables of joints or tool poses, a row a frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import csv
from dataclasses import dataclass
from glob import escape
from itertools import islice
import json
from pathlib import Path
from typing import Annotated, Any

import av
import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, PrivateAttr

from mtv_world_ros.bounded_input import check_limit, parse_json, read_text
from mtv_world_ros.config import read_yaml, validated, wrong
from mtv_world_ros.data.bag_mapping import BagMapping, ViewSource, Written
from mtv_world_ros.data.episode import Episode, EpisodeInfo, JointStates, Track
from mtv_world_ros.data.joint_plans import following
from mtv_world_ros.data_types import ByteArray, FloatArray
from mtv_world_ros.errors import ConfigError, EpisodeError
from mtv_world_ros.geometry.calibration_file import load_calibration
from mtv_world_ros.geometry.camera import scaled, unknown_camera
from mtv_world_ros.geometry.robot.file import save_robot
from mtv_world_ros.geometry.robot.joint_columns import to_positions
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.lab.importing.bags import write_imported
from mtv_world_ros.lab.importing.convert import import_each, ImportSummary, START_NS
from mtv_world_ros.lab.importing.mapping import ActionStream, digest_of, load_mapped_robot
from mtv_world_ros.lab.importing.stored_objects import AS_RECORDED, ObjectStage
from mtv_world_ros.lab.importing.tool_poses import joints_of_poses


def _inside(pattern: str) -> str:
    path = Path(pattern)
    if path.is_absolute() or '..' in path.parts:
        raise wrong('a path inside of the folder of recordings')
    return pattern


class VideoMapping(Written):
    """A mapping file of videos and tables; `{name}` in a path is the recording's name."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    robot: Annotated[RobotModel, BeforeValidator(load_mapped_robot)] = Field(
        description="name of a bundled robot, or a robot's YAML relative to this file"
    )
    rows: Annotated[str, AfterValidator(_inside)] = Field(
        description='JSON or CSV file of each recording, e.g. `joints/{name}.json`'
    )
    views: dict[str, str] = Field(description='video file by view, e.g. `videos/{name}/0.mp4`')
    state: ActionStream = Field(description='measured joints, or poses of tools, of each row')
    fps: float | None = Field(
        default=None, gt=0, le=1000, description='rows a second, without `time`'
    )
    time: str = Field(default='', description='column or key of the time of each row [s]')
    instruction: str = Field(default='', description='text, or `key: NAME` of the JSON file')
    _robot_file: Path = PrivateAttr(default=Path())

    @property
    def robot_file(self) -> Path:
        """The robot's YAML."""
        return self._robot_file

    def written(self) -> BagMapping:
        """Task, outcome and quality of the episodes that are written."""
        given = {name: getattr(self, name) for name in Written.model_fields}
        return BagMapping(**given, views={view: ViewSource(image=view) for view in self.views})


def load_video_mapping(path: Path) -> VideoMapping:
    """Reads a mapping file; `config/datasets/videos.yaml` describes its keys.

    Raises:
        ConfigError: the file is missing, not YAML, or has unknown, missing or wrong values.
        RobotError: the robot cannot be used.
    """
    context: dict[str, Any] = {'folder': path.parent}
    mapping = validated(
        VideoMapping, read_yaml(path, 'mapping file', '--mapping'), str(path), context=context
    )
    for what in (mapping.rows, *mapping.views.values()):
        if '{name}' not in what:
            raise ConfigError(f"'{path}': '{what}' must have {{name}}, the recording's name")
    if not mapping.views:
        raise ConfigError(f"'{path}': 'views' is empty; name at least one")
    if (mapping.fps is None) == (not mapping.time):
        raise ConfigError(f"'{path}': give either 'fps' or 'time'")
    if mapping.state.differences or 'delay_frames' in mapping.state.model_fields_set:
        raise ConfigError(
            f"'{path}': 'state' is what was measured; 'differences' and 'delay_frames' are of "
            'commands'
        )
    mapping._robot_file = context['robot_file']
    return mapping


@dataclass(frozen=True, slots=True)
class VideoRecording:
    """One recording: its name in a folder."""

    folder: Path
    name: str

    def file(self, pattern: str) -> Path:
        """A file of it."""
        return self.folder / pattern.replace('{name}', self.name)


def find_recordings(folder: Path, mapping: VideoMapping) -> list[VideoRecording]:
    """Returns the recordings of a folder that have a file of rows, by name.

    Raises:
        EpisodeError: there is none.
    """
    before, _, after = mapping.rows.partition('{name}')
    found = []
    for path in folder.glob(f'{escape(before)}*{escape(after)}'):
        text = path.relative_to(folder).as_posix()
        name = text[len(before) : len(text) - len(after)]
        if path.is_file() and name and '/' not in name:
            found.append(VideoRecording(folder, name))
    if not found:
        raise EpisodeError(f"'{folder}' has no '{mapping.rows}'; give the folder that has them")
    return sorted(found, key=lambda one: one.name)


def import_videos(
    folder: Path,
    out: Path,
    mapping: VideoMapping,
    *,
    calibration: Path | None = None,
    stage: ObjectStage = AS_RECORDED,
    progress: Callable[[Iterable[VideoRecording]], Iterable[VideoRecording]] = iter,
) -> ImportSummary[VideoRecording]:
    """Converts the recordings of a folder into episodes `out/<name>`, with `out/robot/` beside.

    Args:
        folder: of the files that the mapping names.
        out: folder of the episodes.
        mapping: which file and column is what.
        calibration: file of the cameras; None = not known.
        stage: names the objects and finds their masks.
        progress: wraps the recordings, e.g. in a progress bar.

    Raises:
        EpisodeError: there is no recording.
    """
    recordings = find_recordings(folder, mapping)
    saved = save_robot(mapping.robot_file, out / 'robot')
    text = mapping.model_dump_json(exclude={'robot'}).encode()
    key = digest_of(mapping.robot_file, calibration, start=stage.key + text)

    def convert(one: VideoRecording, path: Path) -> tuple[str, ...]:
        episode = read_recording(one, mapping, calibration)
        written = mapping.written()
        return write_imported(episode, one.name, path, written, mapping.robot, key, stage)

    summary = import_each(progress(recordings), key, lambda one: out / one.name, convert)
    summary.robot_notes = saved.notes
    return summary


def read_recording(
    recording: VideoRecording,
    mapping: VideoMapping,
    calibration: Path | None = None,
) -> Episode:
    """Reads a recording as an episode whose commands are the positions that follow.

    Frame k belongs to row k. A view without calibration gets a placeholder and is named in
    `unknown`.

    Raises:
        EpisodeError: a file is missing or cannot be read, or its rows cannot be used.
        ConfigError: a column is not there.
    """
    path = recording.file(mapping.rows)
    values, names, keys = read_rows(path, mapping.state.feature)
    stamps = START_NS + np.round(_times(values, keys, mapping, path) * 1e9).astype(np.int64)
    positions, notes = _positions(values, names, mapping, path)
    images, cameras, unknown = {}, {}, {}
    known = {} if calibration is None else load_calibration(calibration)
    for view, pattern in mapping.views.items():
        frames = VideoFileFrames(recording.file(pattern))
        if abs(len(frames) - len(stamps)) > 0:
            notes.append(
                f"view '{view}': {len(frames)} frames and {len(stamps)} rows: frame k is taken to "
                'belong to row k, and what is longer is left out'
            )
        count = min(len(frames), len(stamps))
        images[view] = Track(stamps[:count], frames.first(count))
        height, width = frames[0].shape[:2]
        if view in known:
            cameras[view] = scaled(known[view], width, height)
        else:
            unknown[view] = 'pose and intrinsics'
            cameras[view] = unknown_camera(view, width, height, mapping.robot.base_link)
    states = JointStates(
        stamps_ns=stamps, joint_names=mapping.robot.joint_names, positions=positions
    )
    info = EpisodeInfo(path=path, instruction=_instruction(keys, mapping, path))
    return Episode(
        info=info,
        views=tuple(mapping.views),
        cameras=cameras,
        images=images,
        joint_states=states,
        trajectories=following(states, mapping.chunk_s, int(stamps[0])),
        masks=None,
        instructions=[],
        unknown=unknown,
        warnings=tuple(notes),
    )


def _positions(
    values: FloatArray, names: Sequence[str], mapping: VideoMapping, path: Path
) -> tuple[FloatArray, list[str]]:
    """(T, J) [rad or m], and what was odd; joints of tool poses by inverse kinematics."""
    stream, robot = mapping.state, mapping.robot
    positions = np.tile(np.clip(0.0, robot.lower, robot.upper), (len(values), 1))
    at = [robot.joint_names.index(column.joint) for column in stream.columns]
    positions[:, at] = to_positions(values, names, stream.columns, stream.feature or path.name)
    notes = []
    for arm, poses in stream.tools.items():
        wanted = poses.wanted(values, names, stream.feature or path.name)
        notes.append(joints_of_poses(positions, robot, arm, poses, wanted))
    return positions, notes


def read_rows(path: Path, feature: str) -> tuple[FloatArray, tuple[str, ...], Mapping[str, Any]]:
    """Reads a table: values (T, C), names of the columns where there are any, everything by key.

    Args:
        path: CSV with a head, or JSON: an object of lists.
        feature: key of the JSON file whose rows are wanted; of a CSV file all columns are.

    Raises:
        EpisodeError: the file is missing, or no such table.
    """
    try:
        text = read_text(path, 'json_bytes')
        if path.suffix.lower() == '.csv':
            head, *rows = list(csv.reader(text.splitlines()))
            table = np.array(rows, float)
            columns = tuple(name.strip() for name in head)
            return table, columns, dict(zip(columns, table.T, strict=True))
        keys = parse_json(text, str(path))
        table = np.asarray(keys[feature], float)
    except (ConfigError, OSError, ValueError, TypeError, json.JSONDecodeError) as error:
        raise EpisodeError(f"'{path}' cannot be read as a table of numbers: {error}") from error
    except KeyError as error:
        raise EpisodeError(
            f"'{path}' has no '{feature}'; it has {', '.join(map(str, keys))}"
        ) from error
    if table.ndim != 2 or len(table) < 2 or not np.isfinite(table).all():
        raise EpisodeError(f"'{path}': '{feature}' is {table.shape}, must be (rows, columns)")
    return table, (), keys


def _times(
    values: FloatArray, keys: Mapping[str, Any], mapping: VideoMapping, path: Path
) -> FloatArray:
    """(T,) from 0 on [s]."""
    if mapping.fps is not None:
        return np.arange(len(values)) / mapping.fps
    if mapping.time not in keys:
        raise EpisodeError(f"'{path}' has no '{mapping.time}'; it has {', '.join(keys)}")
    times = np.asarray(keys[mapping.time], float).ravel()
    if len(times) != len(values) or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise EpisodeError(f"'{path}': '{mapping.time}' must increase, once a row")
    return times - times[0]


def _instruction(keys: Mapping[str, Any], mapping: VideoMapping, path: Path) -> str:
    word, _, name = mapping.instruction.partition('key:')
    if word or not name:
        return mapping.instruction
    value = keys.get(name.strip(), '')
    return str(value[0]) if isinstance(value, list) and value else str(value)


class VideoFileFrames:
    """The first `count` frames (None = all) of a video file, decoded one after the other.

    Raises:
        EpisodeError: the file is missing or damaged, or holds no video.
    """

    def __init__(self, path: Path, count: int | None = None) -> None:
        self._path = path
        self._count = sum(1 for _ in self._packets()) if count is None else count
        self._decoded: Iterator[ByteArray] = iter(())
        self._next, self._last = self._count, np.zeros((0, 0, 3), np.uint8)
        if self._count == 0:
            raise EpisodeError(f"'{path}' holds no frame")

    def first(self, count: int) -> VideoFileFrames:
        """The first frames alone."""
        return VideoFileFrames(self._path, count)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> ByteArray:
        if isinstance(index, slice):
            return np.stack([self._frame(i) for i in range(*index.indices(self._count))])
        if np.ndim(index):
            return np.stack([self._frame(int(i)) for i in index])
        return self._frame(int(index))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return self[:]

    def _frame(self, index: int) -> ByteArray:
        index += self._count if index < 0 else 0
        if not 0 <= index < self._count:
            raise IndexError(index)
        if index == self._next - 1 and self._last.size:
            return self._last
        if index < self._next:
            self._decoded, self._next = self._packets(), 0
        found = next(islice(self._decoded, index - self._next, None), None)
        if found is None:
            raise EpisodeError(f"'{self._path}' ends before frame {index}")
        self._next, self._last = index + 1, found
        return found

    def _packets(self) -> Iterator[ByteArray]:
        try:
            with av.open(str(self._path)) as container:
                if not container.streams.video:
                    raise EpisodeError(f"'{self._path}' holds no video")
                for frame in container.decode(video=0):
                    check_limit('image_pixels', frame.width * frame.height, 'a frame')
                    yield np.asarray(frame.to_ndarray(format='rgb24'), np.uint8)
        except (av.FFmpegError, OSError, ValueError) as error:
            raise EpisodeError(f"video '{self._path}' cannot be read: {error}") from error
