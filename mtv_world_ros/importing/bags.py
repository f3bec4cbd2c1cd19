"""Imports rosbag2 recordings of a robot's own topics: each bag becomes an episode."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
import tempfile
from typing import Any

import numpy as np
import yaml

from mtv_world_ros.cameras.camera import camera_poses
from mtv_world_ros.core.data_types import FloatArray, JointTrajectory
from mtv_world_ros.core.errors import (
    ConfigError,
    DamagedFrameError,
    EpisodeError,
    MtvWorldError,
    ObservationError,
    RobotError,
    TrajectoryError,
)
from mtv_world_ros.core.files import ROBOT_YAML
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.image_decoding import check_raw
from mtv_world_ros.data.bag.reader import BagMessage, BagReader
from mtv_world_ros.data.bag.unused_topics import unused_line
from mtv_world_ros.data.bag_mapping import BagMapping, key_of
from mtv_world_ros.data.episode import (
    Episode,
    MASKS_BY,
    parse_outcome,
    PHYSICS,
    PLACE,
    UNKNOWN_CAMERAS,
)
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.data.stream_clocks import ClockBreakError, WHOLE, Window
from mtv_world_ros.importing.calibration_directions import settle_directions
from mtv_world_ros.importing.convert import (
    import_each,
    ImportSummary,
    joints_too_fast,
    MAPPING_KEY,
    unknown_camera_note,
)
from mtv_world_ros.importing.mapping import digest_of
from mtv_world_ros.importing.robot_guess import guess_robot
from mtv_world_ros.importing.stored_objects import AS_RECORDED, MaskWriter, ObjectStage
from mtv_world_ros.importing.view_names import guess_views
from mtv_world_ros.robot.file import load_robot, save_robot
from mtv_world_ros.robot.model import check_positions, RobotModel
from mtv_world_ros.robot.resample import match_joints


@dataclass(frozen=True, slots=True)
class BagPart:
    """A bag, or a part of one whose clocks jump.

    Attributes:
        bag: rosbag2 folder or file.
        number: number of the part, from 1 on; 0 = the whole bag.
        window: the part, by receive times.
    """

    bag: Path
    number: int = 0
    window: Window = WHOLE

    @property
    def name(self) -> str:
        """Name of the folder that its episode gets."""
        name = episode_name(self.bag)
        return f'{name}_part{self.number}' if self.number else name

    def __str__(self) -> str:
        return f'{self.bag} (part {self.number})' if self.number else str(self.bag)


def with_guessed_views(mapping: BagMapping, bag: Path) -> BagMapping:
    """Return the mapping with the bag's image topics as views, where it names none.

    Raises:
        EpisodeError: the bag has no images.
    """
    if mapping.views:
        return mapping
    reader = BagReader(bag)
    found, topics = _image_topics(reader)
    inside = [t for t in topics if t.startswith(mapping.topic(''))] or topics
    views = guess_views(inside)
    if not views:
        others = ', '.join(f'{topic} ({kind})' for topic, kind in found.items()) or 'none'
        text = (
            f"'{bag}' has no images (topics of Image, CompressedImage or FFMPEGPacket); its "
            f'topics are {others}'
        )
        raise EpisodeError('; '.join([text, *filter(None, [reader.truncated, *reader.problems])]))
    return mapping.replace(views={view: {'image': topic} for view, topic in views.items()})


def _image_topics(reader: BagReader) -> tuple[dict[str, str], list[str]]:
    """Return the types of all topics, and the topics whose first image has colours or greys."""
    found: dict[str, str] = {}
    topics = []
    for message in reader.messages():
        if message.topic in found:
            continue
        found[message.topic] = message.msgtype
        if message.msgtype in messages.IMAGE_TYPES and _is_shown(message):
            topics.append(message.topic)
    return found, topics


def _is_shown(message: BagMessage) -> bool:
    """Return False for a raw image that no colours can be made of: depth, labels, points."""
    if message.msgtype != messages.IMAGE:
        return True
    try:
        check_raw(messages.deserialize(message.msgtype, message.data))
    except ObservationError as error:
        return 'encoding' not in str(error)
    except MtvWorldError:  # the reader names what is damaged
        pass
    return True


def described_robot(bag: Path, mapping: BagMapping, folder: Path) -> tuple[Path, tuple[str, ...]]:
    """Write the robot of a bag's `/robot_description` into a folder; fingers and tools guessed.

    Returns:
        The robot's YAML, and what was guessed.

    Raises:
        RobotError: the bag has no description, or no robot can be made of it.
    """
    text, topic, chosen = robot_description(bag, mapping)
    with tempfile.TemporaryDirectory(prefix='mtv_world_robot_') as place:
        urdf = Path(place) / 'robot.urdf'
        urdf.write_text(text, encoding='utf-8')
        file = Path(place) / ROBOT_YAML
        try:
            guessed = guess_robot(urdf)
            file.write_text(yaml.safe_dump(guessed.values, sort_keys=False), encoding='utf-8')
            saved = save_robot(file, folder)
            return saved.file, (*chosen, *guessed.notes, *saved.notes)
        except (RobotError, ConfigError) as error:
            source, reason = f"'{topic}' of '{bag}'", str(error)
            for temporary in (urdf, file):
                reason = reason.replace(f"'{temporary}'", source)
            raise RobotError(
                f"{reason}; --robot, or 'robot' in the mapping, names another file"
            ) from error


def robot_description(bag: Path, mapping: BagMapping) -> tuple[str, str, tuple[str, ...]]:
    """Return the URDF that a bag holds; of several, the one whose joints are recorded most.

    Returns:
        The text, its topic, and how it was chosen, where there was a choice.

    Raises:
        RobotError: the bag holds no robot description.
    """
    topics = {mapping.topic(mapping.robot_description), '/robot_description'}
    texts = {
        str(messages.deserialize(messages.STRING, message.data).data): message.topic
        for message in BagReader(bag).messages(topics)
        if message.msgtype == messages.STRING
    }
    if not texts:
        raise RobotError(
            f"'{bag}' has no '{mapping.topic(mapping.robot_description)}'; name the robot's file "
            "with --robot or as 'robot' in the mapping"
        )
    if len(texts) == 1:
        return *next(iter(texts.items())), ()
    topics = mapping.state_topics
    named = [
        {f'name="{mapping.joint_name(name)}"' for name in state.name}
        for message in BagReader(bag).messages(topics)
        if message.msgtype == messages.JOINT_STATE
        for state in [messages.deserialize(messages.JOINT_STATE, message.data)]
    ]
    counts = {text: sum(any(name in text for name in names) for names in named) for text in texts}
    best = max(counts, key=lambda text: counts[text])
    note = (
        f"the bag describes {len(texts)} robots: taken is the one whose joints '{topics[0]}' "
        f'names most ({counts[best]} of {len(named)} messages); --robot takes another'
    )
    return best, texts[best], (note,)


def import_bags(
    bags: Sequence[Path],
    out: Path,
    mapping: BagMapping,
    robot_file: Path,
    *,
    calibration: Path | None = None,
    stage: ObjectStage = AS_RECORDED,
    progress: Callable[[Iterable[Path]], Iterable[Path]] = iter,
) -> ImportSummary[BagPart]:
    """Convert bags into episodes `out/<name of the bag>`, and save the robot in `out/robot/`.

    A bag in which all clocks jump at once is divided there: `out/<name>_part1` and so on.

    Args:
        bags: rosbag2 folders or files.
        out: folder of the episodes.
        mapping: names and kinds of the topics, with views.
        robot_file: the robot's YAML.
        calibration: file of the cameras; None = the bags' own.
        stage: names the objects and finds their masks.
        progress: wraps the bags, e.g. in a progress bar.

    Raises:
        ConfigError, RobotError: the robot cannot be used at all.
    """
    robot = load_robot(robot_file)
    inside, notes = out / 'robot', ()
    if robot_file.parent.resolve() != inside.resolve():
        notes = save_robot(robot_file, inside).notes
    key = digest_of(robot_file, calibration, start=stage.key + mapping.model_dump_json().encode())

    parts: deque[BagPart] = deque()

    def items() -> Iterator[BagPart]:
        for bag in progress(bags):
            yield BagPart(bag)
            while parts:
                yield parts.popleft()

    def convert(part: BagPart, path: Path) -> tuple[str, ...]:
        try:
            return convert_bag(part, path, mapping, robot, calibration, key, stage)
        except ClockBreakError as error:
            if part.number:
                raise
            windows = enumerate(error.windows, start=1)
            parts.extend(BagPart(part.bag, number, window) for number, window in windows)
            return (f'{error} ({", ".join(one.name for one in parts)})',)

    summary = import_each(items(), key, lambda part: out / part.name, convert)
    summary.robot_notes = notes
    return summary


def episode_name(bag: Path) -> str:
    """Name of the folder that a bag's episode gets."""
    return bag.name.split('.')[0] if bag.is_file() else bag.name


