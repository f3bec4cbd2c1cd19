"""A recorded episode in memory: images, joint states, commands, instruction and outcome."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
import json
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.core.bounded_input import parse_json
from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray, JointTrajectory
from mtv_world_ros.core.errors import DamagedFrameError, EpisodeError, MtvWorldError
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.resample import interpolated, match_joints

JOINT_STATES = '/joint_states'
JOINT_TRAJECTORY = '/joint_trajectory'
INSTRUCTION = '/instruction'
#: object poses in the base frame, in the order of the names (from a simulator or markers)
OBJECT_POSES = '/object_poses'
#: poses of cameras that move against the robot's links
TF = '/tf'
#: poses of cameras that stand still in a link
TF_STATIC = '/tf_static'
#: name of the MCAP metadata record with task, outcome and objects
METADATA_NAME = 'mtv_world'
#: key of the metadata that names the segmenter of the masks, where they are not the simulator's
MASKS_BY = 'masks_by'
#: key of the metadata that names the views whose camera's pose was not known at the import
UNKNOWN_CAMERAS = 'unknown_cameras'
#: key of the metadata that names the physics of a simulated episode
PHYSICS = 'physics'
#: key of the metadata that names the robot cell of an episode
PLACE = 'place'
#: key of the metadata that holds the definition of a task that is not a bundled one, as JSON
TASK_DEFINITION = 'task_definition'
#: name of the default physics
NOMINAL = 'nominal'
CALIBRATION_FILE = 'calibration.yaml'
OUTCOMES = ('success', 'failure', 'unknown')


def simulated_place(physics: str) -> str:
    """Name of the robot cell that the simulator is with a physics."""
    return f'simulator/{physics}'


def image_topic(view: str) -> str:
    """Return the topic of the view's raw images; compressed ones have the suffix `/compressed`."""
    return f'/{view}/image_raw'


def camera_info_topic(view: str) -> str:
    """Return the topic of the view's CameraInfo."""
    return f'/{view}/camera_info'


def mask_topic(view: str) -> str:
    """Return the topic of the view's object masks (PNG: 0 = none, i + 1 = objects[i])."""
    return f'/{view}/mask/compressed'


def optical_frame(view: str) -> str:
    """Return the frame_id of the view."""
    return f'{view}_optical_frame'


def check_outcome(outcome: str) -> str:
    """Return `outcome` if it is one of `OUTCOMES`, else raise EpisodeError."""
    if outcome not in OUTCOMES:
        raise EpisodeError.unknown('outcome', outcome, OUTCOMES)
    return outcome


#: words of outcomes in other people's recordings, in lower case, by the outcome that they mean
_OUTCOME_WORDS = {
    'success': {'success', 'succeeded', 'successful', 'true', 'yes', '1', '1.0'},
    'failure': {'failure', 'failed', 'fail', 'false', 'no', '0', '0.0'},
    'unknown': {'unknown', 'none', 'null', 'nan', ''},
}


