"""Recordings that are videos and tables of joints or tool poses, a row a frame, or HDF5 files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from glob import escape
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, PrivateAttr

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.cameras.camera import unknown_camera
from mtv_world_ros.cameras.foreign_calibrations import ForeignCalibration, read_foreign
from mtv_world_ros.core.config import read_yaml, validated, wrong
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import CalibrationError, ConfigError, EpisodeError
from mtv_world_ros.data.bag_mapping import BagMapping, key_of, keyed, ViewSource, Written
from mtv_world_ros.data.episode import (
    Episode,
    EpisodeInfo,
    JointStates,
    OtherDirection,
    parse_outcome,
    Track,
)
from mtv_world_ros.data.gripper_sources import resting_grippers
from mtv_world_ros.data.joint_plans import trajectories_to
from mtv_world_ros.data.measured_joints import mend_rows
from mtv_world_ros.data.other_formats import unread_hint
from mtv_world_ros.data.stream_clocks import check_row_times
from mtv_world_ros.importing.bags import write_imported
from mtv_world_ros.importing.calibration_directions import settle_directions
from mtv_world_ros.importing.camera_parameters import sized_camera
from mtv_world_ros.importing.convert import import_each, ImportSummary, START_NS
from mtv_world_ros.importing.hdf5_files import (
    data_set_names,
    group_names,
    Hdf5Frames,
    is_hdf5,
    read_hdf5_table,
    split_inside,
)
from mtv_world_ros.importing.mapping import ActionStream, digest_of, load_mapped_robot
from mtv_world_ros.importing.number_tables import NumberTable, read_table
from mtv_world_ros.importing.stored_objects import AS_RECORDED, ObjectStage
from mtv_world_ros.importing.tool_poses import joints_of_poses
from mtv_world_ros.importing.unused_parts import unused_columns, unused_files, unused_keys
from mtv_world_ros.importing.video_frames import FrameTimes, match_frames, VideoFileFrames
from mtv_world_ros.robot.file import save_robot
from mtv_world_ros.robot.joint_columns import column_number, to_positions
from mtv_world_ros.robot.model import RobotModel

#: units of `time` in a second
_PER_SECOND = {'s': 1.0, 'ms': 1e3, 'us': 1e6, 'ns': 1e9}
#: settings that are not among those that older imports were made with
_LATER = ('time_unit', 'frame_times', 'action', 'channels')


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
        description='JSON, CSV or HDF5 file of each recording, e.g. `joints/{name}.json`; of '
        'several recordings in one HDF5 file their groups, e.g. `all.hdf5:data/{name}`'
    )
    views: dict[str, str] = Field(
        description='video file by view, e.g. `videos/{name}/0.mp4`, or images in an HDF5 file, '
        'e.g. `{name}.hdf5:observations/images/top`'
    )
    state: ActionStream = Field(
        description='measured joints, or poses of tools, of each row; of HDF5 files `feature` is '
        'a data set'
    )
    action: ActionStream | None = Field(
        default=None,
        description='commands of each row; null = the measured positions that follow',
    )
    channels: Literal['rgb', 'bgr'] = Field(
        default='rgb',
        description='order of the colours of images in HDF5 files; `bgr` where a player shows '
        'red as blue, as OpenCV stores them',
    )
    fps: float | None = Field(
        default=None, gt=0, le=1000, description='rows a second, without `time`'
    )
    time: str = Field(default='', description='column or key of the time of each row')
    time_unit: Literal['s', 'ms', 'us', 'ns'] = Field(default='s', description='of `time`')
    frame_times: FrameTimes = Field(
        default='auto',
        description='`video` = frames keep the times of the video, from the first row on; `rows` '
        '= frame k belongs to row k; `auto` = what number, rate and duration tell',
    )
    instruction: Annotated[str, BeforeValidator(keyed)] = Field(
        default='', description='text, or `key: NAME` of the file of rows'
    )
    _robot_file: Path = PrivateAttr(default=Path())

    @property
    def robot_file(self) -> Path:
        """The robot's YAML."""
        return self._robot_file

    @property
    def unused_settings(self) -> set[str]:
        """Settings that leave episodes of earlier versions as they are."""
        fields = type(self).model_fields
        return {key for key in _LATER if getattr(self, key) == fields[key].default}

    def written(self) -> BagMapping:
        """Return task, outcome and quality of the episodes that are written.

        An outcome that each recording has is that of what `read_recording` returns.
        """
        given = {name: getattr(self, name) for name in Written.model_fields}
        given |= {'outcome': 'unknown'} if key_of(self.outcome) else {}
        return BagMapping(**given, views={view: ViewSource(image=view) for view in self.views})