def summary_line(path: Path, objects: bool = False) -> str:
    """Return one line on the content of an imported episode.

    Args:
        path: folder of the episode.
        objects: mention objects even if none is named.
    """
    episode = read_episode(path, with_cameras=False)
    states = episode.joint_states
    assert states is not None
    seconds = (states.stamps_ns[-1] - states.stamps_ns[0]) * 1e-9
    counts = ', '.join(f'{view} {len(episode.images[view].stamps_ns)}' for view in episode.views)
    parts = [f'{seconds:.1f} s', f'frames: {counts}', f"'{episode.info.instruction}'"]
    if episode.info.objects or objects:
        parts.append(f'objects: {", ".join(episode.info.objects) or "none named"}')
    areas = episode.mask_areas()
    if areas:
        seen = [
            ', '.join(f'{view} {(area[n] > 0).mean():.0%}' for view, area in areas.items())
            for n in range(len(episode.info.objects))
        ]
        found = zip(episode.info.objects, seen, strict=True)
        parts.append('seen: ' + '; '.join(f'{name} in {share}' for name, share in found))
    unknown = episode.info.metadata.get(UNKNOWN_CAMERAS, '')
    if unknown:
        parts.append(f'cameras not known: {unknown}')
    return f'{path.name}: {"; ".join(parts)}'