def parse_outcome(value: Any, where: str) -> str:
    """Return the entry of `OUTCOMES` that a recorded value means.

    Args:
        value: word, truth value or number 0 or 1; or a column of values, which is a success if
            one row is, else a failure if one row is.
        where: source of the value, for error texts.

    Raises:
        EpisodeError: it means none.
    """
    if isinstance(value, list | tuple | np.ndarray):
        found = {parse_outcome(one, where) for one in value}
        return next((word for word in ('success', 'failure') if word in found), 'unknown')
    said = str(value).strip().lower()
    for outcome, words in _OUTCOME_WORDS.items():
        if said in words:
            return outcome
    raise EpisodeError(
        f"{where} is '{value}', which is no outcome; it must be success, failure or unknown, true "
        'or false, 1 or 0'
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeInfo:
    """Metadata of an episode.

    Attributes:
        path: folder or file of the episode.
        task: name of the task; empty where not recorded.
        outcome: `success`, `failure` or `unknown`.
        seed: seed of the simulated scene, or None.
        objects: names such as `red block`; masks number them from 1.
        instruction: text for the policy; empty if not recorded.
        robot: name of the robot; empty where not recorded.
        metadata: further text by key.
    """

    path: Path
    task: str = ''
    outcome: str = 'unknown'
    seed: int | None = None
    objects: tuple[str, ...] = ()
    instruction: str = ''
    robot: str = ''
    metadata: Mapping[str, str] = field(default_factory=dict)

    @property
    def physics(self) -> str:
        """Name of the physics of a simulated episode; empty for a real one.

        Older simulated episodes do not store it.
        """
        return self.metadata.get(PHYSICS, NOMINAL if self.seed is not None else '')

    @property
    def place(self) -> str:
        """Robot cell of the episode; empty = not stated. Each physics of the simulator is one."""
        return self.metadata.get(PLACE, simulated_place(self.physics) if self.physics else '')


def dump_info(info: EpisodeInfo) -> dict[str, str]:
    """Return the text of the episode's metadata record, by key.

    Raises:
        EpisodeError: a key of `info.metadata` is one that the episode sets.
    """
    described = {
        'task': info.task,
        'outcome': info.outcome,
        'seed': '' if info.seed is None else str(info.seed),
        'objects': json.dumps(info.objects),
        'instruction': info.instruction,
        'robot': info.robot,
    }
    clash = sorted(described.keys() & info.metadata.keys())
    if clash:
        raise EpisodeError(f'metadata must not have the keys {clash}: the episode sets them')
    return {**described, **info.metadata}


def parse_info(
    path: Path, values: Mapping[str, str], *, default_instruction: str = ''
) -> EpisodeInfo:
    """Return the metadata of the episode at `path` from its record; inverse of `dump_info`.

    Raises:
        EpisodeError: a value cannot be used.
    """
    rest = dict(values)
    try:
        seed = rest.pop('seed', '')
        return EpisodeInfo(
            path=path,
            task=rest.pop('task', ''),
            outcome=check_outcome(rest.pop('outcome', 'unknown')),
            seed=int(seed) if seed else None,
            objects=tuple(
                str(name) for name in parse_json(rest.pop('objects', '[]'), "'objects'")
            ),
            instruction=rest.pop('instruction', '') or default_instruction,
            robot=rest.pop('robot', ''),
            metadata=rest,
        )
    except (ValueError, TypeError, EpisodeError) as error:
        raise EpisodeError(f"'{path}' has metadata that cannot be used: {error}") from error


class Frames(Protocol):
    """N frames that are decoded on access.

    `frames[i]` is one frame, `frames[i:j]` and `frames[[i, j]]` are arrays of frames, and
    `numpy.asarray(frames)` is the array of all frames,
    (N, H, W, 3) uint8 RGB, or (N, H, W) uint8 for masks.
    """

    def __len__(self) -> int: ...

    def __getitem__(self, index: Any) -> ByteArray: ...

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]: ...


class LazyFrames:
    """`Frames` of image messages that are decoded independently of each other.

    Args:
        topic: name of the topic, for error texts.
        messages: image messages of the topic.
        decode: turns a message into a frame, (H, W, 3) uint8 RGB.
    """

    def __init__(
        self, topic: str, messages: Sequence[Any], decode: Callable[[Any], ByteArray]
    ) -> None:
        self._topic = topic
        self._messages = messages
        self._decode = decode

    def __len__(self) -> int:
        return len(self._messages)

    def __getitem__(self, index: Any) -> ByteArray:
        chosen = np.arange(len(self))[index]
        if chosen.ndim == 0:
            return self._frame(int(chosen))
        return self._stack([self._frame(int(i)) for i in chosen])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        frames = self[:]
        return frames if dtype is None else frames.astype(dtype, copy=False)

    def _frame(self, index: int) -> ByteArray:
        try:
            return self._decode(self._messages[index])
        except MtvWorldError as error:
            text = f"'{self._topic}', frame {index}: {error}"
            raise DamagedFrameError(text) from error

    def _stack(self, frames: list[ByteArray]) -> ByteArray:
        sizes = sorted({frame.shape[:2] for frame in frames})
        if len(sizes) > 1:
            raise EpisodeError(f"'{self._topic}': the frames have several sizes (H, W): {sizes}")
        return np.stack(frames) if frames else np.empty((0, 0, 0, 3), np.uint8)


class Track(NamedTuple):
    """Frames over time.

    Attributes:
        stamps_ns: (N,) int64, increasing.
        frames: the N frames.
    """

    stamps_ns: NDArray[np.int64]
    frames: Frames


