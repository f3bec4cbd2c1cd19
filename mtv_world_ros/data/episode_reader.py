"""Reads a recorded episode: images, joint states, commands, masks, calibration, outcome."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import os
from pathlib import Path
from typing import Any
import warnings

import numpy as np

from mtv_world_ros.core.data_types import ByteArray, FloatArray
from mtv_world_ros.core.errors import (
    EpisodeError,
    MtvWorldError,
    TrajectoryError,
)
from mtv_world_ros.core.files import check_name
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.image_decoding import check_decodable, check_image, to_ids, to_rgb
from mtv_world_ros.data.bag.image_orientation import stored_note
from mtv_world_ros.data.bag.reader import BagReader, is_storage
from mtv_world_ros.data.bag.unused_topics import unused_topics
from mtv_world_ros.data.bag.video_packets import (
    check_packet,
    FFMPEG_PACKET,
    from_first_key,
    VideoFrames,
)
from mtv_world_ros.data.bag_mapping import BagMapping, STATE
from mtv_world_ros.data.episode import (
    Episode,
    EpisodeInfo,
    JointStates,
    LazyFrames,
    METADATA_NAME,
    ObjectPoses,
    parse_info,
    Track,
)
from mtv_world_ros.data.episode_topics import listed, ViewTopics
from mtv_world_ros.data.gripper_sources import resting_grippers
from mtv_world_ros.data.measured_joints import merge_joint_states
from mtv_world_ros.data.missing_joints import missing_joints_text
from mtv_world_ros.data.recorded_commands import RecordedCommands
from mtv_world_ros.data.recorded_streams import in_order, NANO, RecordedStreams, Stamped, TF_TOPICS
from mtv_world_ros.data.stream_clocks import (
    WHOLE,
    Window,
)
from mtv_world_ros.data.view_cameras import ViewCameras
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.resample import match_joints, nearest_rows

#: joints that a warning names at most
_MOST_NAMES = 8
#: largest distance of a mask from the image that it belongs to [median period of the images]
_MAX_MASK_OFFSET = 0.6
#: largest share of a view's images without a mask of their time at which its masks are used
_MAX_UNMASKED = 0.1
#: frames further away from all joint states share no moment with them [s]
MAX_FRAME_AWAY_S = 0.5


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
    window: Window = WHOLE,
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
    streams = RecordedStreams(
        Path(path),
        views=views,
        named=topics or {},
        with_masks=with_masks,
        mapping=mapping,
        robot=robot,
        window=window,
    )
    reader = _EpisodeReader(streams, robot, decode_all)
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
        self, streams: RecordedStreams, robot: RobotModel | None, decode_all: bool
    ) -> None:
        self.streams, self.robot, self.decode_all = streams, robot, decode_all
        self.path, self.topics, self.mapping = streams.path, streams.topics, streams.mapping
        self.cameras = ViewCameras(streams, robot)

    def read(
        self, calibration: Path | str | None, with_cameras: bool, unknown_mount: str
    ) -> Episode:
        streams, topics, cameras = self.streams, self.topics, self.cameras
        streams.receive()
        images = {view: self._images(view, names) for view, names in topics.views.items()}
        seen_ns = max((int(track.stamps_ns[0]) for track in images.values()), default=0)
        masks = {
            view: self._timely_masks(view, images[view], self._masks(names))
            for view, names in topics.views.items()
        }
        said = [(s, m.data) for s, m in streams.take(topics.instruction, messages.STRING)]
        states = self._states()
        self._check_shared(images, states)
        models = cameras.read(calibration, images, unknown_mount) if with_cameras else {}
        episode_info = _info(streams.bag, said)
        trajectories = RecordedCommands(streams, self.robot, seen_ns).trajectories(states)
        self._warn_of_resting_grippers(states, trajectories)
        return Episode(
            info=episode_info,
            views=tuple(topics.views),
            cameras=models,
            images=images,
            joint_states=states,
            trajectories=trajectories,
            masks={view: track for view, track in masks.items() if track} or None,
            instructions=said,
            object_poses=self._object_poses(len(episode_info.objects)),
            unknown=cameras.unknown,
            unknown_because=cameras.unknown_because,
            camera_tracks=cameras.tracks,
            truncated=bool(streams.bag.truncated),
            warnings=streams.all_warnings(),
            unused=self._unused(),
            other_directions=cameras.other_directions,
        )

    def _unused(self) -> dict[str, str]:
        """Return why recorded topics are not part of the episode, by topic."""
        topics, mapping = self.topics, self.mapping
        used = topics.names(with_masks=True) | {
            self.streams.camera_info(view) for view in topics.views
        }
        used |= {mapping.topic(tool.topic) for tool in mapping.tools.values()}
        used |= {*self.streams.state_topics, *self.streams.command_topics}
        if mapping.action == STATE:
            used -= {topics.joint_trajectory, *self.streams.command_topics}
        if mapping.instruction:
            used.discard(topics.instruction)
        if not self.cameras.is_calibrated:
            used |= set(TF_TOPICS)
        images = [view.image for view in topics.views.values()]
        unused = unused_topics(self.streams.types, used, images, mapping)
        if self.robot is not None:
            for topic in self.streams.state_topics:
                if names := self._joints_of_others(topic, self.robot):
                    unused[f'{", ".join(names)} of {topic}'] = 'no joint of the robot'
        return unused

    def _joints_of_others(self, topic: str, robot: RobotModel) -> dict[str, None]:
        """Return the joints that are recorded beside those of the robot, in order."""
        items = self.streams.received.get(topic, [])
        kinds = {tuple(m.name) for _, (kind, m) in items if kind == messages.JOINT_STATE}
        wanted = set(robot.joint_names)
        own = [
            names for names in sorted(kinds) if not wanted.isdisjoint(self.streams.renamed(names))
        ]
        names = [name for names in own for name in names]
        return dict.fromkeys(n for n in names if self.mapping.joint_name(n) not in wanted)

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
            reasons = self.streams.refused.get(names.image) or ['it holds no messages']
            raise EpisodeError(f"'{self.path}', view '{view}': '{names.image}': {reasons[0]}")
        return track

    def _masks(self, names: ViewTopics) -> Track | None:
        return self._track(names.mask, to_ids) if self.streams.with_masks else None

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
        self.streams.warn_once(
            f"view '{view}': {share:.0%} of its {len(stamps)} images have no mask of their time "
            f'({len(own)} masks, up to {apart.max() / NANO:.2f} s apart): its masks are not used; '
            'import the recording again with masks of every image'
        )
        return None

    def _track(self, topic: str, decode: Callable[[Any], ByteArray]) -> Track | None:
        check = check_packet if self.streams.types.get(topic) == FFMPEG_PACKET else check_image
        good: Stamped = []
        for stamp, (_, message) in self.streams.received.get(topic, []):
            try:
                check(message)
                good.append((stamp, message))
            except MtvWorldError as error:
                self.streams.refuse(topic, error)
        if self.streams.types.get(topic) == FFMPEG_PACKET:
            return self._video(topic, good)
        if decode is to_rgb:
            good = self._whole(topic, good)
        if not good:
            return None
        ordered = in_order(topic, good, self.streams.warnings)
        if hasattr(good[0][1], 'format') and (note := stored_note(bytes(good[0][1].data))):
            self.streams.warn_once(f"'{topic}': {note}")
        stamps = np.array([stamp for stamp, _ in ordered], np.int64)
        return Track(stamps, LazyFrames(topic, [message for _, message in ordered], decode))

    def _whole(self, topic: str, images: Stamped) -> Stamped:
        """Return the images that are not damaged; without `decode_all` from the first such on."""
        if METADATA_NAME in self.streams.bag.metadata:  # written by this package
            return images
        whole: Stamped = []
        for number, (stamp, message) in enumerate(images):
            if whole and not self.decode_all:
                return [*whole, *images[number:]]
            try:
                check_decodable(message)
                whole.append((stamp, message))
            except MtvWorldError as error:
                self.streams.refuse(topic, error)
        return whole

    def _video(self, topic: str, packets: Stamped) -> Track | None:
        whole = from_first_key(in_order(topic, packets, self.streams.warnings))
        if len(whole) < len(packets):
            self.streams.warn_once(
                f"'{topic}': {len(packets) - len(whole)} packets before the first key frame were "
                'left out'
            )
        if not whole:
            return None
        stamps = np.array([stamp for stamp, _ in whole], np.int64)
        return Track(stamps, VideoFrames(topic, [message for _, message in whole]))

    def _states(self) -> JointStates | None:
        topics = self.streams.state_topics
        taken = [
            item
            for topic in topics
            for item in self._own_states(topic, self.streams.take(topic, messages.JOINT_STATE))
        ]
        states = merge_joint_states(
            ', '.join(topics),
            taken,
            self.streams.warnings,
            self.robot,
            self.streams.renamed,
            self.mapping.constants,
        )
        if states is None:
            others = self.streams.topics_of(messages.JOINT_STATE)
            if others and set(topics).isdisjoint(others):
                self.streams.warn_once(
                    f"no joint states at '{', '.join(topics)}'; there are some at "
                    f'{listed(others)}: name the topic in `joint_states`'
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
            listed = ', '.join([*self.streams.state_topics, *topics])
            self.streams.warn_once(
                f"{text}; {', '.join(topics)} has it, too: 'joint_states: [{listed}]' in the "
                'mapping (--topics)'
                if topics
                else f'{text}: is it measured on a topic that was not recorded?'
            )

    def _other_joints(self) -> dict[str, tuple[str, ...]]:
        """Return the names of the joints in topics of joint states that are not read, by topic."""
        others = [
            t
            for t in self.streams.topics_of(messages.JOINT_STATE)
            if t not in self.streams.state_topics
        ]
        others = [topic for topic in others if topic not in self.streams.command_topics]
        found: dict[str, dict[str, None]] = {topic: {} for topic in others}
        for message in self.streams.bag.messages(others) if others else ():
            state = messages.deserialize(message.msgtype, message.data)
            found[message.topic].update(dict.fromkeys(self.streams.renamed(state.name)))
        return {topic: tuple(names) for topic, names in found.items()}

    def _own_states(self, topic: str, taken: Stamped) -> Stamped:
        """Return the messages that name a joint of the robot.

        All, where none does or it is not known.
        """
        joints = set(() if self.robot is None else self.robot.joint_names)
        own: Stamped = []
        others: dict[str, None] = {}
        for item in taken:
            names = self.streams.renamed(item[1].name)
            if joints.isdisjoint(names):
                others.update(dict.fromkeys(names))
            else:
                own.append(item)
        if not own or len(own) == len(taken):
            return taken
        named = [*list(others)[:_MOST_NAMES], *(['...'] if len(others) > _MOST_NAMES else [])]
        self.streams.warn_once(
            f"'{topic}': {len(taken) - len(own)} messages without a joint of the robot were left "
            f'out; they name {listed(named)}'
        )
        return own

    def _object_poses(self, num_objects: int) -> ObjectPoses | None:
        def parse(message: Any) -> FloatArray:
            if len(message.poses) != num_objects:
                raise ValueError(f'{len(message.poses)} poses for {num_objects} objects')
            return messages.parse_pose_array(message)

        ordered = self.streams.parsed(self.topics.object_poses, messages.POSE_ARRAY, parse)
        if not ordered:
            return None
        stamps = np.array([stamp for stamp, _ in ordered], np.int64)
        return ObjectPoses(stamps, np.stack([poses for _, poses in ordered]))


def _info(bag: BagReader, instructions: Sequence[tuple[int, str]]) -> EpisodeInfo:
    values = {**bag.custom_data, **bag.metadata.get(METADATA_NAME, {})}
    return parse_info(bag.path, values, default_instruction=next((t for _, t in instructions), ''))
