"""Index of a training's episodes: what is chosen from is in memory, recordings are read when used.

A row is kept for each episode that was read and checked, so that the next start reads the index
in place of the episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.data_types import CameraModel, WorldModelSpec
from mtv_world_ros.core.errors import EpisodeError, MtvWorldError
from mtv_world_ros.core.files import content_digest, write_whole
from mtv_world_ros.core.progress import Progress
from mtv_world_ros.data.bag_mapping import EpisodeSource
from mtv_world_ros.data.recording import DEFAULT, Recording
from mtv_world_ros.data.recordings import cached_recording, clip_starts, recording_key
from mtv_world_ros.data.splits import refuse_test_kinds
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.training.clips.mapped_arrays import read_mapped
from mtv_world_ros.training.distributed import Processes
from mtv_world_ros.training.resume import disk_errors_named, DiskError
from mtv_world_ros.training.training_config import TrainingConfig

#: to be increased when rows or the checks of episodes change
_VERSION = 1
#: recordings that a process keeps open; their frames are mapped files
_OPEN = 64


def digest_of(*values: Any) -> str:
    """Return 32 hexadecimal digits for plain values."""
    text = json.dumps(values, sort_keys=True, default=list)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def robot_digest(robot: RobotModel) -> str:
    """Return a digest that changes with the robot's kinematics, tools and grippers."""
    lower, upper = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    rows = np.random.default_rng(0).uniform(lower, upper, (8, len(lower)))
    poses, openings = robot.tool_poses(rows), robot.gripper_openings(rows)
    numbers = [np.round(part, 6).tolist() for part in (poses, openings)]
    return digest_of(robot.name, robot.joint_names, *numbers)[:16]


class RecordingReader:
    """Reader of recordings at the model's size, from a cache of decoded ones.

    Args:
        spec: sizes and rates of the model's inputs and outputs.
        robot: kinematics and limits of the recorded robot.
        cache: folder of the decoded recordings.
        source: topics and calibration of the episodes.
    """

    def __init__(
        self, spec: WorldModelSpec, robot: RobotModel, cache: Path, source: EpisodeSource = DEFAULT
    ) -> None:
        self.spec, self.robot, self.cache, self.source = spec, robot, cache, source
        self.read = lru_cache(_OPEN)(self._read)

    def key(self, path: Path) -> str:
        """Return a key that changes with an episode's files, and with the settings."""
        return recording_key(path, self.spec, self.robot, self.source)

    def _read(self, path: Path) -> Recording:
        return cached_recording(path, self.spec, self.robot, self.cache, self.source, read_mapped)


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexedEpisode:
    """Metadata of an episode that a training needs before it cuts a clip from it.

    Attributes:
        path: folder of the episode.
        task: name of the task.
        outcome: `success`, `failure` or `unknown`.
        digest: digest of the measured motion, see `Recording`.
        content: digest of the episode's files; empty = not computed.
        camera_keys: digests of the cameras, which are the same for the same calibration.
        whole: frames from which whole clips can be cut.
        starts: those of them that are at least a stride apart.
        num_dropped: clips that cannot be cut because frames are missing within them.
        described: names of the objects by a describer; empty = not described.
        read: reads the recording.
    """

    path: Path
    task: str
    outcome: str
    digest: str
    content: str = ''
    camera_keys: tuple[str, ...]
    whole: tuple[int, ...]
    starts: tuple[int, ...]
    num_dropped: int
    described: tuple[str, ...] = ()
    read: Callable[[Path], Recording] = field(repr=False, compare=False)

    @classmethod
    def of(
        cls, recording: Recording, spec: WorldModelSpec, stride_s: float = 0.0
    ) -> IndexedEpisode:
        """Return the row of a recording, which it keeps.

        Args:
            recording: recording of the episode.
            spec: sizes and rates of the model's inputs and outputs.
            stride_s: shortest time between starts of clips [s].
        """
        whole = clip_starts(recording, spec)
        last = recording.times[-1] - spec.chunk_seconds + 1e-6
        cut = recording.times[whole] <= last
        return cls(
            path=recording.path,
            task=recording.task,
            outcome=recording.outcome,
            digest=recording.digest,
            camera_keys=tuple(_camera_key(camera) for camera in recording.cameras),
            whole=tuple(whole.tolist()),
            starts=tuple(_spaced(recording, whole, stride_s)),
            num_dropped=int((recording.times <= last).sum()) - int(cut.sum()),
            described=recording.described,
            read=lambda _: recording,
        )

    def recording(self) -> Recording:
        """Return the recording; frames are mapped from its file."""
        found = self.read(self.path)
        return replace(found, described=self.described) if self.described else found

    def content_digest(self) -> str:
        """Return the digest of the episode's files."""
        return self.content or content_digest(self.path)

    def as_row(self) -> dict[str, Any]:
        """Return plain values, without what the next run finds anew."""
        names = ('task', 'outcome', 'digest', 'content', 'camera_keys', 'starts', 'num_dropped')
        runs = np.split(np.array(self.whole), np.flatnonzero(np.diff(self.whole) != 1) + 1)
        held = {name: getattr(self, name) for name in names}
        return held | {'whole': [[int(run[0]), int(run[-1])] for run in runs if len(run)]}

    @classmethod
    def of_row(
        cls, path: Path, row: Mapping[str, Any], read: Callable[[Path], Recording]
    ) -> IndexedEpisode:
        """Return the episode of a row of `as_row`.

        Raises:
            LookupError, TypeError, ValueError: the row is damaged.
        """
        whole = [frame for first, last in row['whole'] for frame in range(first, last + 1)]
        values = {**row, 'whole': tuple(whole), 'starts': tuple(map(int, row['starts']))}
        return cls(path=path, read=read, **{**values, 'camera_keys': tuple(row['camera_keys'])})


