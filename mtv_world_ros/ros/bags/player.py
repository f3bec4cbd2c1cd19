"""Plays an episode into ROS topics at its own timing."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import heapq
from pathlib import Path
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.utilities import remove_ros_args
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

from mtv_world_ros.core.clock_offset import Offset, read_offset
from mtv_world_ros.core.errors import (
    CalibrationError,
    ConfigError,
    EpisodeError,
    TrajectoryError,
)
from mtv_world_ros.data.bag.reader import BagMessage, BagReader
from mtv_world_ros.data.episode import CALIBRATION_FILE, EpisodeInfo, METADATA_NAME, parse_info
from mtv_world_ros.data.episode_cameras import views_without_info
from mtv_world_ros.ros.messages.bounded import subscribe_bounded
from mtv_world_ros.ros.messages.conversions import (
    has_header,
    message_class,
    NANO,
    read_stamp,
    to_stamp,
    values_of,
    with_stamp,
)
from mtv_world_ros.ros.peers import Peers
from mtv_world_ros.ros.qos_profiles import is_latched, LATCHED
from mtv_world_ros.ros.run_node import run

TRAJECTORY = 'trajectory_msgs/msg/JointTrajectory'
#: names of the objects of the episode that is played, comma-separated
OBJECTS = '/objects'
#: recorders write messages this much out of order at most
_WINDOW_NS = 2 * NANO
#: topics whose last message late subscribers get
_STATES = ('instruction', 'tf_static', 'robot_description')
_NOT_PLAYED = ('/clock', '/parameter_events')
_CLOCK_PERIOD_NS = 10_000_000
#: a change of the system clock against the monotonic one that is a step, not a drift [ns]
_CLOCK_STEP_NS = 50_000_000
#: connections that do not change for this long are complete [s]
_SETTLED_S = 0.5
#: nodes get this long to hear what is played, by their diagnostics [s]
_HEARD_S = 10.0
#: after this long it says what it waits for
_SILENT_S = 2.0
ENDS = ('done', 'preempted', 'rejected', 'failed', 'reset')
#: ends of a plan that are no fault; without lock-step a plan is pre-empted by the next one
_GOOD_ENDS = ('done', 'preempted')
UNANSWERED = 'unanswered'
#: maximum number of plans that are listed by their times for one reason
_MAX_LISTED = 8


@dataclass(slots=True)
class Timeline:
    """Maps bag time to the monotonic clock, and that to stamps of the system clock.

    A system clock that is set changes the stamps from then on, but not the pace.

    Attributes:
        bag_ns: bag time at which playing started [ns].
        steady_ns: monotonic time at that moment, moved on by every pause [ns].
        rate: seconds of the bag a second.
        offset: offset of the system clock.
    """

    bag_ns: int
    steady_ns: int
    rate: float
    offset: Offset

    @classmethod
    def now(cls, bag_ns: int, rate: float) -> Timeline:
        """Return the timeline that is at a bag time now."""
        steady_ns = time.monotonic_ns()
        return cls(bag_ns, steady_ns, rate, read_offset())

    def due(self, bag_ns: int) -> int:
        """Return the monotonic time at which a bag time is due [ns]."""
        return self.steady_ns + round((bag_ns - self.bag_ns) / self.rate)

    def bag_time(self, steady_ns: int) -> int:
        """Return the bag time of a monotonic time [ns]."""
        return self.bag_ns + round((steady_ns - self.steady_ns) * self.rate)

    def stamp(self, bag_ns: int) -> int:
        """Stamp of the system clock at which a bag time is due [ns]."""
        offset = read_offset()
        if offset.step_ns(self.offset, _CLOCK_STEP_NS):
            self.offset = offset
        return self.due(bag_ns) + self.offset.value_ns

    def pause(self, duration_ns: int) -> None:
        """Delay what is still to be played by a pause."""
        self.steady_ns += duration_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayedPlan:
    """A trajectory that was published, and how it ended.

    Attributes:
        topic: topic it was published on.
        bag_s: time since the start of playing [s].
        stamp_ns: stamp that it was published with [ns].
        state: end of the plan, one of `ENDS`; `UNANSWERED` = nothing was reported in time; empty =
            it is open.
        reason: reason of a rejection or failure, with its text.
    """

    topic: str
    bag_s: float
    stamp_ns: int
    state: str = ''
    reason: str = ''

    @property
    def is_open(self) -> bool:
        """True while no answer to the plan was reported."""
        return not self.state


def describe_failed(plans: Sequence[PlayedPlan]) -> str:
    """Describe the plans that were rejected, failed or not answered; empty = none."""
    failed = [plan for plan in plans if plan.state not in _GOOD_ENDS]
    if not failed:
        return ''
    groups: dict[tuple[str, str], list[float]] = {}
    for plan in failed:
        groups.setdefault((plan.state, plan.reason), []).append(plan.bag_s)
    lines = [f'{len(failed)} of {len(plans)} plans were not imagined']
    for (state, reason), times in groups.items():
        shown = ', '.join(f'{t:.2f}' for t in times[:_MAX_LISTED])
        rest = len(times) - _MAX_LISTED
        shown += f' and {rest} more' if rest > 0 else ''
        lines.append(f'  {len(times)} {state}, at {shown} s{": " if reason else ""}{reason}')
    return '\n'.join(lines)


def describe_left_out(counts: Mapping[str, int], read: Collection[str]) -> str:
    """Describe the trajectory topics that the node does not read, and how to rename them.

    Args:
        counts: number of plans by topic, of the topics that the node does not read.
        read: trajectory topics that it reads.
    """
    shown = ', '.join(f"'{topic}' ({count} plans)" for topic, count in sorted(counts.items()))
    topic, name = min(counts), min(read)
    return (
        f'no answer is expected on {shown}: the node reads {", ".join(sorted(read))}. It imagines '
        f'plans of another topic where that is played under this name: --topics without {name}, '
        f'and --ros-args -r {topic}:={name}'
    )


class Player(Node):
    """Publishes the messages of a recorded episode.

    Args:
        options: options of the command line, see `_parse`.

    Raises:
        EpisodeError: the episode cannot be read, or holds a type that is not installed.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__('player')
        self._options = options
        self._reader = BagReader(options.episode)
        types = self._reader.topics()
        self._outputs = {topic: self._offer(types[topic], topic) for topic in self._chosen(types)}
        clock = self._played_name('/clock')
        self._clock_output = self.create_publisher(Clock, clock, 10) if options.clock else None
        self._plans: list[PlayedPlan] = []
        self._ends: list[dict[str, str]] = []
        self._was_reported = False
        self._unpublished: set[tuple[str, str]] = set()
        subscribe_bounded(self, DiagnosticArray, options.report_topic, self._on_report, 100)
        self._objects = self._offer_objects(types)
        self._hint = self._describe_cameras(types)
        self._say_parameters(types)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self._peers = Peers(self)
        self._counts: Counter[str] = Counter()
        self._first_ns = 0
        self._timeline: Timeline | None = None

    def play(self) -> None:
        """Wait for subscribers and plays, once or in a loop.

        Raises:
            ConfigError: nobody subscribes.
            TrajectoryError: plans were rejected, failed or not answered.
        """
        self._publish_objects()
        if not self._options.no_wait:
            self._wait_for_subscribers()
        while True:
            self._play_once()
            cut = [f'played up to the cut: {self._reader.truncated}']
            for problem in (cut if self._reader.truncated else []) + self._reader.problems:
                self.get_logger().warning(problem)
            if not self._options.loop:
                break
        self._wait_for_ends()
        self._wait_for_frames()
        self._flush()
        self._say_left_out()
        counted = ', '.join(f'{number} {what}' for what, number in self._counts.items())
        self.get_logger().info(f'played {counted or "nothing"}')
        failed = describe_failed(self._plans)
        if failed:
            raise TrajectoryError('\n'.join(filter(None, (failed, self._hint))))

    def _chosen(self, types: dict[str, str]) -> list[str]:
        """Return the topics to play.

        Those whose type is not installed are left out, unless named.
        """
        options = self._options
        unknown = [topic for topic in options.topics if topic not in types]
        if unknown:
            raise EpisodeError(
                f"'{options.episode}' has no topics {unknown}; it has {sorted(types)}"
            )
        if options.topics:
            return options.topics
        found = []
        for topic in types:
            try:
                message_class(types[topic])
            except EpisodeError as error:
                self.get_logger().warning(f"'{topic}' is not played: {error}")
                continue
            found += [topic] if topic not in _NOT_PLAYED else []
        return found

    def _describe_cameras(self, types: dict[str, str]) -> str:
        """Return what the episode's cameras lack for the node; empty = nothing is known to.

        Says where the cameras' poses are, which the node takes from its calibration file.
        """
        episode = self._options.episode
        if TRAJECTORY not in {types[topic] for topic in self._outputs}:
            return ''
        try:
            bare = views_without_info(episode, types)
        except CalibrationError as error:
            self.get_logger().warning(str(error))
            return ''
        file = episode / CALIBRATION_FILE
        if file.is_file():
            self.get_logger().info(
                f"the cameras' poses of this episode are in '{file.resolve()}': world_model takes "
                "them with -p calibration_file:=FILE, else the checkpoint's, or TF's"
            )
        if not bare:
            return ''
        text = (
            f"views {', '.join(bare)} of '{episode}' have no CameraInfo, without which the node "
            f'rejects plans: mtv-world fit camera {episode} --view {",".join(bare)} --apply '
            'writes it'
        )
        self.get_logger().warning(text)
        return text

    def _say_parameters(self, types: dict[str, str]) -> None:
        """Log the parameters of the node that this episode needs: no topic carries them."""
        if TRAJECTORY not in {types[topic] for topic in self._outputs}:
            return
        info = self._info()
        if info is not None and info.place:
            self.get_logger().info(
                f"this episode was recorded in the robot cell '{info.place}': world_model is told "
                f"with -p 'place:={info.place}'; in a cell where contact was not fitted, verdicts "
                'are given more seldom'
            )

    def _info(self) -> EpisodeInfo | None:
        """Return task, objects and place of the episode; None = they cannot be read."""
        values = self._reader.metadata.get(METADATA_NAME, {})
        try:
            return parse_info(self._options.episode, values)
        except EpisodeError as error:  # which keeps no topic from being played
            self.get_logger().warning(str(error), once=True)
            return None

    def _offer_objects(self, types: dict[str, str]) -> Publisher | None:
        """Return the publisher of the objects' names, which the node judges with.

        None = no plans are played, or the bag has that topic. Episodes without names publish that
        there are none, so that those of another episode are not kept.
        """
        played = {types[topic] for topic in self._outputs}
        if TRAJECTORY not in played or OBJECTS in self._outputs:
            return None
        return self.create_publisher(String, self._played_name(OBJECTS), LATCHED)

    def _publish_objects(self) -> None:
        """Publish the names that are stored with the episode."""
        info = self._info()
        if self._objects is None or info is None:
            return
        if any(',' in name for name in info.objects):
            self.get_logger().warning(
                f'the names {list(info.objects)} have commas, and are not published on '
                f"'{self._objects.topic_name}', where commas separate names: give them to "
                'world_model as its parameter objects'
            )
            return
        self._objects.publish(String(data=', '.join(info.objects)))
        if info.objects:
            self.get_logger().info(
                f"the objects of this episode are on '{self._objects.topic_name}': "
                f'{", ".join(info.objects)}'
            )

    def _offer(self, msgtype: str, topic: str) -> Publisher:
        is_state = topic.rsplit('/', 1)[-1] in _STATES
        profile = LATCHED if is_state else QoSProfile(depth=100)
        return self.create_publisher(message_class(msgtype), self._played_name(topic), profile)

    def _played_name(self, topic: str) -> str:
        """A topic of the bag, in the player's namespace if it has one: two players, two robots."""
        return topic if self.get_namespace() == '/' else topic.lstrip('/')

    def _wait_for_subscribers(self) -> None:
        """Wait for subscribers, and until the number of connections has not changed for a while.

        Where nodes say in diagnostics that they hear nobody on a topic that is played, it waits
        for that, too; some never will, as their quality of service does not fit.
        """
        needed = self._options.wait_for or self._plan_topics()
        since_s = time.monotonic()
        end_s, say_s = since_s + self._options.wait_timeout, since_s + _SILENT_S
        heard_s = since_s + _HEARD_S
        known: list[int] = []
        while True:
            now_s, now, awaited = time.monotonic(), self._connections(), self._awaited(needed)
            if awaited:
                heard_s = now_s + _HEARD_S
            if awaited or now != known or (now_s < heard_s and self._is_unheard()):
                known, since_s = now, now_s
            if awaited and now_s > say_s:
                say_s = end_s + 1
                self.get_logger().info(
                    f'waiting up to {self._options.wait_timeout:g} s for {awaited}: is the node '
                    '(world_model) started? --no-wait plays anyway'
                )
            if awaited and now_s > end_s:
                raise ConfigError(
                    f'{self._options.wait_timeout:g} s went by without {awaited}; is the node '
                    'running in the same ROS_DOMAIN_ID? (--no-wait plays anyway)'
                )
            if not awaited and (now_s > since_s + _SETTLED_S or now_s > end_s):
                return
            self._executor.spin_once(timeout_sec=0.05)

    def _awaited(self, topics: list[str]) -> str:
        """Return what has to be there before it plays, as text; empty = all is."""
        unsubscribed = self._unsubscribed(topics)
        if unsubscribed:
            return f'a subscriber of {unsubscribed}'
        # while a node loads its model it subscribes to plans alone, and would keep the last one
        lifecycle = self._peers.state(self._reporter).get('lifecycle', 'active')
        return '' if lifecycle == 'active' else f"an active '{self._reporter}' (it is {lifecycle})"

    def _unsubscribed(self, topics: list[str]) -> list[str]:
        """Return topics without a subscriber, by the ROS graph and by other nodes' diagnostics."""
        unsubscribed = [topic for topic in topics if not self.count_subscribers(topic)]
        if not self._options.wait_for and len(unsubscribed) < len(topics):
            topics = [topic for topic in topics if topic not in unsubscribed]
            unsubscribed = []  # of several trajectory topics a node may read one
        if self._options.lock_step and not unsubscribed:
            known = self._peers.state(self._reporter)
            unsubscribed = [] if known else [f'/diagnostics of {self._reporter}']
        return unsubscribed or self._peers.unconnected(topics)

    def _is_unheard(self) -> bool:
        """Return whether nodes do not hear what is played, or have not said whether they do."""
        if self._is_reported() and not self._peers.state(self._reporter):
            return True
        return bool(self._peers.unheard(o.topic_name for o in self._outputs.values()))

    def _connections(self) -> list[int]:
        outputs = self._outputs.values()
        return [
            *(publisher.get_subscription_count() for publisher in outputs),
            *(self.count_subscribers(publisher.topic_name) for publisher in outputs),
            self.count_publishers(self._reports),
        ]

    def _play_once(self) -> None:
        timeline = self._timeline = None
        self._plans, self._ends = [], []  # of this pass: a loop has no end
        for message in self._messages():
            if timeline is None:
                timeline = Timeline.now(self._first_ns, self._options.rate)
                self._timeline = timeline
            self._wait_until_due(timeline, message.stamp_ns)
            if self._options.lock_step and message.msgtype == TRAJECTORY:
                self._flush()  # the plan starts from what came before it
            stamp_ns = self._publish(timeline, message)
            self._was_reported = self._was_reported or self._is_reported()
            if message.msgtype != TRAJECTORY:
                continue
            bag_s = (message.stamp_ns - self._first_ns) / NANO
            topic = self._outputs[message.topic].topic_name
            self._plans.append(PlayedPlan(topic=topic, bag_s=bag_s, stamp_ns=stamp_ns))
            if self._options.lock_step:
                self._wait_for_answer(timeline, message.stamp_ns, stamp_ns)

    def _messages(self) -> Iterator[BagMessage]:
        """Yield the messages from start to end, and latched ones before the start."""
        first_ns: int | None = None
        for message in in_order(self._reader.messages(tuple(self._outputs))):
            if first_ns is None:
                first_ns = message.stamp_ns
                self._first_ns = first_ns + round(self._options.start * NANO)
            if (message.stamp_ns - self._first_ns) / NANO > self._options.duration:
                return
            profile = self._outputs[message.topic].qos_profile
            if message.stamp_ns >= self._first_ns or is_latched(profile):
                yield message

    def _wait_until_due(self, timeline: Timeline, bag_ns: int) -> None:
        due_ns = timeline.due(bag_ns)
        while (now_ns := time.monotonic_ns()) < due_ns:
            self._publish_clock(min(bag_ns, timeline.bag_time(now_ns)))
            pause_ns = min(due_ns - now_ns, _CLOCK_PERIOD_NS)
            self._executor.spin_once(timeout_sec=pause_ns / NANO)
        self._publish_clock(max(bag_ns, timeline.bag_ns))

    def _publish(self, timeline: Timeline, message: BagMessage) -> int:
        """Publish a message; return the stamp it then has, 0 = none [ns]."""
        data, stamp_ns = message.data, 0
        if has_header(message.msgtype):
            stamp_ns = read_stamp(data)
            if stamp_ns and self._clock_output is None:
                stamp_ns += timeline.stamp(message.stamp_ns) - message.stamp_ns
                data = with_stamp(data, stamp_ns)
        self._outputs[message.topic].publish(data)
        self._counts['messages'] += 1
        self._counts['trajectories'] += message.msgtype == TRAJECTORY
        return stamp_ns

    def _flush(self) -> None:
        """Wait until reliable subscribers have what was published (Fast DDS: up to 3 s)."""
        for publisher in self._outputs.values():
            if publisher.get_subscription_count():
                publisher.wait_for_all_acked(Duration(seconds=4))

    def _wait_for_frames(self) -> None:
        """Advance the clock, in lock-step, until the frames of the last answer are published."""
        end_s = time.monotonic() + self._options.answer_timeout
        timeline = self._timeline if self._options.lock_step else None
        while self._unpublished and timeline is not None and time.monotonic() < end_s:
            self._publish_clock(timeline.bag_time(time.monotonic_ns()))
            self._executor.spin_once(timeout_sec=_CLOCK_PERIOD_NS / NANO)

    def _publish_clock(self, bag_ns: int) -> None:
        if self._clock_output is not None:
            self._clock_output.publish(Clock(clock=to_stamp(bag_ns)))

    def _on_report(self, message: DiagnosticArray) -> None:
        self._was_reported = True
        for status in message.status:
            values = values_of(status)
            chunk = values.get('rollout', ''), values.get('chunk', '')
            if values.get('state') in ENDS:
                self._ends.append(values)
            elif values.get('state') == 'chunk':
                self._unpublished.add(chunk)
            elif values.get('state') == 'published':
                self._unpublished.discard(chunk)

    def _open_plans(self) -> list[PlayedPlan]:
        """Give plans the ends that were reported for them; return those that wait for one."""
        for index, plan in enumerate(self._plans):
            if not plan.is_open:
                continue
            stamp = str(plan.stamp_ns)
            end = next((e for e in self._ends if e.get('trajectory_stamp_ns') == stamp), None)
            if end is not None:
                self._ends.remove(end)
                reason = ': '.join(filter(None, (end.get('reason', ''), end.get('text', ''))))
                self._end(index, end['state'], reason)
        unread = self._unread_topics()
        return [plan for plan in self._plans if plan.is_open and plan.topic not in unread]

    def _plan_topics(self) -> list[str]:
        """Return the trajectory topics that are played, by their full names."""
        return [
            publisher.topic_name
            for publisher in self._outputs.values()
            if publisher.msg_type is message_class(TRAJECTORY)
        ]

    def _unread_topics(self) -> set[str]:
        """Return the trajectory topics that the node that reports does not read.

        Empty where it reads none itself: another node then reads plans for it, not known which.
        """
        topics = set(self._plan_topics())
        if len(topics) < 2:
            return set()
        reporters = _nodes(self.get_publishers_info_by_topic(self._reports))
        read = {
            topic
            for topic in topics
            if reporters & _nodes(self.get_subscriptions_info_by_topic(topic))
        }
        return topics - read if read else set()

    def _say_left_out(self) -> None:
        """Take out the plans that the node did not read, and log which."""
        unread = self._unread_topics()
        counts = Counter(plan.topic for plan in self._plans if plan.is_open)
        if not counts:
            return
        self._plans = [plan for plan in self._plans if not plan.is_open]
        self._counts['not read'] = counts.total()
        read = set(self._plan_topics()) - unread
        self.get_logger().warning(describe_left_out(counts, read))

    @property
    def _reports(self) -> str:
        """Full name of the topic of reports."""
        return self.resolve_topic_name(self._options.report_topic)

    @property
    def _reporter(self) -> str:
        """Full name of the node that reports."""
        return self._reports.rpartition('/')[0]

    def _end(self, index: int, state: str, reason: str) -> None:
        """Set how a plan ended."""
        self._plans[index] = replace(self._plans[index], state=state, reason=reason)
        self._counts[state] += 1

    def _is_reported(self) -> bool:
        """Return whether somebody publishes reports."""
        return self.count_publishers(self._options.report_topic) > 0

    def _give_up(self, reason: str = '') -> None:
        """End the plans that wait for an answer: they are unanswered."""
        reason = reason or f'no answer within {self._options.answer_timeout:g} s'
        unread = self._unread_topics()
        for index, plan in enumerate(self._plans):
            if plan.is_open and plan.topic not in unread:
                self._end(index, UNANSWERED, reason)

    def _wait_for_answer(self, timeline: Timeline, bag_ns: int, stamp_ns: int) -> None:
        """Pause the bag until the node reports the end of the last plan."""
        begin_ns = time.monotonic_ns()
        end_s = time.monotonic() + self._options.answer_timeout
        while self._open_plans() and time.monotonic() < end_s:
            self._publish_clock(bag_ns)
            self._executor.spin_once(timeout_sec=0.02)
        timeline.pause(time.monotonic_ns() - begin_ns)
        self._give_up()
        plan = self._plans[-1]
        if plan.is_open:  # on a topic that the node does not read
            return
        self.get_logger().info(f'trajectory is answered: {plan.state}')
        if plan.state != 'done':
            text = f'{plan.state} {plan.reason}'.strip()
            self.get_logger().warning(f'trajectory at {stamp_ns} ns: {text}')

    def _wait_for_ends(self) -> None:
        """Wait for the answers that are due, if a node reports any."""
        if not (self._options.lock_step or self._was_reported or self._is_reported()):
            self._plans = []  # nobody reports: whether they were answered is not known
            return
        end_s = time.monotonic() + self._options.answer_timeout
        while self._open_plans() and time.monotonic() < end_s:
            if not self._is_reported():
                self._give_up(f"no answer, and nobody publishes '{self._reports}' any more")
                break
            if self._timeline is not None:
                self._publish_clock(self._timeline.bag_time(time.monotonic_ns()))
            self._executor.spin_once(timeout_sec=_CLOCK_PERIOD_NS / NANO)
        self._give_up()