def convert_bag(
    part: BagPart,
    out: Path,
    mapping: BagMapping,
    robot: RobotModel,
    calibration: Path | None,
    key: str = '',
    stage: ObjectStage = AS_RECORDED,
) -> tuple[str, ...]:
    """Write a bag as an episode; see `write_imported`.

    A part has no outcome: that of the recording is of the whole.
    """
    episode = read_episode(
        part.bag,
        views=list(mapping.views),
        calibration=calibration,
        mapping=mapping,
        robot=robot,
        unknown_mount=robot.base_link,
        window=part.window,
        decode_all=False,  # each frame is decoded once, when it is written
    )
    episode = settle_directions(episode, robot)
    key_name = key_of(mapping.outcome)
    if key_name:
        outcome = _outcome(episode, key_name)
        mapping = mapping.replace(outcome='unknown')
        episode = replace(episode, info=replace(episode.info, outcome=outcome))
    if part.number:
        mapping = mapping.replace(outcome='unknown')
        episode = replace(episode, info=replace(episode.info, outcome='unknown'))
    return write_imported(episode, part.bag.name, out, mapping, robot, key, stage)


def _outcome(episode: Episode, name: str) -> str:
    """Return the outcome that a bag has under a key of its custom_data."""
    known = episode.info.metadata
    if name not in known:
        raise EpisodeError.unknown(
            f"'{episode.info.path}' has no outcome",
            name,
            known,
            is_not=' in custom_data of metadata.yaml',
            listed='; it has',
            advice=' (ros2 bag record --custom-data KEY=VALUE writes one)',
        )
    return parse_outcome(known[name], f"'{episode.info.path}': outcome '{name}'")