@dataclass(frozen=True, slots=True, kw_only=True)
class JointStates:
    """Measured joint positions over time.

    Attributes:
        stamps_ns: (N,) int64, increasing.
        joint_names: J names.
        positions: (N, J) [rad or m].
    """

    stamps_ns: NDArray[np.int64]
    joint_names: tuple[str, ...]
    positions: FloatArray

    def at(self, stamps_ns: NDArray[np.int64], robot: RobotModel) -> FloatArray:
        """Return (T, J) positions at stamps (T,), interpolated, in the robot's joint order.

        Raises:
            TrajectoryError: joints of the robot are missing.
        """
        known, rows = np.unique(self.stamps_ns, return_index=True)
        track = JointTrajectory(
            joint_names=self.joint_names,
            times=(known - known[0]) * 1e-9,
            positions=self.positions[rows],
        )
        matched = match_joints(track, robot)
        seconds = (stamps_ns - known[0]) * 1e-9
        return interpolated(seconds, matched.times, matched.positions, robot.is_endless)


class ObjectPoses(NamedTuple):
    """Object poses over time.

    Attributes:
        stamps_ns: (N,) int64, increasing.
        T_base_object: (N, O, 4, 4) [m], in the order of the episode's objects.
    """

    stamps_ns: NDArray[np.int64]
    T_base_object: FloatArray


class OtherDirection(NamedTuple):
    """Camera whose pose is read the other way round.

    Attributes:
        camera: the camera.
        source: transforms of the file, for texts.
    """

    camera: CameraModel
    source: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Episode:
    """A recorded episode.

    Attributes:
        info: task, outcome, objects, instruction and robot.
        views: names of the views, in order.
        cameras: camera of each view at the size of its images; empty where not asked for.
        images: images of each view.
        joint_states: measured joint positions; None where there are none.
        trajectories: (start stamp [ns], trajectory), by stamp.
        masks: object masks of the views that have them; None where there are none.
        instructions: (stamp [ns], text), by stamp.
        object_poses: None if not recorded.
        unknown: parameters that are not known of some views' cameras (`pose`, or `pose and
            intrinsics`), by view; `cameras` has a placeholder.
        unknown_because: reason why a pose is not known although TF has the camera, by view.
        camera_tracks: (N, 4, 4) T_mount_camera [m] at the images of each view whose camera moves
            against the robot's links; `cameras` has the first one.
        truncated: the recording is cut off.
        warnings: problems found and how they were handled, one line each; if
            `truncated`, the first says where the record was cut.
        unused: reason why a recorded topic is not part of the episode, by topic.
        other_directions: by view the camera with its pose read the other way round, where it is
            of a program's file whose direction images may confirm.
    """

    info: EpisodeInfo
    views: tuple[str, ...]
    cameras: Mapping[str, CameraModel]
    images: Mapping[str, Track]
    joint_states: JointStates | None
    trajectories: list[tuple[int, JointTrajectory]]
    masks: Mapping[str, Track] | None
    instructions: list[tuple[int, str]]
    object_poses: ObjectPoses | None = None
    unknown: Mapping[str, str] = field(default_factory=dict)
    unknown_because: Mapping[str, str] = field(default_factory=dict)
    camera_tracks: Mapping[str, FloatArray] = field(default_factory=dict)
    truncated: bool = False
    warnings: tuple[str, ...] = ()
    unused: Mapping[str, str] = field(default_factory=dict)
    other_directions: Mapping[str, OtherDirection] = field(default_factory=dict)

    def mask_areas(self) -> dict[str, FloatArray]:
        """Return (O, T) areas of the objects in the stored masks by view [share of the image]."""
        found = {}
        for view, track in (self.masks or {}).items():
            ids = np.asarray(track.frames[:])
            flat = ids.reshape(len(ids), -1)
            each = [(flat == n).mean(axis=1) for n in range(1, len(self.info.objects) + 1)]
            found[view] = np.array(each).reshape(-1, len(ids))
        return found

    def camera(self, view: str, index: int) -> CameraModel:
        """Return the camera of a view as it is at one of its images."""
        camera, track = self.cameras[view], self.camera_tracks.get(view)
        return camera if track is None else replace(camera, T_mount_camera=track[index])
