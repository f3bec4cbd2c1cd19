"""Episodes of a LeRobot data set become episodes of this package."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.cameras.camera import camera_poses
from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray, JointTrajectory
from mtv_world_ros.core.errors import ConfigError, EpisodeError, TrajectoryError
from mtv_world_ros.data.bag.unused_topics import unused_line
from mtv_world_ros.data.episode import Episode, EpisodeInfo, Track, UNKNOWN_CAMERAS
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.data.gripper_sources import resting_grippers
from mtv_world_ros.data.measured_joints import mend_rows
from mtv_world_ros.data.stream_clocks import check_row_times
from mtv_world_ros.importing.camera_parameters import camera_track
from mtv_world_ros.importing.convert import (
    episode_name,
    import_each,
    ImportSummary,
    joints_too_fast,
    MAPPING_KEY,
    START_NS,
    unknown_camera_note,
)
from mtv_world_ros.importing.lerobot import LeRobotDataset
from mtv_world_ros.importing.lerobot_metadata import EpisodeEntry
from mtv_world_ros.importing.mapping import DatasetMapping, digest_of, load_mapping, Stream
from mtv_world_ros.importing.stored_objects import AS_RECORDED, ObjectStage
from mtv_world_ros.importing.unused_parts import unused_features
from mtv_world_ros.robot.file import save_robot
from mtv_world_ros.robot.joint_columns import to_positions
from mtv_world_ros.robot.model import check_positions


def read_frames(dataset: LeRobotDataset, entry: EpisodeEntry, mapping: DatasetMapping) -> Episode:
    """Read an episode's frames alone, each when it is asked for.

    Raises:
        EpisodeError: its rows cannot be read.
    """
    times = dataset.rows(entry, ['timestamp'])['timestamp'].ravel()
    stamps = START_NS + np.round((times - times[0]) * 1e9).astype(np.int64)
    return Episode(
        info=EpisodeInfo(path=dataset.root / episode_name(entry.index)),
        views=tuple(mapping.views),
        images={
            view: Track(stamps, _Frames(dataset, entry, source.feature, times))
            for view, source in mapping.views.items()
        },
        cameras={},
        joint_states=None,
        trajectories=[],
        masks=None,
        instructions=[],
    )


class _Frames:
    """Frames of an episode; each is decoded when it is asked for, from the first one on."""

    def __init__(
        self, dataset: LeRobotDataset, entry: EpisodeEntry, feature: str, times: FloatArray
    ) -> None:
        self._dataset, self._entry, self._feature = dataset, entry, feature
        self._times = times

    def __len__(self) -> int:
        return len(self._times)

    def __getitem__(self, index: Any) -> ByteArray:
        frames = self._dataset.frames(self._entry, self._feature, self._times)
        frame = next(islice(frames, index, None), None)
        if frame is None:
            raise EpisodeError(f"'{self._feature}' has no frame {index}")
        return frame

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.stack(list(self._dataset.frames(self._entry, self._feature, self._times)))


def import_dataset(
    dataset: Path,
    mapping: Path,
    out: Path,
    *,
    episodes: Sequence[int] | None = None,
    stage: ObjectStage = AS_RECORDED,
    progress: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> ImportSummary[int]:
    """Convert a LeRobot dataset into episodes `out/episode_<number>`, robot in `out/robot/`.

    Args:
        dataset: folder of the dataset.
        mapping: mapping file, see `load_mapping`.
        out: folder of the episodes.
        episodes: numbers of those wanted; None = all.
        stage: names the objects and finds their masks.
        progress: wraps the numbers, e.g. in a progress bar.

    Raises:
        ConfigError, EpisodeError: dataset or mapping cannot be used at all.
    """
    source, chosen = LeRobotDataset(dataset), load_mapping(mapping)
    _check_features(source, chosen)
    wanted = sorted(source.episodes) if episodes is None else list(episodes)
    unknown = [number for number in wanted if number not in source.episodes]
    if unknown:
        known = sorted(source.episodes)
        raise ConfigError(
            f"'{dataset}' has no episode {unknown[0]}; it has {len(known)}, from "
            f'{known[0] if known else "-"} to {known[-1] if known else "-"}'
        )

    key = digest_of(start=stage.key + chosen.key.encode()) if stage.key else chosen.key

    def convert(number: int, path: Path) -> tuple[str, ...]:
        return convert_episode(source, source.episodes[number], chosen, path, stage, key)

    summary = import_each(
        progress(wanted), key, lambda number: out / episode_name(number), convert
    )
    if line := unused_line(unused_features(source, chosen)):
        summary.notes = (line,)
    if summary.made or summary.kept:
        summary.robot_notes = save_robot(chosen.robot_file, out / 'robot').notes
    return summary


def _check_features(source: LeRobotDataset, chosen: DatasetMapping) -> None:
    """Check the names of features before the first episode is read."""
    for name in _stream_features(chosen):
        source.feature(name)
    if chosen.outcome_feature:
        source.feature(chosen.outcome_feature)
    for view in chosen.views.values():
        source.colour_feature(view.feature)
        for name in view.features():
            source.feature(name)


def convert_episode(
    dataset: LeRobotDataset,
    entry: EpisodeEntry,
    mapping: DatasetMapping,
    out: Path,
    stage: ObjectStage = AS_RECORDED,
    key: str = '',
) -> tuple[str, ...]:
    """Write the episode's folder `out`, which appears when it is complete.

    Row k has the state and the images of its time; its action is the target that is reached
    `delay_frames` later. Times are the dataset's own.

    Returns:
        What was odd and how it was handled.

    Raises:
        MtvWorldError: the episode cannot be converted; nothing is left behind.
    """
    rows = _read_rows(dataset, entry, mapping)
    times = rows['timestamp'].ravel()
    paused = check_row_times(times, 'timestamp', dataset.fps)
    measured, mended = _measured(dataset, rows, mapping)
    commanded, odd = _commanded(dataset, rows, mapping, measured)
    videos = {
        view: dataset.frames(entry, source.feature, times)
        for view, source in mapping.views.items()
    }
    first = {view: _next_frame(frames, view, 0) for view, frames in videos.items()}
    cameras, tracks, notes = _cameras(dataset, entry, mapping, rows, first)
    if mapping.action is not None:
        odd = (*odd, *resting_grippers(measured, [commanded], mapping.robot).values())
    unknown = [view for view, source in mapping.views.items() if not source.is_known]
    texts = _instructions(dataset, rows, mapping)
    with ExitStack() as stack:
        writer = EpisodeWriter(
            out,
            task=mapping.task,
            instruction=texts[0],
            robot=mapping.robot.name,
            cameras=list(cameras.values()),
            moving=tracks,
            objects=stage.names(
                out.name, texts[0], lambda: next(iter(first.values())), given=mapping.objects
            ),
            metadata={
                'source': dataset.root.resolve().name,
                'source_episode': str(entry.index),
                MAPPING_KEY: key or mapping.key,
                **({UNKNOWN_CAMERAS: ', '.join(unknown)} if unknown else {}),
            },
            jpeg_quality=mapping.jpeg_quality,
        )
        stack.enter_context(writer)
        masks = stage.masks(out.name, writer)
        writer.outcome = _outcome(rows, mapping)
        stamps = [START_NS + round(float(t - times[0]) * 1e9) for t in times]
        commands = dict(_commands(times, commanded, mapping, dataset.fps))
        for k, stamp_ns in enumerate(stamps):
            if k == 0 or texts[k] != texts[k - 1]:
                writer.write_instruction(stamp_ns, texts[k])
            writer.write_joint_states(stamp_ns, mapping.robot.joint_names, measured[k])
            for view in mapping.views:
                frame = first[view] if k == 0 else _next_frame(videos[view], view, k)
                if view in cameras:
                    writer.write_camera_info(view, stamp_ns, cameras[view])
                if view in tracks:
                    mount = cameras[view].mount_link
                    writer.write_camera_pose(view, stamp_ns, mount, tracks[view][k])
                writer.write_image(view, stamp_ns, frame)
                masks.add(view, stamp_ns, frame)
            if k in commands:  # after what it starts from, so that the episode can be played
                writer.write_trajectory(stamp_ns, commands[k])
        masks.finish()
    shown = {view: dataset.video_note(entry, row.feature) for view, row in mapping.views.items()}
    turned = [f"view '{view}': {note}" for view, note in shown.items() if note]
    turned += [unknown_camera_note(out.parent, view, 'pose and intrinsics') for view in unknown]
    return (
        *paused,
        *mended,
        *odd,
        *notes,
        *turned,
        *joints_too_fast(commands.values(), mapping.robot),
    )


def _stream_features(mapping: DatasetMapping) -> tuple[str, ...]:
    """Return the features of the measured and the commanded joints."""
    commanded = mapping.action.features if mapping.action else ()
    return *mapping.state.features, *commanded


def _read_rows(
    dataset: LeRobotDataset, entry: EpisodeEntry, mapping: DatasetMapping
) -> dict[str, FloatArray]:
    names = ['timestamp', *_stream_features(mapping)]
    names += [] if mapping.instruction else ['task_index']
    names += [mapping.outcome_feature] if mapping.outcome_feature else []
    for source in mapping.views.values():
        dataset.feature(source.feature, ('video', 'image'))
        names += source.features()
    return dataset.rows(entry, list(dict.fromkeys(names)))


def _measured(
    dataset: LeRobotDataset, rows: dict[str, FloatArray], mapping: DatasetMapping
) -> tuple[FloatArray, list[str]]:
    """Return the measured positions (T, J), and notes on repaired values."""
    stream = mapping.state
    values, names = _table(dataset, rows, stream)
    positions = to_positions(values, names, stream.columns, stream.label)
    times = rows['timestamp'].ravel()
    mended, notes = mend_rows(stream.label, times, positions, mapping.robot)
    _check(mended, stream, mapping, 'state')
    return mended, notes


def _commanded(
    dataset: LeRobotDataset,
    rows: dict[str, FloatArray],
    mapping: DatasetMapping,
    measured: FloatArray,
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return the commanded positions (T, J) of the rows, and notes on repaired values."""
    stream = mapping.action
    if stream is None:
        return measured, ()
    values, names = _table(dataset, rows, stream)
    positions, odd = stream.commanded(values, names, measured, mapping.robot, mapping.state)
    _check(positions, stream, mapping, 'action')
    return positions, odd