def write_imported(
    episode: Episode,
    source: str,
    out: Path,
    mapping: BagMapping,
    robot: RobotModel,
    key: str = '',
    stage: ObjectStage = AS_RECORDED,
) -> tuple[str, ...]:
    """Write a recording as an episode, whose folder appears when it is complete.

    Args:
        episode: recording as it was read, with cameras.
        source: name of the recording.
        out: folder of the episode.
        mapping: task, outcome and quality of what is written, and how commands are checked.
        robot: robot whose order of joints and limits are used.
        key: digest of mapping, robot and calibration.
        stage: names the objects and finds their masks.

    Returns:
        What was odd and how it was handled.

    Raises:
        MtvWorldError: it cannot be converted; nothing is left behind.
    """
    _check_views(episode)
    for camera in episode.cameras.values():  # names a mount_link that is not there
        camera_poses(camera, robot, np.zeros((1, len(robot.joint_names))))
    stamps, positions = _measured(episode, robot, mapping)
    commands = _commands(episode, robot, mapping)
    warnings = [*episode.warnings, *joints_too_fast([t for _, t in commands], robot)]
    if line := unused_line(episode.unused):
        warnings.append(line)
    unknown = episode.unknown.items()
    warnings += [
        unknown_camera_note(out.parent, view, what, episode.unknown_because.get(view, ''))
        for view, what in unknown
    ]
    instruction = mapping.instruction or episode.info.instruction
    names = stage.names(
        out.name,
        instruction,
        lambda: np.asarray(episode.images[episode.views[0]].frames[0]),
        given=mapping.objects,
        stored=episode.info.objects,
    )
    if episode.masks and (stage.segmenter is not None or names != episode.info.objects):
        episode = replace(episode, masks=None)
        warnings.append('recorded masks are of other objects, or are made anew, and are left out')
    with EpisodeWriter(
        out,
        task=mapping.task or episode.info.task,
        instruction=instruction,
        robot=robot.name,
        cameras=[episode.cameras[v] for v in episode.views if v not in episode.unknown],
        moving=episode.camera_tracks,
        objects=names,
        metadata=_metadata(episode, source, key),
        jpeg_quality=mapping.jpeg_quality,
    ) as writer:
        writer.outcome = mapping.outcome if mapping.outcome != 'unknown' else episode.info.outcome
        frames = _FrameWriter(writer, stage.masks(out.name, writer), episode)
        for write in _in_order(
            episode, writer, frames, robot, stamps, positions, commands, mapping
        ):
            write()
        warnings += frames.finish()
    return tuple(warnings)


@dataclass(slots=True)
class _FrameWriter:
    """Writer of frames that leaves damaged ones out.

    Attributes:
        writer: writer of the episode.
        masks: writer of the masks of its frames.
        episode: recording as it was read.
        damaged: faults of the damaged frames, by view.
    """

    writer: EpisodeWriter
    masks: MaskWriter
    episode: Episode
    damaged: dict[str, list[str]] = field(default_factory=dict)

    def write(self, view: str, index: int) -> None:
        """Write a frame and find its masks; note a damaged one."""
        track = self.episode.images[view]
        stamp = int(track.stamps_ns[index])
        try:
            frame = track.frames[index]
        except DamagedFrameError as error:
            self.damaged.setdefault(view, []).append(str(error))
            return
        self.writer.write_image(view, stamp, frame)
        self.masks.add(view, stamp, frame)

    def finish(self) -> list[str]:
        """Write the masks of the frames that wait; return a line for each view's damaged frames.

        Raises:
            EpisodeError: a view has fewer than two frames that are not damaged.
        """
        self.masks.finish()
        notes = []
        for view, faults in self.damaged.items():
            count = len(self.episode.images[view].stamps_ns)
            text = f"view '{view}': {len(faults)} of {count} frames were left out, {faults[0]}"
            if count - len(faults) < 2:
                raise EpisodeError(text)
            notes.append(text)
        return notes


def _check_views(episode: Episode) -> None:
    """Refuse a view that cannot be one: a still, as of a topic that was published once."""
    for view, track in episode.images.items():
        if len(track.stamps_ns) < 2:
            others = [name for name in episode.views if name != view]
            raise EpisodeError(
                f"'{episode.info.path}', view '{view}': it has {len(track.stamps_ns)} frame, at "
                "least 2 are needed; name the other views in the mapping (--topics): 'views' with "
                f'{", ".join(others) or "a topic of images"}'
            )


def _measured(
    episode: Episode, robot: RobotModel, mapping: BagMapping
) -> tuple[np.ndarray, FloatArray]:
    """Return the stamps (N,) and positions (N, J) in the robot's order."""
    states = episode.joint_states
    if states is None:
        hints = [text for text in episode.warnings if 'joint states' in text]
        raise EpisodeError(f"'{episode.info.path}' has no joint states{': '.join(['', *hints])}")
    seconds = (states.stamps_ns - states.stamps_ns[0]) * 1e-9
    table = JointTrajectory(
        joint_names=states.joint_names,
        times=np.asarray(seconds, np.float64),
        positions=states.positions,
    )
    positions = match_joints(table, robot).positions
    _check(robot, positions, mapping, 'joint states')
    return states.stamps_ns, positions


