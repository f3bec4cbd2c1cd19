"""Reads a recorded episode: images, joint states, commands, masks, calibration, outcome."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
import os
from pathlib import Path
import re
from typing import Any, TypeVar
import warnings

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.cameras.camera import unknown_camera
from mtv_world_ros.cameras.camera_info import Intrinsics, is_rectified, read_camera_info
from mtv_world_ros.cameras.foreign_calibrations import (
    ForeignCalibration,
    FramePose,
    Lens,
    read_foreign,
)
from mtv_world_ros.cameras.image_window import ImageWindow, WHOLE, windowed_camera
from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray, JointTrajectory
from mtv_world_ros.core.errors import (
    CalibrationError,
    EpisodeError,
    MtvWorldError,
    TrajectoryError,
)
from mtv_world_ros.core.files import check_name
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.command_messages import (
    command_topics,
    CommandReader,
    FLOAT_ARRAY,
    READ_AS,
)
from mtv_world_ros.data.bag.image_decoding import check_decodable, check_image, to_ids, to_rgb
from mtv_world_ros.data.bag.image_orientation import stored_note
from mtv_world_ros.data.bag.messages import IMAGE_TYPES
from mtv_world_ros.data.bag.reader import BagMessage, BagReader, is_storage
from mtv_world_ros.data.bag.unused_topics import unused_topics
from mtv_world_ros.data.bag.video_packets import (
    check_packet,
    FFMPEG_PACKET,
    from_first_key,
    VideoFrames,
)
from mtv_world_ros.data.bag_mapping import BagMapping, STATE, ToolTopic
from mtv_world_ros.data.episode import (
    CALIBRATION_FILE,
    Episode,
    EpisodeInfo,
    image_topic,
    INSTRUCTION,
    JOINT_STATES,
    JOINT_TRAJECTORY,
    JointStates,
    LazyFrames,
    METADATA_NAME,
    OBJECT_POSES,
    ObjectPoses,
    optical_frame,
    OtherDirection,
    parse_info,
    TF,
    TF_STATIC,
    Track,
)
from mtv_world_ros.data.gripper_sources import resting_grippers
from mtv_world_ros.data.joint_plans import (
    complete_plans,
    hold_at_stops,
    join_streams,
    read_plan,
    trajectories_to,
)
from mtv_world_ros.data.measured_joints import merge_joint_states
from mtv_world_ros.data.missing_joints import missing_joints_text
from mtv_world_ros.data.stream_clocks import (
    arrival_times,
    ClockBreakError,
    CLOCKS,
    settle_clocks,
    StampedStream,
    Window,
)
from mtv_world_ros.data.stream_clocks import (
    WHOLE as WHOLE_BAG,
)
from mtv_world_ros.data.tool_targets import joints_of_tools, ToolTrack
from mtv_world_ros.data.transform_tree import Mount, pose_track, read_tree, TransformTree
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.resample import match_joints, nearest_rows

Stamped = list[tuple[int, Any]]
#: joints that a warning names at most
_MOST_NAMES = 8
#: intrinsics that differ by less of the focal length are the same
_SAME_K = 0.005
#: largest distance of a mask from the image that it belongs to [median period of the images]
_MAX_MASK_OFFSET = 0.6
#: largest share of a view's images without a mask of their time at which its masks are used
_MAX_UNMASKED = 0.1
#: keys of a topic map that are not views, and the topics they stand for
STREAMS = {
    'joint_states': JOINT_STATES,
    'joint_trajectory': JOINT_TRAJECTORY,
    'instruction': INSTRUCTION,
    'object_poses': OBJECT_POSES,
}
TF_TOPICS = (TF, TF_STATIC)
#: frames further away from all joint states share no moment with them [s]
MAX_FRAME_AWAY_S = 0.5
NANO = 1_000_000_000
_PLAIN_VIEW = re.compile(r'/([^/]+)/image_raw(?:/compressed|/ffmpeg)?')
Item = TypeVar('Item')


def read_episode(
    path: Path | str,
    *,
    views: Sequence[str] | None = None,
    calibration: Path | str | None = None,
    with_cameras: bool = True,
    with_masks: bool = True,
    topics: Mapping[str, str] | None = None,
    mapping: BagMapping | None = None,
    robot: RobotModel | None = None,
    unknown_mount: str = '',
    window: Window = WHOLE_BAG,
    decode_all: bool = True,
) -> Episode:
    """Read an episode; frames are decoded on access.

    Times are the headers' stamps, or the log time where a header has none. Messages that are
    damaged are skipped, and every problem is a line in the result's `warnings`.

    Args:
        path: rosbag2 folder, also one that was cut off, or .mcap file.
        views: views to read; None = all.
        calibration: camera calibration; None = calibration.yaml in the folder, or else poses of
            /tf and /tf_static with the intrinsics of CameraInfo.
        with_cameras: whether the cameras are needed.
        with_masks: whether to read object masks where there are any.
        topics: topics that differ from the default names, by view or by `joint_states`,
            `joint_trajectory`, `instruction`, `object_poses`, e.g.
            `{'low': '/camera_low/color/image_raw'}`.
        mapping: topics of a robot's own bag; `topics` takes precedence.
        robot: robot whose links may carry cameras with poses from TF; None = any frame may.
        unknown_mount: link that carries cameras whose pose is not known; they get a placeholder
            (without a CameraInfo, for the intrinsics too) and are named in `Episode.unknown`;
            empty = they are an error.
        window: the part of the recording that is wanted, by receive times.
        decode_all: whether the JPEG frames of a recording of others are decoded once, and damaged
            ones left out; False = damaged ones raise `DamagedFrameError` when they are read.

    Raises:
        ClockBreakError: all clocks change at once; its windows are the parts.
        EpisodeError: no bag, a view is missing, or none of its images can be used; streams are
            not of one clock, or share no moment.
        CalibrationError: a view's calibration is missing or does not fit its CameraInfo.
    """
    reader = _EpisodeReader(Path(path), views, topics or {}, with_masks, mapping, robot, window)
    reader.decode_all = decode_all
    return reader.read(calibration, with_cameras, unknown_mount)


def read_info(path: Path | str) -> EpisodeInfo:
    """Return task, outcome and objects, from metadata.yaml where possible.

    Raises:
        EpisodeError: no bag, or its metadata cannot be used.
    """
    reader = BagReader(path)
    if 'outcome' in reader.custom_data:
        return _info(reader, [])
    texts = [
        (message.stamp_ns, messages.deserialize(messages.STRING, message.data).data)
        for message in reader.messages({'/instruction'})
    ]
    return _info(reader, texts)


#: environment variable that has links followed out of folders of episodes
FOLLOW_LINKS = 'MTV_WORLD_FOLLOW_LINKS'


class LinkWarning(UserWarning):
    """A link that leads out of a folder was not followed."""


def list_episodes(folder: Path | str) -> list[Path]:
    """Return the episode folders anywhere in a folder, by path.

    A folder with files of a bag is one without metadata.yaml, too: its recorder was killed. Hidden
    folders are left out. Links are followed within the folder, and to single episodes; others that
    lead out of it are named in a `LinkWarning`, unless `MTV_WORLD_FOLLOW_LINKS` is 1.
    """
    found, seen, inside = [], set(), os.path.realpath(folder)
    follows = os.environ.get(FOLLOW_LINKS) == '1'
    for place, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        if real in seen:  # links may lead in a circle
            folders.clear()
            continue
        seen.add(real)
        if _holds_bag(names) and not Path(place).name.startswith('.'):
            check_name(real)
            found.append(Path(place))
        if not follows:
            folders[:] = [name for name in folders if _is_followed(Path(place) / name, inside)]
    return sorted(found)


def _holds_bag(names: Sequence[str]) -> bool:
    return 'metadata.yaml' in names or any(is_storage(Path(name)) for name in names)


def _is_followed(entry: Path, inside: str) -> bool:
    """Return whether a folder below `inside` is searched; name links that are not followed."""
    if not entry.is_symlink():
        return True
    target = os.path.realpath(entry)
    if os.path.commonpath([target, inside]) == inside:
        return True
    if _holds_bag(os.listdir(entry) if os.access(entry, os.R_OK) else []):
        return True
    warnings.warn(
        f"'{entry}' leads out of its folder to '{target}' and is not followed; give that folder "
        f'itself, or set {FOLLOW_LINKS}=1',
        LinkWarning,
        stacklevel=3,
    )
    return False


class _EpisodeReader:
    def __init__(
        self,
        path: Path,
        views: Sequence[str] | None,
        named: Mapping[str, str],
        with_masks: bool,
        mapping: BagMapping | None,
        robot: RobotModel | None,
        window: Window,
    ) -> None:
        self.path, self.robot, self.window = path, robot, window
        self.mapping = mapping or BagMapping()
        named = {**asked_topics(mapping, views), **named}
        self.bag = BagReader(path)
        self.warnings: list[str] = []
        found = self.bag.topics()
        self.types = found
        try:
            self.topics: EpisodeTopics = find_topics(path, found, views, named)
        except EpisodeError as error:
            text = f'{error}; {self.bag.truncated}' if self.bag.truncated else str(error)
            recorded = self.bag.custom_data.get('robot', '')
            if robot is not None and recorded not in ('', robot.name):
                text = f"it is of another robot: '{recorded}', not '{robot.name}': {text}"
            raise EpisodeError(text) from error
        further = self.mapping.state_topics[1:]
        self.state_topics = (self.topics.joint_states, *further)
        self.command_topics = self._find_commands()
        self.with_masks = with_masks
        self.decode_all = True
        self.received: dict[str, Stamped] = {}
        self.arrived: dict[str, NDArray[np.int64]] = {}
        self.refused: dict[str, list[str]] = {}
        self.tracks: dict[str, FloatArray] = {}
        self.unknown: dict[str, str] = {}
        self.unknown_because: dict[str, str] = {}
        self.is_calibrated = False
        self.given_tf: list[Any] = []
        self.other_directions: dict[str, OtherDirection] = {}
        self.infos: dict[str, list[tuple[Any, Intrinsics]]] = {}
        self.seen_ns = 0  # all views have an image from here on

    def read(
        self, calibration: Path | str | None, with_cameras: bool, unknown_mount: str
    ) -> Episode:
        self._receive()
        topics = self.topics
        images = {view: self._images(view, names) for view, names in topics.views.items()}
        self.seen_ns = max((int(track.stamps_ns[0]) for track in images.values()), default=0)
        masks = {
            view: self._timely_masks(view, images[view], self._masks(names))
            for view, names in topics.views.items()
        }
        instructions = [(s, m.data) for s, m in self._take(topics.instruction, messages.STRING)]
        states = self._states()
        self._check_shared(images, states)
        cameras = self._cameras(calibration, images, unknown_mount) if with_cameras else {}
        episode_info = _info(self.bag, instructions)
        trajectories = self._trajectories(states)
        self._warn_of_resting_grippers(states, trajectories)
        return Episode(
            info=episode_info,
            views=tuple(topics.views),
            cameras=cameras,
            images=images,
            joint_states=states,
            trajectories=trajectories,
            masks={view: track for view, track in masks.items() if track} or None,
            instructions=instructions,
            object_poses=self._object_poses(len(episode_info.objects)),
            unknown=self.unknown,
            unknown_because=self.unknown_because,
            camera_tracks=self.tracks,
            truncated=bool(self.bag.truncated),
            warnings=self._all_warnings(),
            unused=self._unused(),
            other_directions=self.other_directions,
        )

    def _unused(self) -> dict[str, str]:
        """Return why recorded topics are not part of the episode, by topic."""
        topics, mapping = self.topics, self.mapping
        used = topics.names(with_masks=True) | {self._camera_info(view) for view in topics.views}
        used |= {mapping.topic(tool.topic) for tool in mapping.tools.values()}
        used |= {*self.state_topics, *self.command_topics}
        if mapping.action == STATE:
            used -= {topics.joint_trajectory, *self.command_topics}
        if mapping.instruction:
            used.discard(topics.instruction)
        if not self.is_calibrated:
            used |= set(TF_TOPICS)
        images = [view.image for view in topics.views.values()]
        unused = unused_topics(self.types, used, images, mapping)
        if self.robot is not None:
            for topic in self.state_topics:
                if names := self._joints_of_others(topic, self.robot):
                    unused[f'{", ".join(names)} of {topic}'] = 'no joint of the robot'
        return unused

    def _joints_of_others(self, topic: str, robot: RobotModel) -> dict[str, None]:
        """Return the joints that are recorded beside those of the robot, in order."""
        items = self.received.get(topic, [])
        kinds = {tuple(m.name) for _, (kind, m) in items if kind == messages.JOINT_STATE}
        wanted = set(robot.joint_names)
        own = [names for names in sorted(kinds) if not wanted.isdisjoint(self._renamed(names))]
        names = [name for names in own for name in names]
        return dict.fromkeys(n for n in names if self.mapping.joint_name(n) not in wanted)

    def _find_commands(self) -> tuple[str, ...]:
        """Return the topics of the commands.

        Where a bag has no JointTrajectory, those of controllers and actions stand in.
        """
        topic = self.topics.joint_trajectory
        is_default = self.mapping.action == BagMapping.model_fields['action'].default
        has_plans = bool(self._topics_of(messages.JOINT_TRAJECTORY))
        if topic in self.types or not is_default or has_plans:
            return (topic,)
        found = command_topics(self.types)
        if found:
            self.warnings.append(
                f"there is no '{topic}': commands are those of {', '.join(found)} "
                f'({_kind_of(self.types[found[0]])}); --action names another topic'
            )
        return found or (topic,)

    def _parse(self, message: BagMessage, commands: Mapping[str, CommandReader]) -> Any:
        """Return the type and the message; commands of other types as those they are read as."""
        if message.topic in commands and message.msgtype in READ_AS:
            found = commands[message.topic].read(message.msgtype, message.data)
            return READ_AS[message.msgtype], found
        parsed = messages.deserialize(message.msgtype, message.data)
        if message.msgtype == messages.JOINT_STATE and not parsed.name and len(parsed.position):
            parsed.name = self._names_of(message.topic, len(parsed.position))
        return message.msgtype, parsed

    def _names_of(self, topic: str, count: int) -> list[str]:
        """Return the names of joint states without names, from the mapping.

        Raises:
            EpisodeError: it has none, or another number.
        """
        is_state = topic in self.state_topics
        key = 'state_joints' if is_state else 'action_joints'
        names = self.mapping.state_joints if is_state else self.mapping.action_joints
        if len(names) != count:
            raise EpisodeError(
                f"its joint states have {count} positions and no names; '{key}' in the mapping "
                f'(--topics) must name as many, in their order, and has: {_listed(names)}'
            )
        return list(names)

    def _receive(self) -> None:
        wanted = self.topics.names(with_masks=self.with_masks) | set(TF_TOPICS)
        wanted |= set(self.command_topics)
        wanted |= {self._camera_info(view) for view in self.topics.views}
        wanted |= {self.mapping.topic(tool.topic) for tool in self.mapping.tools.values()}
        wanted |= set(self.state_topics)
        logged: dict[str, list[tuple[int, int]]] = {}
        is_state = self.mapping.action == STATE
        readers = (
            {}
            if is_state
            else {
                topic: CommandReader(self.mapping.action_joints) for topic in self.command_topics
            }
        )
        for index, message in enumerate(self.bag.messages(wanted)):
            try:
                kind, parsed = self._parse(message, readers)
            except EpisodeError as error:
                self._refuse(message.topic, error)
                continue
            if parsed is None:
                continue
            stamp = messages.header_stamp(parsed) if hasattr(parsed, 'header') else 0
            self.received.setdefault(message.topic, []).append((stamp, (kind, parsed)))
            logged.setdefault(message.topic, []).append((index, message.stamp_ns))
        places = {topic: np.array(rows, np.int64).T for topic, rows in logged.items()}
        self.arrived = arrival_times(
            {topic: each[1] for topic, each in places.items()},
            {topic: each[0] for topic, each in places.items()},
        )
        self._cut_window()
        self._settle_clocks()

    def _cut_window(self) -> None:
        """Leave out what is not in the window; what holds for good stays."""
        if self.window == WHOLE_BAG:
            return
        infos = {self._camera_info(view) for view in self.topics.views}
        for topic, arrived in self.arrived.items():
            rows = [k for k, ns in enumerate(arrived.tolist()) if self.window.has(ns)]
            if topic == self.topics.instruction:  # the last one before it still holds
                earlier = np.flatnonzero(arrived < self.window.begin_ns)
                rows = [*earlier[-1:].tolist(), *rows]
            if topic == TF_STATIC or topic in infos and not rows:
                continue
            self.received[topic] = [self.received[topic][k] for k in rows]
            self.arrived[topic] = arrived[rows]

    def _settle_clocks(self) -> None:
        """Bring stamps of images, joint states and commands onto one clock."""
        rows = self._senders()
        streams = [stream for stream, _, _ in rows]
        try:
            settled = settle_clocks(streams)
        except ClockBreakError as error:
            raise ClockBreakError(f"'{self.path}': {error}", error.windows) from error
        except EpisodeError as error:
            raise EpisodeError(f"'{self.path}': {error}") from error
        self.warnings += dict.fromkeys(settled.notes)
        stamps = {topic: self._other_stamps(topic, settled.offset_s) for topic in self.received}
        is_kept = {topic: np.ones(len(items), bool) for topic, items in self.received.items()}
        for (_, topic, at), mended, kept in zip(
            rows, settled.stamps_ns, settled.is_kept, strict=True
        ):
            stamps[topic][at], is_kept[topic][at] = mended, kept
        for topic, items in self.received.items():
            each = zip(stamps[topic].tolist(), is_kept[topic].tolist(), items, strict=True)
            self.received[topic] = [(stamp, item) for stamp, kept, (_, item) in each if kept]

    def _other_stamps(self, topic: str, offset_s: float) -> NDArray[np.int64]:
        """Return the stamps of a topic as they are.

        Receive times on the clock of the others where 0.
        """
        stamps = np.array([stamp for stamp, _ in self.received[topic]], np.int64)
        is_far = not -CLOCKS.refused_behind_s < offset_s < CLOCKS.refused_ahead_s
        shift = round(offset_s * 1e9) if is_far else 0
        return np.where(stamps == 0, np.maximum(self.arrived[topic] + shift, 1), stamps)

    def _senders(self) -> list[tuple[StampedStream, str, NDArray[np.intp]]]:
        """Streams whose clocks are compared, their topics, and which of its messages they are."""
        keys = {names.image: view for view, names in self.topics.views.items()}
        keys |= dict.fromkeys(self.state_topics, 'joint_states')
        if self.mapping.action != STATE:
            keys |= dict.fromkeys(self.command_topics, 'action')
        keys |= {self.mapping.topic(tool.topic): arm for arm, tool in self.mapping.tools.items()}
        found = []
        for topic, key in keys.items():
            items = self.received.get(topic, [])
            senders: dict[tuple[str, ...], list[int]] = {}
            for row, (_, (kind, message)) in enumerate(items):
                names = tuple(message.name) if kind == messages.JOINT_STATE else ()
                senders.setdefault(names, []).append(row)
            for names, rows in senders.items():
                at = np.array(rows, np.intp)
                spans = [_span(items[row][1]) for row in rows]
                stream = StampedStream(
                    name=topic if len(senders) == 1 else f'{topic} of {names[0]}',
                    key=key,
                    stamps_ns=np.array([items[row][0] for row in rows], np.int64),
                    received_ns=self.arrived[topic][at],
                    spans_ns=None if None in spans else np.array(spans, np.int64),
                    use_received=key in self.mapping.received_times,
                )
                found.append((stream, topic, at))
        return found

    def _check_shared(self, images: Mapping[str, Track], states: JointStates | None) -> None:
        """Refuse frames that share no moment with the joint states."""
        if states is None:
            return
        low, high = int(states.stamps_ns[0]), int(states.stamps_ns[-1])
        slack = round(MAX_FRAME_AWAY_S * NANO)
        for view, track in images.items():
            stamps = track.stamps_ns
            if not ((stamps >= low - slack) & (stamps <= high + slack)).any():
                raise EpisodeError(
                    f"'{self.path}': no frame of view '{view}' has joint states: its frames are "
                    f'from {stamps[0] / NANO:.3f} to {stamps[-1] / NANO:.3f} s, '
                    f"'{self.topics.joint_states}' from {low / NANO:.3f} to {high / NANO:.3f} s. "
                    'Are both stamped by one clock, and were both recorded all the time?'
                )

    def _images(self, view: str, names: ViewTopics) -> Track:
        track = self._track(names.image, to_rgb)
        if track is None:
            reasons = self.refused.get(names.image) or ['it holds no messages']
            raise EpisodeError(f"'{self.path}', view '{view}': '{names.image}': {reasons[0]}")
        return track

    def _masks(self, names: ViewTopics) -> Track | None:
        return self._track(names.mask, to_ids) if self.with_masks else None

    def _timely_masks(self, view: str, images: Track, masks: Track | None) -> Track | None:
        """Return the masks of a view; None, with a warning, if they are of other times."""
        if masks is None:
            return None
        own, stamps = masks.stamps_ns, images.stamps_ns
        apart = np.abs(own[nearest_rows(own, stamps)] - stamps)
        period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else np.inf
        share = float((apart > _MAX_MASK_OFFSET * period).mean())
        if share <= _MAX_UNMASKED:
            return masks
        self._warn_once(
            f"view '{view}': {share:.0%} of its {len(stamps)} images have no mask of their time "
            f'({len(own)} masks, up to {apart.max() / NANO:.2f} s apart): its masks are not used; '
            'import the recording again with masks of every image'
        )
        return None

    def _track(self, topic: str, decode: Callable[[Any], ByteArray]) -> Track | None:
        check = check_packet if self.types.get(topic) == FFMPEG_PACKET else check_image
        good: Stamped = []
        for stamp, (_, message) in self.received.get(topic, []):
            try:
                check(message)
                good.append((stamp, message))
            except MtvWorldError as error:
                self._refuse(topic, error)
        if self.types.get(topic) == FFMPEG_PACKET:
            return self._video(topic, good)
        if decode is to_rgb:
            good = self._whole(topic, good)
        if not good:
            return None
        ordered = in_order(topic, good, self.warnings)
        if hasattr(good[0][1], 'format') and (note := stored_note(bytes(good[0][1].data))):
            self._warn_once(f"'{topic}': {note}")
        stamps = np.array([stamp for stamp, _ in ordered], np.int64)
        return Track(stamps, LazyFrames(topic, [message for _, message in ordered], decode))

    def _whole(self, topic: str, images: Stamped) -> Stamped:
        """Return the images that are not damaged; without `decode_all` from the first such on."""
        if METADATA_NAME in self.bag.metadata:  # written by this package
            return images
        whole: Stamped = []
        for number, (stamp, message) in enumerate(images):
            if whole and not self.decode_all:
                return [*whole, *images[number:]]
            try:
                check_decodable(message)
                whole.append((stamp, message))
            except MtvWorldError as error:
                self._refuse(topic, error)
        return whole

    def _video(self, topic: str, packets: Stamped) -> Track | None:
        whole = from_first_key(in_order(topic, packets, self.warnings))
        if len(whole) < len(packets):
            self._warn_once(f"'{topic}': {len(packets) - len(whole)} packets before the first key "
                            'frame were left out')  # fmt: skip
        if not whole:
            return None
        stamps = np.array([stamp for stamp, _ in whole], np.int64)
        return Track(stamps, VideoFrames(topic, [message for _, message in whole]))

    def _take(self, topic: str, msgtype: str) -> Stamped:
        """Return the messages of a topic, in recorded order; those of another type are refused."""
        taken: Stamped = []
        for stamp, (kind, message) in self.received.get(topic, []):
            if kind == msgtype:
                taken.append((stamp, message))
            else:
                self._refuse(topic, EpisodeError(f'it holds {kind}, expected {msgtype}'))
        return taken

    def _parsed(
        self, topic: str, msgtype: str, parse: Callable[[Any], Item]
    ) -> list[tuple[int, Item]]:
        """Return the parsed messages of a topic and their stamps [ns]; refuse invalid ones."""
        good = []
        for stamp, message in self._take(topic, msgtype):
            try:
                good.append((stamp, parse(message)))
            except (ValueError, MtvWorldError) as error:
                self._refuse(topic, error)
        return in_order(topic, good, self.warnings)

    def _states(self) -> JointStates | None:
        topics = self.state_topics
        taken = [
            item
            for topic in topics
            for item in self._own_states(topic, self._take(topic, messages.JOINT_STATE))
        ]
        states = merge_joint_states(
            ', '.join(topics),
            taken,
            self.warnings,
            self.robot,
            self._renamed,
            self.mapping.constants,
        )
        if states is None:
            others = self._topics_of(messages.JOINT_STATE)
            if others and set(topics).isdisjoint(others):
                self._warn_once(
                    f"no joint states at '{', '.join(topics)}'; there are some at "
                    f'{_listed(others)}: name the topic in `joint_states`'
                )
        elif self.robot is not None:
            missing = [n for n in self.robot.joint_names if n not in states.joint_names]
            if missing:
                raise TrajectoryError(self._missing_joints(self.robot, states, missing))
        return states

    def _missing_joints(
        self, robot: RobotModel, states: JointStates, missing: Sequence[str]
    ) -> str:
        """Return which joints are not measured, and how the mapping gives them."""
        recorded = self._other_joints()
        return missing_joints_text(robot, self.mapping, states.joint_names, missing, recorded)

    def _warn_of_resting_grippers(self, states: JointStates | None, trajectories: Stamped) -> None:
        """Name grippers that are measured at one position all the time while they are commanded.

        A topic that measures them is named, too.
        """
        robot = self.robot
        if (
            robot is None
            or states is None
            or not set(robot.joint_names) <= set(states.joint_names)
        ):
            return
        columns = [states.joint_names.index(name) for name in robot.joint_names]
        plans = [match_joints(plan, robot).positions for _, plan in trajectories]
        resting = resting_grippers(states.positions[:, columns], plans, robot)
        others = self._other_joints() if resting else {}
        for joint, text in resting.items():
            topics = [topic for topic, names in others.items() if joint in names]
            listed = ', '.join([*self.state_topics, *topics])
            self._warn_once(
                f"{text}; {', '.join(topics)} has it, too: 'joint_states: [{listed}]' in the "
                'mapping (--topics)'
                if topics
                else f'{text}: is it measured on a topic that was not recorded?'
            )

    def _other_joints(self) -> dict[str, tuple[str, ...]]:
        """Return the names of the joints in topics of joint states that are not read, by topic."""
        others = [t for t in self._topics_of(messages.JOINT_STATE) if t not in self.state_topics]
        others = [topic for topic in others if topic not in self.command_topics]
        found: dict[str, dict[str, None]] = {topic: {} for topic in others}
        for message in self.bag.messages(others) if others else ():
            state = messages.deserialize(message.msgtype, message.data)
            found[message.topic].update(dict.fromkeys(self._renamed(state.name)))
        return {topic: tuple(names) for topic, names in found.items()}

    def _own_states(self, topic: str, taken: Stamped) -> Stamped:
        """Return the messages that name a joint of the robot.

        All, where none does or it is not known.
        """
        joints = set(() if self.robot is None else self.robot.joint_names)
        own: Stamped = []
        others: dict[str, None] = {}
        for item in taken:
            names = self._renamed(item[1].name)
            if joints.isdisjoint(names):
                others.update(dict.fromkeys(names))
            else:
                own.append(item)
        if not own or len(own) == len(taken):
            return taken
        named = [*list(others)[:_MOST_NAMES], *(['...'] if len(others) > _MOST_NAMES else [])]
        self._warn_once(
            f"'{topic}': {len(taken) - len(own)} messages without a joint of the robot were left "
            f'out; they name {_listed(named)}'
        )
        return own

    def _renamed(self, names: Sequence[str]) -> tuple[str, ...]:
        return tuple(map(self.mapping.joint_name, names))

    def _trajectories(self, states: JointStates | None) -> Stamped:
        others = self._joint_commands(states)
        if not self.mapping.tools or states is None or self.robot is None:
            return others
        targets = {
            arm: self._tool_poses(arm, tool, self.robot)
            for arm, tool in self.mapping.tools.items()
        }
        try:
            led, warnings = joints_of_tools(targets, self.robot, states, others)
        except ValueError as error:
            raise EpisodeError(f"'{self.path}': {error}") from error
        self.warnings += warnings
        return trajectories_to(led, self.mapping.chunk_s, self.seen_ns)

    def _tool_poses(self, arm: str, tool: ToolTopic, robot: RobotModel) -> ToolTrack:
        topic = self.mapping.topic(tool.topic)
        ordered = self._parsed(topic, messages.POSE_STAMPED, _framed_pose)
        if not ordered:
            raise EpisodeError(
                f"'{self.path}' has no poses of arm '{arm}' at '{topic}'; its topics of "
                f'PoseStamped are {_listed(self._topics_of(messages.POSE_STAMPED))}'
            )
        frames = {frame.lstrip('/').removeprefix(self.mapping.tf_prefix)
                  for _, (frame, _) in ordered}  # fmt: skip
        if not tool.frame and frames != {''}:
            unknown = sorted(frames - set(robot.link_names))
            if unknown or len(frames) > 1:
                raise EpisodeError(
                    f"'{self.path}': the poses at '{topic}' are in frame "
                    f"'{(unknown or sorted(frames))[0]}', which is no link of robot "
                    f"'{robot.name}' or not the only one; name the link in `tools: {arm}: frame`"
                )
            tool = tool.replace(frame=frames.pop())
        return ToolTrack(
            tool,
            np.array([stamp for stamp, _ in ordered], np.int64),
            np.stack([pose for _, (_, pose) in ordered]),
        )

    def _topics_of(self, kind: str) -> list[str]:
        return [name for name, found in self.types.items() if found == kind]

    def _joint_commands(self, states: JointStates | None) -> Stamped:
        topics = self.command_topics
        topic = ', '.join(topics)
        if self.mapping.action == STATE:
            return (
                []
                if states is None
                else trajectories_to(states, self.mapping.chunk_s, self.seen_ns)
            )
        kind = self.types.get(topics[0], '')
        if READ_AS.get(kind, kind) == messages.JOINT_STATE:
            taken = [item for one in topics for item in self._take(one, messages.JOINT_STATE)]
            leader = merge_joint_states(topic, taken, self.warnings, renamed=self._renamed)
            if leader is None:
                return []
            led = trajectories_to(leader, self.mapping.chunk_s, self.seen_ns)
            return self._completed(topic, led, states)
        plan = self._plan if states is None else self._plan_or_stop
        plans = sorted(
            (
                item
                for one in topics
                for item in self._parsed(one, messages.JOINT_TRAJECTORY, plan)
            ),
            key=lambda item: item[0],
        )
        if states is not None:
            plans, count = hold_at_stops(plans, states)
            if count:
                self._warn_once(
                    f"'{topic}': {count} empty trajectories stop the plans before them; the "
                    'measured positions are held from then on, until the next plan'
                )
        if topics[0] not in self.types:
            self._warn_of_other_commands(topic)
        return self._whole_plans(topic, plans, states)

    def _warn_of_other_commands(self, topic: str) -> None:
        """Name the topics that have commands where the one of the mapping has none."""
        others = self._topics_of(messages.JOINT_TRAJECTORY) or list(command_topics(self.types))
        if others:
            self._warn_once(f"no trajectories at '{topic}'; there are some at {_listed(others)}")
        if arrays := self._topics_of(FLOAT_ARRAY):
            self._warn_once(
                f"no trajectories at '{topic}'; {_listed(arrays)} has values without names: with "
                f"'action: {arrays[0]}' in the mapping (--topics), 'action_joints' names them in "
                "the order of the controller's 'joints'"
            )

    def _plan_or_stop(self, message: Any) -> JointTrajectory | tuple[str, ...]:
        """Return a plan, or the joints that an empty trajectory stops; empty = all."""
        if not len(message.points):
            return self._renamed(message.joint_names)
        return self._plan(message)

    def _plan(self, message: Any) -> JointTrajectory:
        plan = read_plan(message)
        return replace(plan, joint_names=self._renamed(plan.joint_names))

    def _whole_plans(self, topic: str, plans: Stamped, states: JointStates | None) -> Stamped:
        """Return the plans of all joints of the robot; those of one point are joined."""
        chunk_s = self.mapping.chunk_s
        plans, count = join_streams(plans, chunk_s)
        if count:
            self._warn_once(
                f"'{topic}': {count} trajectories of one point are a stream of commands and were "
                f'joined into plans of {chunk_s:g} s'
            )
        return self._completed(topic, plans, states)

    def _completed(self, topic: str, plans: Stamped, states: JointStates | None) -> Stamped:
        """Return the plans with the measured positions of joints that they leave out."""
        chunk_s = self.mapping.chunk_s
        if self.robot is None or self.mapping.tools:
            return plans
        whole, measured = complete_plans(plans, states, self.robot, chunk_s)
        if measured:
            self._warn_once(
                f"'{topic}': trajectories leave out joints {', '.join(measured)}; their "
                'measured positions stand in for commands'
            )
        return whole

    def _object_poses(self, num_objects: int) -> ObjectPoses | None:
        def parse(message: Any) -> FloatArray:
            if len(message.poses) != num_objects:
                raise ValueError(f'{len(message.poses)} poses for {num_objects} objects')
            return messages.parse_pose_array(message)

        ordered = self._parsed(self.topics.object_poses, messages.POSE_ARRAY, parse)
        if not ordered:
            return None
        stamps = np.array([stamp for stamp, _ in ordered], np.int64)
        return ObjectPoses(stamps, np.stack([poses for _, poses in ordered]))

    def _cameras(
        self,
        calibration: Path | str | None,
        images: Mapping[str, Track],
        unknown_mount: str,
    ) -> dict[str, CameraModel]:
        if calibration:
            topics = {view: names.image for view, names in self.topics.views.items()}
            foreign = read_foreign(Path(calibration), topics)
            if foreign is not None:
                return self._foreign_cameras(foreign, images, unknown_mount)
        folder = self.path if self.path.is_dir() else self.path.parent
        file = Path(calibration) if calibration else folder / CALIBRATION_FILE
        tree = None
        if not file.is_file():
            tree = self._tree()
            if calibration or not (tree.frames or unknown_mount):
                raise CalibrationError(
                    f"'{file}' is not there: an episode needs the cameras' poses; put a "
                    f'{CALIBRATION_FILE} into its folder or name one in `calibration` (the bag '
                    f'has no /tf_static either); {_estimate(self.path, next(iter(images)))}'
                )
        self.is_calibrated = bool(calibration)
        known = load_calibration(file) if tree is None else {}
        cameras = {}
        for view in self.topics.views:
            if tree is not None:
                known[view] = self._from_tree(tree, view, unknown_mount, images[view])
            elif view not in known and unknown_mount:
                known[view] = self._placeholder(view, unknown_mount, images[view])
            elif view not in known:
                raise CalibrationError(
                    f"'{file}' has no view '{view}'; it has {', '.join(known) or 'none'}; "
                    f'{_estimate(self.path, view)}'
                )
            elif not calibration:
                known[view] = self._moving(known[view], images[view])
            is_given = tree is None and view not in self.unknown
            height, width = images[view].frames[0].shape[:2]
            cameras[view] = self._at_images(known[view], (width, height), is_given=is_given)
        return cameras

    def _moving(self, camera: CameraModel, track: Track) -> CameraModel:
        """Return camera of an episode, with the poses that /tf has of its frame in its mount."""
        frame = optical_frame(camera.view)
        moving, static = self._tf()
        if not read_tree(moving, static=static).moves_in(camera.mount_link, frame):
            return camera
        stamps = track.stamps_ns
        found = pose_track(moving, frame, {camera.mount_link}, stamps, static=static)
        self.tracks[camera.view] = found.T_link_frame
        return replace(camera, T_mount_camera=found.T_link_frame[0])

    def _foreign_cameras(
        self, foreign: ForeignCalibration, images: Mapping[str, Track], unknown_mount: str
    ) -> dict[str, CameraModel]:
        """Return cameras by calibrations of other programs; TF and CameraInfo have the rest."""
        self.warnings += foreign.notes
        frames = {view: self._frame_of(view) for view in self.topics.views}
        chain = [
            messages.make_tf(1, frames[one.before], frames[one.view], one.T_before_view)
            for one in foreign.chain
        ]
        self.given_tf = [*map(_as_tf, foreign.poses), *chain]
        tree = self._tree()
        self._name_unused_poses(tree, foreign, frames)
        cameras = {}
        for view in self.topics.views:
            lens = foreign.lenses.get(view)
            camera = self._from_tree(tree, view, unknown_mount, images[view], lens)
            height, width = images[view].frames[0].shape[:2]
            is_given = lens is not None
            cameras[view] = self._at_images(camera, (width, height), is_given=is_given)
        own = self.given_tf
        self.given_tf = [*(_as_tf(one.turned_round) for one in foreign.poses), *chain]
        other = read_tree(*self._tree_of_tf())
        self.given_tf = own
        for view in set(cameras) - set(self.unknown) - set(self.tracks):
            mount = self._mount_in(other, frames[view])
            camera = cameras[view]
            if mount is None or np.allclose(mount.T_link_frame, camera.T_mount_camera):
                continue
            self.other_directions[view] = OtherDirection(
                camera=replace(camera, mount_link=mount.link, T_mount_camera=mount.T_link_frame),
                source=', '.join(f"'{one.parent}' -> '{one.child}'" for one in foreign.poses),
            )
        return cameras

    def _tree_of_tf(self) -> tuple[list[Any], str, list[Any]]:
        moving, static = self._tf()
        return moving, self.mapping.tf_prefix, static

    def _mount_in(self, tree: TransformTree, frame: str) -> Mount | None:
        """Return the link that carries a frame in a tree; None = it has none, or it moves."""
        links = () if self.robot is None else self.robot.posed_links
        try:
            if tree.unknown_because(frame, links) is not None or tree.is_moving(frame, links):
                return None
            return tree.mount(frame, links)
        except CalibrationError:
            return None

    def _frame_of(self, view: str) -> str:
        """Return the optical frame of a view: the mapping's, the CameraInfo's or the images'."""
        row, infos = self.mapping.views.get(view), self._camera_infos(view)
        given = (row.frame if row else '') or (infos[0][0].header.frame_id if infos else '')
        return given or self.received[self.topics.views[view].image][0][1][1].header.frame_id

    def _name_unused_poses(
        self, tree: TransformTree, foreign: ForeignCalibration, frames: Mapping[str, str]
    ) -> None:
        """Name poses of frames that are of no view and carry none."""
        for one in foreign.poses:
            if not any(tree.hangs_from(frame, one.child) for frame in frames.values()):
                listed = ', '.join(f'{view} {frame}' for view, frame in frames.items())
                self._warn_once(
                    f"'{one.file}': frame '{one.child}' carries no view; views have the frames "
                    f"{listed}: name it as 'frame' of the view in the mapping (--topics)"
                )

    def _tf(self) -> tuple[list[Any], list[Any]]:
        """Return the messages of /tf and of /tf_static, then those of given calibrations."""
        moving, static = (
            [message for _, message in self._take(topic, messages.TF_MESSAGE)]
            for topic in TF_TOPICS
        )
        return moving, [*static, *self.given_tf]

    def _tree(self) -> TransformTree:
        moving, static = self._tf()
        tree = read_tree(moving, self.mapping.tf_prefix, static)
        self.warnings += tree.problems
        return tree

    def _from_tree(
        self,
        tree: TransformTree,
        view: str,
        unknown_mount: str,
        images: Track,
        lens: Lens | None = None,
    ) -> CameraModel:
        """Return the camera's pose by TF; without lens its intrinsics come from CameraInfo."""
        infos = self._camera_infos(view)
        if not infos and lens is None and unknown_mount:
            return self._placeholder(view, unknown_mount, images)
        if not infos and lens is None:
            raise CalibrationError(
                f"'{self.path}', view '{view}': '{self._camera_info(view)}' has no CameraInfo "
                'that is calibrated (K[0] is not 0), which intrinsics come from where there is no '
                'calibration file; '
                f'{_estimate(self.path, view)}'
            )
        of_images = self.received[self.topics.views[view].image][0][1][1].header.frame_id
        of_info = infos[0][0].header.frame_id if infos else ''
        if of_images and of_info and of_images != of_info:
            self._warn_once(
                f"view '{view}': its images are of frame '{of_images}', its CameraInfo of "
                f"'{of_info}', which is used"
            )
        row = self.mapping.views.get(view)
        frame = (row.frame if row else '') or of_info or of_images
        links = () if self.robot is None else self.robot.posed_links
        if unknown_mount and (why := tree.unknown_because(frame, links)) is not None:
            mount = Mount(unknown_mount, np.eye(4), None)
            self.unknown[view] = 'pose'
            self.unknown_because |= {view: why} if why else {}
        elif tree.is_moving(frame, links):
            moving, static = self._tf()
            prefix = self.mapping.tf_prefix
            found = pose_track(moving, frame, links, images.stamps_ns, prefix, static)
            mount = Mount(found.link, found.T_link_frame[0], None)
            self.tracks[view] = found.T_link_frame
            self._warn_once(
                f"view '{view}': its camera moves against every link of the robot; its poses in "
                f"'{found.link}' are those of /tf at each image"
            )
        else:
            mount = tree.mount(frame, links)
        if lens is not None:
            return lens.camera(view, mount.link, mount.T_link_frame)
        return CameraModel(
            view=view,
            width=1,
            height=1,
            K=np.eye(3),
            mount_link=mount.link,
            T_mount_camera=mount.T_link_frame,
        )

    def _placeholder(self, view: str, mount: str, images: Track) -> CameraModel:
        """Return a placeholder for a camera of unknown pose, and store what is unknown."""
        self.unknown[view] = 'pose' if self._camera_infos(view) else 'pose and intrinsics'
        height, width = images.frames[0].shape[:2]
        return unknown_camera(view, width, height, mount)

    def _camera_info(self, view: str) -> str:
        """Return the topic of a view's CameraInfo."""
        row = self.mapping.views.get(view)
        given = row.camera_info if row else ''
        return self.mapping.topic(given) if given else self.topics.views[view].camera_info

    def _camera_infos(self, view: str) -> list[tuple[Any, Intrinsics]]:
        """Return the CameraInfos of a view that are calibrated, with their intrinsics.

        Raises:
            CalibrationError: a number in one is NaN or infinite.
        """
        if view not in self.infos:
            rectified = is_rectified(self.topics.views[view].image)
            taken = self._take(self._camera_info(view), messages.CAMERA_INFO)
            read = [(m, read_camera_info(view, m, is_rectified=rectified)) for _, m in taken]
            self.infos[view] = [(m, found) for m, found in read if found is not None]
            if read and not self.infos[view]:
                self._warn_once(
                    f"view '{view}': '{self._camera_info(view)}' is not calibrated "
                    f'({"P" if rectified else "K"}[0] = 0), which is the same as no CameraInfo'
                )
        return self.infos[view]

    def _at_images(
        self, camera: CameraModel, size: tuple[int, int], *, is_given: bool
    ) -> CameraModel:
        """Return camera for images of a size, by CameraInfo where a file has not given others."""
        view, first, informed = camera.view, None, camera
        try:
            infos = self._camera_infos(view)
            first = infos[0][1].sized(*size) if infos else None
            informed = first.camera(camera) if first else camera
        except CalibrationError as error:
            if not is_given:
                raise
            self._warn_once(f"{error}: the calibration file's intrinsics are used")
            first, infos = None, []
        self._check_changes(view, infos, size)
        if first is None:
            return self._windowed(camera, size)
        seen = self._windowed(informed, size, first.window)
        if not is_given:
            return seen
        is_full = (camera.width, camera.height) == (first.width, first.height)
        given = self._windowed(camera, size, first.window if is_full else WHOLE)
        apart = np.abs(given.K - seen.K)[:2] / seen.K[0, 0]
        bends = given.distortion.any() and not _same_distortion(given, seen)
        if apart.max() < _SAME_K and bends:
            self._warn_once(
                f"view '{view}': the calibration file has distortion {_listed_numbers(given)}, "
                f"CameraInfo {_listed_numbers(seen)}; the file's is used"
            )
            return given
        if apart.max() < _SAME_K:
            return seen
        self._warn_once(
            f"view '{view}': the calibration file has fx, fy, cx, cy = {_four(given.K)} px, "
            f"CameraInfo {_four(seen.K)} px; the file's are used"
        )
        return given

    def _check_changes(
        self, view: str, infos: Sequence[tuple[Any, Intrinsics]], size: tuple[int, int]
    ) -> None:
        """Refuse intrinsics that change, and say where the size of the images stands in."""
        for index, (_, found) in enumerate(infos):
            first = infos[0][1]
            if found != first:
                raise CalibrationError(
                    f"'{self.path}': '{self._camera_info(view)}' changes at message {index}, "
                    f'{first.difference(found)}; cut the episode there'
                )
            if not (first.width and first.height):
                self._warn_once(
                    f"view '{view}': its CameraInfo has no size ({first.width}x{first.height}): "
                    f'taken as that of the images, {size[0]}x{size[1]}'
                )

    def _windowed(
        self, camera: CameraModel, size: tuple[int, int], window: ImageWindow = WHOLE
    ) -> CameraModel:
        sized, note = windowed_camera(camera, *size, window)
        if note:
            self._warn_once(note)
        return sized

    def _refuse(self, topic: str, error: Exception) -> None:
        self.refused.setdefault(topic, []).append(str(error))

    def _warn_once(self, text: str) -> None:
        if text not in self.warnings:
            self.warnings.append(text)

    def _all_warnings(self) -> tuple[str, ...]:
        cut = [self.bag.truncated] if self.bag.truncated else []
        refused = [
            f"'{topic}': {len(reasons)} messages were left out, the first: {reasons[0]}"
            for topic, reasons in self.refused.items()
        ]
        return (*cut, *self.bag.problems, *self.warnings, *refused)