def _table(
    dataset: LeRobotDataset, rows: dict[str, FloatArray], stream: Stream
) -> tuple[FloatArray, list[str]]:
    """Return the columns (T, C) of a stream's features side by side, and their names."""
    count = len(rows['timestamp'])
    tables = {name: rows[name].reshape(count, -1) for name in stream.features}
    sizes = {name: table.shape[1] for name, table in tables.items()}
    return np.concatenate(list(tables.values()), axis=1), dataset.joined_names(sizes)


def _check(positions: FloatArray, stream: Stream, mapping: DatasetMapping, what: str) -> None:
    try:
        check_positions(mapping.robot, positions, tolerance=mapping.limit_tolerance)
    except TrajectoryError as error:
        raise TrajectoryError(
            f"{what} '{stream.label}': {error}; are unit, sign, offset and gripper range in "
            'the mapping right? (limit_tolerance there says how far outside is accepted)'
        ) from error


def _cameras(
    dataset: LeRobotDataset,
    entry: EpisodeEntry,
    mapping: DatasetMapping,
    rows: dict[str, FloatArray],
    first: dict[str, ByteArray],
) -> tuple[dict[str, CameraModel], dict[str, FloatArray], list[str]]:
    """Return the known cameras at the first row, poses at all rows of those that move, notes."""
    cameras, tracks, notes = {}, {}, []
    known = {view: source for view, source in mapping.views.items() if source.is_known}
    for view, source in known.items():
        height, width = first[view].shape[:2]
        found = camera_track(source, dataset.root, entry.index, rows, (width, height))
        camera = found.camera
        if found.poses is not None:
            tracks[view] = found.poses
        notes += [found.note] if found.note else []
        resting = np.zeros((1, len(mapping.robot.joint_names)))
        camera_poses(camera, mapping.robot, resting)  # names a mount_link that is not there
        cameras[view] = camera
    return cameras, tracks, notes


