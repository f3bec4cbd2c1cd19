"""Messages of a recorded episode by topic, on one clock."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.core.errors import (
    EpisodeError,
    MtvWorldError,
)
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.command_messages import (
    command_topics,
    CommandReader,
    READ_AS,
)
from mtv_world_ros.data.bag.reader import BagMessage, BagReader
from mtv_world_ros.data.bag_mapping import BagMapping, STATE
from mtv_world_ros.data.episode import (
    TF,
    TF_STATIC,
)
from mtv_world_ros.data.episode_topics import asked_topics, find_topics, listed
from mtv_world_ros.data.stream_clocks import (
    arrival_times,
    ClockBreakError,
    CLOCKS,
    settle_clocks,
    StampedStream,
    WHOLE,
    Window,
)
from mtv_world_ros.robot.model import RobotModel

Stamped = list[tuple[int, Any]]
Item = TypeVar('Item')
TF_TOPICS = (TF, TF_STATIC)
NANO = 1_000_000_000


class RecordedStreams:
    """Messages of an episode's topics, by topic, with stamps on one clock.

    Args:
        path: rosbag2 folder or .mcap file.
        views: views to read; None = all.
        named: topics that differ from the default names; see `find_topics`.
        with_masks: whether the topics of masks are wanted.
        mapping: topics of a robot's own bag.
        robot: robot that the recording must be of; None = any.
        window: the part of the recording that is wanted, by receive times.

    Attributes:
        topics: topics of the views, joint states, commands and instruction.
        types: message type of each recorded topic.
        received: stamp [ns], type and message, by topic.
        arrived: receive time of each message [ns], by topic.
        refused: why messages were left out, by topic.
        warnings: problems that do not end the reading.

    Raises:
        EpisodeError: no bag, or a view is not there.
    """

    def __init__(
        self,
        path: Path,
        *,
        views: Sequence[str] | None,
        named: Mapping[str, str],
        with_masks: bool,
        mapping: BagMapping | None,
        robot: RobotModel | None,
        window: Window,
    ) -> None:
        self.path, self.window, self.with_masks = path, window, with_masks
        self.mapping = mapping or BagMapping()
        self.bag = BagReader(path)
        self.warnings: list[str] = []
        self.types = self.bag.topics()
        try:
            self.topics = find_topics(
                path, self.types, views, {**asked_topics(mapping, views), **named}
            )
        except EpisodeError as error:
            text = f'{error}; {self.bag.truncated}' if self.bag.truncated else str(error)
            recorded = self.bag.custom_data.get('robot', '')
            if robot is not None and recorded not in ('', robot.name):
                text = f"it is of another robot: '{recorded}', not '{robot.name}': {text}"
            raise EpisodeError(text) from error
        self.state_topics = (self.topics.joint_states, *self.mapping.state_topics[1:])
        self.command_topics = self._find_commands()
        self.received: dict[str, Stamped] = {}
        self.arrived: dict[str, NDArray[np.int64]] = {}
        self.refused: dict[str, list[str]] = {}

    def _find_commands(self) -> tuple[str, ...]:
        """Return the topics of the commands.

        Where a bag has no JointTrajectory, those of controllers and actions stand in.
        """
        topic = self.topics.joint_trajectory
        is_default = self.mapping.action == BagMapping.model_fields['action'].default
        has_plans = bool(self.topics_of(messages.JOINT_TRAJECTORY))
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
                f'(--topics) must name as many, in their order, and has: {listed(names)}'
            )
        return list(names)

    def receive(self) -> None:
        """Read the messages of all topics, and bring their stamps onto one clock."""
        wanted = self.topics.names(with_masks=self.with_masks) | set(TF_TOPICS)
        wanted |= set(self.command_topics)
        wanted |= {self.camera_info(view) for view in self.topics.views}
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
                self.refuse(message.topic, error)
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
        if self.window == WHOLE:
            return
        infos = {self.camera_info(view) for view in self.topics.views}
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

    def take(self, topic: str, msgtype: str) -> Stamped:
        """Return the messages of a topic, in recorded order; those of another type are refused."""
        taken: Stamped = []
        for stamp, (kind, message) in self.received.get(topic, []):
            if kind == msgtype:
                taken.append((stamp, message))
            else:
                self.refuse(topic, EpisodeError(f'it holds {kind}, expected {msgtype}'))
        return taken

    def parsed(
        self, topic: str, msgtype: str, parse: Callable[[Any], Item]
    ) -> list[tuple[int, Item]]:
        """Return the parsed messages of a topic and their stamps [ns]; refuse invalid ones."""
        good = []
        for stamp, message in self.take(topic, msgtype):
            try:
                good.append((stamp, parse(message)))
            except (ValueError, MtvWorldError) as error:
                self.refuse(topic, error)
        return in_order(topic, good, self.warnings)

    def topics_of(self, kind: str) -> list[str]:
        """Return the recorded topics of a message type."""
        return [name for name, found in self.types.items() if found == kind]

    def renamed(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the names that the mapping gives to recorded joints."""
        return tuple(map(self.mapping.joint_name, names))

    def camera_info(self, view: str) -> str:
        """Return the topic of a view's CameraInfo."""
        row = self.mapping.views.get(view)
        given = row.camera_info if row else ''
        return self.mapping.topic(given) if given else self.topics.views[view].camera_info

    def refuse(self, topic: str, error: Exception) -> None:
        """Note why a message of a topic is left out."""
        self.refused.setdefault(topic, []).append(str(error))

    def warn_once(self, text: str) -> None:
        """Add a warning that is not there yet."""
        if text not in self.warnings:
            self.warnings.append(text)

    def all_warnings(self) -> tuple[str, ...]:
        """Return what was cut off, problems of the bag, warnings, and what was refused."""
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