def _commands(
    episode: Episode, robot: RobotModel, mapping: BagMapping
) -> list[tuple[int, JointTrajectory]]:
    if not episode.trajectories:
        topic = mapping.topic(mapping.action)
        reasons = [f' ({warning})' for warning in episode.warnings if f"'{topic}'" in warning]
        raise EpisodeError(
            f"'{episode.info.path}' has no commands at '{topic}'{''.join(reasons)}; name "
            "their topic with --action or in the mapping's 'action', or set 'action: state' "
            '(--action state) to take the measured positions'
        )
    matched = [(stamp, match_joints(t, robot)) for stamp, t in episode.trajectories]
    for _, trajectory in matched:
        _check(robot, trajectory.positions, mapping, 'commands')
    return matched


def _check(robot: RobotModel, positions: FloatArray, mapping: BagMapping, what: str) -> None:
    try:
        check_positions(robot, positions, tolerance=mapping.limit_tolerance)
    except TrajectoryError as error:
        raise TrajectoryError(
            f"{what}: {error}; are the joints' names, units and the gripper's range those of the "
            'robot? (limit_tolerance in the mapping says how far outside is accepted)'
        ) from error


def _in_order(
    episode: Episode,
    writer: EpisodeWriter,
    image_writer: _FrameWriter,
    robot: RobotModel,
    stamps: np.ndarray,
    positions: FloatArray,
    commands: Sequence[tuple[int, JointTrajectory]],
    mapping: BagMapping,
) -> list[Callable[[], Any]]:
    """Return the write calls, sorted by stamp."""
    entries: list[tuple[int, int, Callable[[], Any]]] = []

    def add(stamp: int, rank: int, write: Callable[..., Any], *values: Any) -> None:
        entries.append((stamp, rank, lambda: write(*values)))

    for stamp, words in _instructions(episode, mapping, int(stamps[0])):
        add(stamp, 0, writer.write_instruction, stamp, words)
    for stamp, row in zip(stamps.tolist(), positions, strict=True):
        add(stamp, 1, writer.write_joint_states, stamp, robot.joint_names, row)
    for stamp, trajectory in commands:  # after what it starts from, so that it can be played
        add(stamp, 6, writer.write_trajectory, stamp, trajectory)
    frames = [(v, s, i) for v in episode.views for i, s in enumerate(episode.images[v].stamps_ns)]
    for view, stamp_ns, index in frames:
        stamp = int(stamp_ns)
        add(stamp, 3, _write_camera_info, writer, episode, view, stamp)
        if view in episode.camera_tracks:
            camera = episode.camera(view, index)
            mount, T = camera.mount_link, camera.T_mount_camera
            add(stamp, 3, writer.write_camera_pose, view, stamp, mount, T)
        add(stamp, 4, image_writer.write, view, index)
    masks = episode.masks or {}
    for view, stamp, index in ((v, s, i) for v in masks for i, s in enumerate(masks[v].stamps_ns)):
        add(int(stamp), 5, _write_mask, writer, view, int(stamp), masks[view].frames, index)
    return [write for _, _, write in sorted(entries, key=lambda entry: entry[:2])]


def _instructions(episode: Episode, mapping: BagMapping, start_ns: int) -> list[tuple[int, str]]:
    """Return the instructions by stamp, at least one."""
    if mapping.instruction or not episode.instructions:
        return [(start_ns, mapping.instruction or episode.info.instruction)]
    return list(episode.instructions)


def _metadata(episode: Episode, source: str, key: str) -> dict[str, str]:
    """Return the metadata on the source of the episode and the segmenter of its masks."""
    values = {'source': source, MAPPING_KEY: key}
    place = episode.info.place  # of simulated episodes the simulator, whose name has the physics
    values |= {PLACE: place} if place else {}
    values |= {PHYSICS: episode.info.physics} if episode.info.physics else {}
    values |= {UNKNOWN_CAMERAS: ', '.join(episode.unknown)} if episode.unknown else {}
    by = episode.info.metadata.get(MASKS_BY, '')
    return {**values, MASKS_BY: by} if episode.masks and by else values


def _write_camera_info(writer: EpisodeWriter, episode: Episode, view: str, stamp_ns: int) -> None:
    if episode.unknown.get(view, 'pose') == 'pose':  # the intrinsics are known
        writer.write_camera_info(view, stamp_ns, episode.cameras[view])


def _write_mask(writer: EpisodeWriter, view: str, stamp: int, frames: Any, index: int) -> None:
    writer.write_mask(view, stamp, frames[index])