def _instructions(
    dataset: LeRobotDataset, rows: dict[str, FloatArray], mapping: DatasetMapping
) -> list[str]:
    """Return the instruction at each row."""
    if mapping.instruction:
        return [mapping.instruction] * len(rows['timestamp'])
    numbers = rows['task_index'].ravel().astype(int)
    unknown = sorted(set(numbers.tolist()) - set(dataset.tasks))
    if unknown:
        raise EpisodeError(f'it names task {unknown[0]}, which meta/tasks does not have')
    return [dataset.tasks[int(number)] for number in numbers]


def _outcome(rows: dict[str, FloatArray], mapping: DatasetMapping) -> str:
    if not mapping.outcome_feature:
        return mapping.outcome
    return 'success' if (rows[mapping.outcome_feature] > 0).any() else 'failure'


def _commands(
    times: FloatArray, positions: FloatArray, mapping: DatasetMapping, fps: float
) -> list[tuple[int, JointTrajectory]]:
    """Return the trajectories of `chunk_s`, each with its first row."""
    if mapping.action is None:  # the measured positions of the rows that follow
        reached, targets = times[1:], positions[1:]
    else:
        reached, targets = times + mapping.action.delay_frames / fps, positions
    size = max(1, round(mapping.chunk_s * fps))
    names, found = mapping.robot.joint_names, []
    for first in range(0, len(targets), size):
        chunk = slice(first, first + size)
        trajectory = JointTrajectory(
            joint_names=names, times=reached[chunk] - times[first], positions=targets[chunk]
        )
        found.append((first, trajectory))
    return found


def _next_frame(frames: Iterator[ByteArray], view: str, row: int) -> ByteArray:
    frame = next(frames, None)
    if frame is None:
        raise EpisodeError(f"view '{view}' has no frame for row {row}")
    return frame