def _kind_of(msgtype: str) -> str:
    return msgtype.rpartition('/')[2]


def _span(item: tuple[str, Any]) -> int | None:
    """Return the length of a plan [ns]; None = the message is none."""
    kind, message = item
    if kind != messages.JOINT_TRAJECTORY:
        return None
    after = message.points[-1].time_from_start if len(message.points) else None
    return 0 if after is None else after.sec * NANO + after.nanosec


def _as_tf(given: FramePose) -> Any:
    """Return a given pose as TFMessage."""
    return messages.make_tf(1, given.parent, given.child, given.T_parent_child)


def _framed_pose(message: Any) -> tuple[str, FloatArray]:
    """Return the frame and (4, 4) pose of a PoseStamped."""
    return message.header.frame_id, messages.parse_pose(message.pose)


def _info(bag: BagReader, instructions: Sequence[tuple[int, str]]) -> EpisodeInfo:
    values = {**bag.custom_data, **bag.metadata.get(METADATA_NAME, {})}
    return parse_info(bag.path, values, default_instruction=next((t for _, t in instructions), ''))


def _estimate(path: Path, view: str) -> str:
    """Return the advice for a camera of unknown pose: the command that estimates it."""
    return f'estimate it from the recording: mtv-world fit camera {path} --view {view} --no-guess'