def _nodes(endpoints: Iterable[TopicEndpointInfo]) -> set[tuple[str, str]]:
    """Return namespace and name of the nodes of publishers or subscriptions."""
    return {(endpoint.node_namespace, endpoint.node_name) for endpoint in endpoints}


def in_order(messages: Iterable[BagMessage]) -> Iterator[BagMessage]:
    """Yield messages by time from a buffer of two seconds; trajectories last among equal times.

    A trajectory is planned from the messages of the same time, so they go first.
    """
    heap: list[tuple[int, bool, int, BagMessage]] = []
    for number, message in enumerate(messages):
        key = (message.stamp_ns, message.msgtype == TRAJECTORY, number)
        heapq.heappush(heap, (*key, message))
        while heap and heap[0][0] < message.stamp_ns - _WINDOW_NS:
            yield heapq.heappop(heap)[-1]
    while heap:
        yield heapq.heappop(heap)[-1]


def _rate(text: str) -> float:
    rate = float(text)
    if not 0 < rate <= 1000:
        raise argparse.ArgumentTypeError(f'{text} is not in (0, 1000]')
    return rate


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='mtv-world replay',
        description=__doc__,
        epilog='Topics are renamed by --ros-args -r /joint_trajectory:=/plan. Exit status: 1 if '
        'the episode could not be played, or if a node reports that it rejected a plan or failed '
        'at it, or does not answer one; the last lines say which and why. Plans that the next '
        'one pre-empts, and Ctrl-C, are no failure.',
    )
    add = parser.add_argument
    add('episode', type=Path, help='rosbag2 MCAP folder or .mcap file')
    add('--rate', type=_rate, default=1.0, help='seconds of the episode a second')
    add('--loop', action='store_true', help='start over at the end')
    add('--clock', action='store_true', help='publish /clock; stamps stay as recorded')
    add('--start', type=float, default=0.0, help='skip this much [s]')
    add('--duration', type=float, default=float('inf'), help='play this much [s]')
    add('--topics', nargs='+', default=[], metavar='TOPIC', help='play only these')
    add('--wait-for', nargs='+', default=[], metavar='TOPIC', help='default: the trajectory')
    add('--wait-timeout', type=float, default=300.0, help='wait for a subscriber this long [s]')
    add('--no-wait', action='store_true', help='play whether or not anybody listens')
    add('--lock-step', action='store_true', help='after each trajectory wait for the answer')
    add('--answer-timeout', type=float, default=120.0, help='wait for an answer this long [s]')
    add('--report-topic', default='world_model/report', help='where answers are reported')
    return parser.parse_args(arguments)


def main(args: Sequence[str] | None = None) -> int:
    """Play an episode; return the exit status."""
    arguments = list(sys.argv if args is None else ('player', *args))
    options = _parse(remove_ros_args(arguments)[1:])
    return run(lambda: Player(options), arguments, spin=Player.play)


if __name__ == '__main__':
    sys.exit(main())