def _camera_key(camera: CameraModel) -> str:
    numbers = np.concatenate([camera.K.ravel(), camera.T_mount_camera.ravel(), camera.distortion])
    model = (camera.view, camera.mount_link, camera.distortion_model)
    return digest_of(*model, *numbers.round(6).tolist())[:16]


def _spaced(recording: Recording, starts: np.ndarray, stride_s: float) -> list[int]:
    """Return the starts that are at least a stride [s] apart."""
    kept: list[int] = []
    for start in starts:
        if not kept or recording.times[start] >= recording.times[kept[-1]] + stride_s - 1e-6:
            kept.append(int(start))
    return kept


#: refuses a recording that cannot be trained on, with an `MtvWorldError`
Check = Callable[[Recording], None]
#: names the objects of an episode
Describe = Callable[[Path], tuple[str, ...]]


def index_episodes(
    paths: Sequence[Path],
    config: TrainingConfig,
    reader: RecordingReader,
    processes: Processes,
    *,
    check: Check,
    describe: Describe | None = None,
    broken: Mapping[str, str] | None = None,
) -> tuple[list[IndexedEpisode], dict[str, str]]:
    """Return the usable episodes, and the reason for each one left out, by path.

    Every process reads and checks its share of those that the index of the reader's cache does
    not have yet; decoded recordings stay in the cache if one ends. All processes call this.

    Args:
        paths: folders of episodes, the same in all processes.
        config: sizes and rates of clips.
        reader: reader of the recordings.
        processes: processes that train together.
        check: refuses unusable recordings.
        describe: names the objects of an episode; None = no describer.
        broken: reasons why episodes are left out, by path.

    Raises:
        PolicyError: episodes of policies with faults of the split `test`.
        DiskError: the cache cannot be written.
        TrainingError: another process is gone, or sees other episodes.
    """
    processes.check_same('the paths of the episodes', digest_of(*map(str, paths)))
    spec, stride_s = config.spec, config.video.clip_stride_s
    settings = [_VERSION, robot_digest(reader.robot), spec.fps, spec.num_frames, stride_s]
    settings += [reader.robot.lower.tolist(), reader.robot.upper.tolist()]
    file = reader.cache / f'index-{digest_of(settings)}.json'
    held, left_out = _rows(file), dict(broken or {})
    mine = paths[processes.number :: processes.count]
    keys = {path: reader.key(path) for path in mine if str(path) not in left_out}
    known = {p for p, key in keys.items() if key in held and _file(reader, key).is_file()}
    new = [path for path in keys if path not in known]
    for path in new:
        with suppress(EpisodeError):  # reading names what it lacks
            refuse_test_kinds([path], 'training')
    rows: dict[str, dict[str, Any]] = {str(path): held[keys[path]] for path in known}
    reasons = {str(path): left_out[str(path)] for path in mine if str(path) in left_out}
    for path in Progress(new, desc='reading episodes', unit='episode', is_shown=processes.is_main):
        try:
            with disk_errors_named(reader.cache):
                recording = reader.read(path)
                content = content_digest(path)
            check(recording)
            found = IndexedEpisode.of(recording, spec, stride_s)
            rows[str(path)] = replace(found, content=content).as_row()
        except DiskError:
            raise
        except MtvWorldError as error:
            reasons[str(path)] = str(error)
    names: dict[str, tuple[str, ...]] = {}
    for path in mine if describe else ():
        try:
            if describe is not None and str(path) in rows:
                names[str(path)] = describe(path)
        except MtvWorldError as error:
            reasons[str(path)] = str(error)
    parts = processes.of_all((rows, reasons, names, {str(p): key for p, key in keys.items()}))
    rows = {path: row for part in parts for path, row in part[0].items()}
    reasons = {path: reason for part in parts for path, reason in part[1].items()}
    names = {path: found for part in parts for path, found in part[2].items()}
    by_key = {part[3][path]: row for part in parts for path, row in part[0].items()}
    if processes.is_main and not by_key.keys() <= held.keys():
        with disk_errors_named(reader.cache):
            write_whole(file, json.dumps(held | by_key))
    episodes = [
        replace(
            IndexedEpisode.of_row(path, rows[str(path)], reader.read),
            described=names.get(str(path), ()),
        )
        for path in paths
        if str(path) in rows and str(path) not in reasons
    ]
    return episodes, {str(p): reasons[str(p)] for p in paths if str(p) in reasons}


def _file(reader: RecordingReader, key: str) -> Path:
    return reader.cache / f'{key}.npz'


def _rows(file: Path) -> dict[str, dict[str, Any]]:
    """Return the rows of an index by key; none where it is missing or damaged."""
    try:
        found = read_json(file)
        rows = {str(key): dict(row) for key, row in found.items()}
        for row in rows.values():
            IndexedEpisode.of_row(file, row, _unread)
        return rows
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return {}


def _unread(path: Path) -> Recording:
    raise AssertionError(path)