def _same_distortion(one: CameraModel, other: CameraModel) -> bool:
    """Return whether two cameras bend rays alike; coefficients that are not there are zero."""
    size = max(len(one.distortion), len(other.distortion))
    padded = [np.pad(c.distortion, (0, size - len(c.distortion))) for c in (one, other)]
    models = {'plumb_bob' if c.distortion_model == 'none' else c.distortion_model
              for c in (one, other)}  # fmt: skip
    return len(models) == 1 and bool(np.allclose(*padded, atol=1e-6))


def _listed_numbers(camera: CameraModel) -> str:
    return f'{camera.distortion_model} {[round(float(v), 5) for v in camera.distortion]}'


def _four(K: FloatArray) -> str:
    return ', '.join(f'{v:.1f}' for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewTopics:
    """Topics of one view: images (raw or compressed), CameraInfo, masks."""

    image: str
    camera_info: str
    mask: str


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeTopics:
    """Topics of an episode."""

    views: Mapping[str, ViewTopics]
    joint_states: str
    joint_trajectory: str
    instruction: str
    object_poses: str

    def names(self, *, with_masks: bool) -> set[str]:
        """Return the names of all topics, of mask topics only on request."""
        names = {self.joint_states, self.joint_trajectory, self.instruction, self.object_poses}
        for view in self.views.values():
            names |= {view.image, view.camera_info, *([view.mask] if with_masks else [])}
        return names


def asked_topics(mapping: BagMapping | None, views: Sequence[str] | None) -> dict[str, str]:
    """Return the topics that a mapping names, by view and stream; None = of all views."""
    streams = mapping.streams() if mapping else {}
    return {k: t for k, t in streams.items() if views is None or k in (*STREAMS, *views)}


def find_topics(
    path: Path,
    found: Mapping[str, str],
    views: Sequence[str] | None,
    named: Mapping[str, str],
) -> EpisodeTopics:
    """Return the topics of an episode.

    A view's images are at `/<view>/image_raw` or `/<view>/image_raw/compressed` (raw is taken
    if both exist) unless `named` says otherwise; CameraInfo and masks have the same namespace.

    Args:
        path: the bag, for error texts.
        found: message type of each topic in the bag.
        views: views wanted; None = those of `named`, else all that are there.
        named: topic by view name or by `joint_states`, `joint_trajectory`, `instruction`.

    Raises:
        EpisodeError: a view is not there, or `named` has a key that is neither.
    """
    images = [topic for topic, kind in found.items() if kind in IMAGE_TYPES]
    if views is None:
        views = [key for key in named if key not in STREAMS] or _plain_views(images)
    unknown = [key for key in named if key not in STREAMS and key not in views]
    if unknown:
        raise EpisodeError.unknown(
            'topics:',
            unknown[0],
            [*views, *STREAMS],
            is_not=' is neither a view nor a stream; known are',
        )
    if not views:
        raise EpisodeError(
            f"'{path}' has no topic /<view>/image_raw or /<view>/image_raw/compressed; its image "
            f'topics are {_listed(images)}: name the views in `topics`'
        )
    return EpisodeTopics(
        views={view: _view_topics(path, view, images, named) for view in views},
        **{key: named.get(key, topic) for key, topic in STREAMS.items()},
    )


def _plain_views(images: Sequence[str]) -> list[str]:
    matches = [_PLAIN_VIEW.fullmatch(topic) for topic in images]
    return list(dict.fromkeys(match[1] for match in matches if match))


def _view_topics(
    path: Path, view: str, images: Sequence[str], named: Mapping[str, str]
) -> ViewTopics:
    wanted = named.get(view, image_topic(view))
    forms = (wanted, f'{wanted}/compressed', f'{wanted}/ffmpeg')
    image = next((topic for topic in forms if topic in images), None)
    if image is None:
        there = _plain_views(images)
        raise EpisodeError.unknown(
            f"'{path}' has no view",
            view,
            there,
            is_not=f": there are no images at '{wanted}' or '{wanted}/compressed'; its views are",
            advice=f', its image topics {_listed(images)} (map a view to a topic in `topics`)',
        )
    camera = image.removesuffix('/compressed').removesuffix('/ffmpeg').rpartition('/')[0]
    return ViewTopics(
        image=image, camera_info=f'{camera}/camera_info', mask=f'{camera}/mask/compressed'
    )


def _listed(names: Sequence[str]) -> str:
    return ', '.join(names) or 'none'


def in_order(
    topic: str, items: Iterable[tuple[int, Item]], warnings: list[str]
) -> list[tuple[int, Item]]:
    """Sort (stamp, item) by stamp, keep the last of equal stamps; report both in `warnings`."""
    given = list(items)
    stamps = [stamp for stamp, _ in given]
    late = sum(b < a for a, b in zip(stamps, stamps[1:], strict=False))
    kept = dict(sorted(given, key=lambda item: item[0]))
    if late:
        warnings.append(f"'{topic}': {late} messages were out of order and have been sorted")
    if len(kept) < len(given):
        repeated = len(given) - len(kept)
        warnings.append(f"'{topic}': {repeated} stamps came twice; the later message was kept")
    return list(kept.items())