def load_video_mapping(path: Path) -> VideoMapping:
    """Read a mapping file; `config/datasets/videos.yaml` describes its keys.

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
    if mapping.action is not None and mapping.state.tools:
        raise ConfigError(f"'{path}': 'action' needs measured joints in 'state', not `tools`")
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
        """Return the path of a file of the recording."""
        return self.folder / split_inside(pattern)[0].replace('{name}', self.name)

    def inside(self, pattern: str) -> str:
        """Return the path in an HDF5 file; empty = the whole file."""
        return split_inside(pattern)[1].replace('{name}', self.name)


def find_recordings(folder: Path, mapping: VideoMapping) -> list[VideoRecording]:
    """Return the recordings of a folder that have a file of rows, by name.

    Raises:
        EpisodeError: there is none.
    """
    file, inside = split_inside(mapping.rows)
    if '{name}' not in file:
        return _in_one_file(folder, file, inside)
    before, _, after = file.partition('{name}')
    found = []
    for path in folder.glob(f'{escape(before)}*{escape(after)}'):
        text = path.relative_to(folder).as_posix()
        name = text[len(before) : len(text) - len(after)]
        if path.is_file() and name and '/' not in name:
            found.append(VideoRecording(folder, name))
    if not found:
        raise EpisodeError(
            f"'{folder}' has no '{mapping.rows}'; give the folder that has them"
            f'{unread_hint(folder)}'
        )
    return sorted(found, key=lambda one: one.name)


def _in_one_file(folder: Path, file: str, inside: str) -> list[VideoRecording]:
    """Return the recordings that are groups of one HDF5 file."""
    before, _, after = inside.partition('{name}')
    parent = before.rpartition('/')[0]
    names = [name for name in group_names(folder / file, parent) if name]
    start = before[len(parent) :].lstrip('/')
    end = after.partition('/')[0]
    found = [
        VideoRecording(folder, name[len(start) : len(name) - len(end)])
        for name in names
        if name.startswith(start) and name.endswith(end) and len(name) > len(start) + len(end)
    ]
    if not found:
        raise EpisodeError(f"'{folder / file}' has no group '{inside}'")
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
    """Convert the recordings of a folder into episodes `out/<name>`, robot in `out/robot/`.

    Args:
        folder: folder of the files that the mapping names.
        out: folder of the episodes.
        mapping: meaning of the files and columns.
        calibration: file of the cameras; None = not known.
        stage: names the objects and finds their masks.
        progress: wraps the recordings, e.g. in a progress bar.

    Raises:
        EpisodeError: there is no recording.
    """
    recordings = find_recordings(folder, mapping)
    saved = save_robot(mapping.robot_file, out / 'robot')
    text = mapping.model_dump_json(exclude={'robot', *mapping.unused_settings}).encode()
    key = digest_of(mapping.robot_file, calibration, start=stage.key + text)

    def convert(one: VideoRecording, path: Path) -> tuple[str, ...]:
        episode = settle_directions(read_recording(one, mapping, calibration), mapping.robot)
        written = mapping.written()
        return write_imported(episode, one.name, path, written, mapping.robot, key, stage)

    summary = import_each(progress(recordings), key, lambda one: out / one.name, convert)
    patterns = (mapping.rows, *mapping.views.values())
    used = [one.file(pattern) for one in recordings for pattern in patterns]
    if line := unused_files(folder, used, out):
        summary.notes = (line,)
    summary.robot_notes = saved.notes
    return summary


def read_recording(
    recording: VideoRecording,
    mapping: VideoMapping,
    calibration: Path | None = None,
) -> Episode:
    """Read a recording as an episode whose commands are the positions that follow.

    Frames are matched to rows by `match_frames`. A view without calibration gets a placeholder
    and is named in `unknown`.

    Raises:
        EpisodeError: a file is missing or cannot be read, or its rows cannot be used.
        ConfigError: a column is not there.
    """
    path = recording.file(mapping.rows)
    table = _table(recording, mapping, mapping.state)
    times, paused = _times(table, mapping)
    stamps = START_NS + np.round(times * 1e9).astype(np.int64)
    positions, notes = _positions(table, mapping)
    if not mapping.state.tools:
        positions, mended = mend_rows(path.name, times, positions, mapping.robot)
        notes += mended
    notes += paused
    images, cameras, unknown = {}, {}, {}
    given = _GivenCameras.of(calibration, mapping)
    notes += given.notes
    others = {}
    for view, pattern in mapping.views.items():
        frames = _frames(recording, pattern, mapping)
        try:
            images[view], said = _track(frames, times, mapping)
        except EpisodeError as error:
            raise EpisodeError(f"recording '{recording.name}', view '{view}': {error}") from error
        notes += [f"view '{view}': {text}" for text in said]
        height, width = frames[0].shape[:2]
        if view in given.cameras:
            found = sized_camera(given.cameras[view], (width, height))
            cameras[view] = found.camera
            notes += [found.note] if found.note else []
        else:
            cameras[view] = unknown_camera(view, width, height, mapping.robot.base_link)
        if view not in given.cameras or view in given.without_pose:
            unknown[view] = 'pose' if view in given.without_pose else 'pose and intrinsics'
        if view in given.others:
            other = given.others[view]
            turned = sized_camera(other.camera, (width, height)).camera
            others[view] = OtherDirection(camera=turned, source=other.source)
    states = JointStates(
        stamps_ns=stamps, joint_names=mapping.robot.joint_names, positions=positions
    )
    info = EpisodeInfo(
        path=path,
        instruction=_instruction(table.keys, mapping),
        outcome=_outcome(table.keys, mapping, path),
    )
    commands = _commanded(recording, mapping, states)
    notes += commands.notes
    return Episode(
        info=info,
        views=tuple(mapping.views),
        cameras=cameras,
        images=images,
        joint_states=states,
        trajectories=trajectories_to(commands.positions, mapping.chunk_s, int(stamps[0])),
        masks=None,
        instructions=[],
        unknown=unknown,
        warnings=tuple(notes),
        unused=_unused(recording, mapping, table),
        other_directions=others,
    )


@dataclass(slots=True, kw_only=True)
class _GivenCameras:
    """Cameras of the views, by a calibration file of this package or of other programs.

    Attributes:
        cameras: cameras by view.
        without_pose: views whose pose no file has; the camera's is a placeholder.
        others: cameras whose pose is read the other way round, by view.
        notes: what is not used, and why.
    """

    cameras: dict[str, CameraModel] = field(default_factory=dict)
    without_pose: set[str] = field(default_factory=set)
    others: dict[str, OtherDirection] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, calibration: Path | None, mapping: VideoMapping) -> _GivenCameras:
        """Return the cameras of a file, or of a folder of files of other programs."""
        found = cls()
        if calibration is None:
            return found
        foreign = read_foreign(calibration, dict.fromkeys(mapping.views, ''))
        if foreign is None:
            found.cameras = load_calibration(calibration)
            return found
        found.notes += foreign.notes
        for view in mapping.views:
            found._add(view, foreign, mapping)
        return found

    def _add(self, view: str, foreign: ForeignCalibration, mapping: VideoMapping) -> None:
        lens, robot = foreign.lenses.get(view), mapping.robot
        pose = next((one for one in foreign.poses if one.view in (view, one.child)), None)
        if pose is not None and pose.parent not in robot.link_names:
            raise CalibrationError.unknown(
                f"'{pose.file}':",
                pose.parent,
                robot.link_names,
                is_not=f" is no link of robot '{robot.name}'",
                most=0,
            )
        if lens is None:
            if pose is not None:
                self.notes.append(
                    f"view '{view}': '{pose.file}' has a pose, and no file its lens: put one of "
                    f'camera_calibration, OpenCV or kalibr beside it, named {view}_lens.yaml'
                )
            return
        if pose is None:
            self.cameras[view] = lens.camera(view, robot.base_link, np.eye(4))
            self.without_pose.add(view)
            return
        self.cameras[view] = lens.camera(view, pose.parent, pose.T_parent_child)
        turned = lens.camera(view, pose.parent, pose.turned_round.T_parent_child)
        source = f"'{pose.parent}' -> '{pose.child}'"
        self.others[view] = OtherDirection(camera=turned, source=source)


def _unused(
    recording: VideoRecording, mapping: VideoMapping, table: NumberTable
) -> dict[str, str]:
    """Return why columns, keys or data sets of a recording are not used, by name."""
    streams = [mapping.state, *([] if mapping.action is None else [mapping.action])]
    used = {mapping.time, key_of(mapping.outcome), key_of(mapping.instruction)}
    if is_hdf5(mapping.rows):
        used |= {feature for stream in streams for feature in stream.features}
        place = recording.inside(mapping.rows)
        used |= {
            recording.inside(pattern).removeprefix(place).strip('/')
            for pattern in mapping.views.values()
            if recording.file(pattern) == table.path
        }
        found = data_set_names(table.path, place)
        label, count = mapping.state.label, table.values.shape[1]
        columns_left = unused_columns(label, (), count, mapping.state.used_columns())
        return columns_left | {
            name: "images of no view; 'views' in the mapping"
            if is_images
            else 'data set of no stream'
            for name, is_images in found.items()
            if name not in {one.strip('/') for one in used}
        }
    columns = [column for stream in streams for column in stream.used_columns()]
    if table.names:
        return unused_keys(table.names, {*used, *map(str, columns)} | _at(table.names, columns))
    used |= {feature for stream in streams for feature in stream.features}
    own = mapping.state.used_columns()
    return {
        **unused_keys(table.keys, used),
        **unused_columns(mapping.state.label, (), table.values.shape[1], own),
    }


def _at(names: Sequence[str], columns: Sequence[int | str]) -> set[str]:
    """Return the names of columns that are given by number."""
    return {names[n] for n in columns if isinstance(n, int) and n < len(names)}


def _table(recording: VideoRecording, mapping: VideoMapping, stream: ActionStream) -> NumberTable:
    """Return the rows of a recording that a stream needs."""
    path = recording.file(mapping.rows)
    if is_hdf5(mapping.rows):
        return read_hdf5_table(path, recording.inside(mapping.rows), list(stream.features))
    return read_table(path, stream.features)


def _frames(
    recording: VideoRecording, pattern: str, mapping: VideoMapping
) -> VideoFileFrames | Hdf5Frames:
    path, inside = recording.file(pattern), recording.inside(pattern)
    if inside:
        return Hdf5Frames(path, inside, is_bgr=mapping.channels == 'bgr')
    return VideoFileFrames(path)


class _Commands(NamedTuple):
    """Commanded positions at the stamps at which they are to be reached, and notes."""

    positions: JointStates
    notes: tuple[str, ...] = ()


def _commanded(
    recording: VideoRecording, mapping: VideoMapping, measured: JointStates
) -> _Commands:
    """Return the commands of the rows: the positions that follow where there are none."""
    stream = mapping.action
    if stream is None:
        return _Commands(measured)
    table = _table(recording, mapping, stream)
    if len(table.values) != len(measured.stamps_ns):
        raise EpisodeError(
            f"'{table.path}': '{stream.label}' has {len(table.values)} rows, "
            f"'{mapping.state.label}' {len(measured.stamps_ns)}, must be as many"
        )
    what, count = stream.label or table.path.name, table.values.shape[1]
    used = {one.column for one in stream.columns_among(table.names, mapping.state)} - {None}
    if stream.tools:
        used |= set(stream.used_columns())
    numbers = [
        column_number(one, table.names, count, what, 'action') for one in used if one is not None
    ]
    table.check_numbers(numbers)
    positions, odd = stream.commanded(
        table.values, table.names, measured.positions, mapping.robot, mapping.state
    )
    odd = (*odd, *resting_grippers(measured.positions, [positions], mapping.robot).values())
    stamps = measured.stamps_ns
    late = round(stream.delay_frames * float(np.median(np.diff(stamps))))
    reached = JointStates(
        stamps_ns=np.concatenate([stamps[:1], stamps + late]) if late else stamps,
        joint_names=measured.joint_names,
        positions=np.concatenate([measured.positions[:1], positions]) if late else positions,
    )
    return _Commands(reached, odd)


def _track(
    frames: VideoFileFrames | Hdf5Frames, times: FloatArray, mapping: VideoMapping
) -> tuple[Track, list[str]]:
    """Return the frames within the rows at `times` (T,) [s], and how they were read."""
    match = match_frames(
        frames.times,
        len(frames),
        times,
        rows_are_timed=bool(mapping.time),
        source=mapping.frame_times,
    )
    stamps = START_NS + np.round(match.times * 1e9).astype(np.int64)
    return Track(stamps, frames.chosen(match.numbers)), list(
        filter(None, (frames.note, match.note))
    )


def _positions(table: NumberTable, mapping: VideoMapping) -> tuple[FloatArray, list[str]]:
    """Return the positions (T, J) [rad or m], and notes; tool poses by inverse kinematics."""
    stream, robot, values, names = mapping.state, mapping.robot, table.values, table.names
    what = ', '.join(filter(None, stream.features)) or table.path.name
    count = values.shape[1]
    table.check_numbers(
        [column_number(column, names, count, what, 'state') for column in stream.used_columns()]
    )
    positions = np.tile(np.clip(0.0, robot.lower, robot.upper), (len(values), 1))
    at = [robot.joint_names.index(column.joint) for column in stream.columns]
    positions[:, at] = to_positions(values, names, stream.columns, what)
    notes = list(table.notes)
    for arm, poses in stream.tools.items():
        wanted = poses.wanted(values, names, what)
        notes.append(joints_of_poses(positions, robot, arm, poses, wanted))
    return positions, notes


def _times(table: NumberTable, mapping: VideoMapping) -> tuple[FloatArray, list[str]]:
    """Return (T,) times of rows, from 0 on [s], and what is odd."""
    path, keys, name = table.path, table.keys, mapping.time
    if mapping.fps is not None:
        return np.arange(len(table.values)) / mapping.fps, []
    if name not in keys:
        raise EpisodeError.unknown(f"'{path}' has no", name, keys, listed='; it has')
    if name in table.names:
        table.check_numbers([table.names.index(name)])
    try:
        times = np.asarray(keys[name], float).ravel()
    except (TypeError, ValueError) as error:
        raise EpisodeError(f"'{path}': '{name}' must hold numbers: {error}") from error
    if len(times) != len(table.values):
        raise EpisodeError(f"'{path}': '{name}' must have a number for each row")
    times = times / _PER_SECOND[mapping.time_unit]
    try:
        notes = check_row_times(times, name)
    except EpisodeError as error:
        raise EpisodeError(f"'{path}': {error}") from error
    return times - times[0], notes


def _outcome(keys: Mapping[str, Any], mapping: VideoMapping, path: Path) -> str:
    """Return the outcome of a recording: the mapping's, or that of its own key or column."""
    name = key_of(mapping.outcome)
    if not name:
        return mapping.outcome
    if name not in keys:
        raise EpisodeError.unknown(f"'{path}' has no outcome", name, keys, listed='; it has')
    return parse_outcome(keys[name], f"'{path}': outcome '{name}'")


def _instruction(keys: Mapping[str, Any], mapping: VideoMapping) -> str:
    """Return the text for the robot: the mapping's, or that of the recording's key or column."""
    name = key_of(mapping.instruction)
    if not name:
        return mapping.instruction
    value = keys.get(name, '')
    return str(value[0]) if isinstance(value, list) and value else str(value)
