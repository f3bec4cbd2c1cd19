"""Records ROS topics, byte for byte, as a rosbag2 MCAP folder."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
import signal
import sys
import time

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.utilities import remove_ros_args

from mtv_world_ros.core.errors import ConfigError, EpisodeError
from mtv_world_ros.core.writer_lock import only_writer
from mtv_world_ros.data.bag.metadata import Qos
from mtv_world_ros.data.bag.writer import BagWriter
from mtv_world_ros.ros.messages.conversions import (
    has_header,
    message_class,
    MIN_STAMPED_BYTES,
    read_stamp,
)
from mtv_world_ros.ros.qos_profiles import best_offer, QosWatch
from mtv_world_ros.ros.run_node import run

#: messages kept while the disk is busy
_DEPTH = 2000
#: after a stop signal, silence for this long means that everything arrived [s]
SILENCE_S = 0.5
#: nobody waits longer than this for publishers that do not fall silent [s]
LONGEST_DRAIN_S = 1.0
#: a kill loses no more than what came in this time [s]
_FLUSH_PERIOD_S = 0.5
#: nodes say these as long as they live
_ENDLESS = ('/diagnostics', '/clock')
#: topics that are not there yet are looked for this often [s]
_LOOK_PERIOD_S = 0.05


class Recorder(Node):
    """Subscribes to topics with their publishers' QoS and writes the messages.

    A topic with a publisher but without messages is named in a warning: a publisher may reach a
    new subscription late, e.g. while it still serves one that was killed.

    Args:
        options: options of the command line, see `parse`.
        name: name of the node.

    Raises:
        EpisodeError: the folder exists already or cannot be written.
    """

    #: a topic that brings nothing for this long after 'recording' was said is named [s]
    silent_after_s = 2.0

    def __init__(self, options: argparse.Namespace, name: str = 'recorder') -> None:
        super().__init__(name)
        self._options = options
        self._pending = [self.resolve_topic_name(topic) for topic in options.topics]
        self._optional = [self.resolve_topic_name(topic) for topic in options.if_published]
        self._taken: list[Subscription] = []
        self._declared: list[tuple[str, str, Qos]] = []
        self._next_look_s = 0.0
        self._next_flush_s = 0.0
        self._num_lost: Counter[str] = Counter()
        self._end_s = float('inf')
        self._announced_s = float('inf')
        self._silent: set[str] = set()
        self._counts: Counter[str] = Counter()
        self._last_stamp_ns = 0
        self.last_message_s = 0.0
        self._stopping = False
        self._watch = QosWatch(self)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._on_signal)
        self._writer: BagWriter | None = BagWriter(
            options.out, overwrite=options.overwrite, keep=True
        )

    def record(self) -> None:
        """Record for the given duration, or until a signal and the messages sent before it.

        Raises:
            ConfigError: a topic has no publisher in time.
            EpisodeError: it was stopped before recording began; or the disk is full: the bag
                holds what was recorded until then.
        """
        begin_s = time.monotonic()
        while not self._stopping and time.monotonic() < self._end_s:
            self._connect()
            self._check_patience(time.monotonic() - begin_s)
            self._executor.spin_once(timeout_sec=0.05)
            self._after_spin()
        if self._stopping:
            self._drain()
        self._close_bag()

    def close(self) -> None:
        """Close the bag, whatever ended the recording, and end the node."""
        try:
            self._close_bag()
        except EpisodeError as error:
            self.get_logger().error(str(error))
        finally:
            self.destroy_node()

    def _close_bag(self) -> None:
        """Finish the bag and log its counts; a bag without messages is dropped."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        if not (writer.num_messages or self._is_announced()):
            writer.abort()
            if self._stopping:
                silent = ', '.join(self._pending or [s.topic_name for s in self._taken])
                raise EpisodeError(
                    f"stopped before recording began, '{writer.path}' was not made: "
                    f'{silent or "no topic"} had not been connected yet'
                )
            return
        writer.close()
        counts = {topic: self._counts[topic] for topic, *_ in self._declared}
        counted = ', '.join(f'{topic} {number}' for topic, number in sorted(counts.items()))
        self._counts.clear()
        self.get_logger().info(f"recorded '{writer.path}': {counted or 'nothing'}")
        if self._num_lost:
            lost = ', '.join(f'{topic} {n}' for topic, n in sorted(self._num_lost.items()))
            self.get_logger().warning(f'lost before they got here: {lost}')

    def _after_spin(self) -> None:
        """Flush the bag, and names silent topics."""
        if self._writer is not None and time.monotonic() > self._next_flush_s:
            self._next_flush_s = time.monotonic() + _FLUSH_PERIOD_S
            self._writer.flush()
            self._watch.refresh()
        if time.monotonic() > self._announced_s + self.silent_after_s:
            self._name_silent()

    def _on_signal(self, *_: object) -> None:
        self._stopping = True

    def _connect(self) -> None:
        if not self._pending:
            self._announce()
        if time.monotonic() < self._next_look_s or not (self._pending or self._optional):
            return
        self._next_look_s = time.monotonic() + _LOOK_PERIOD_S
        types = dict(self.get_topic_names_and_types())
        for waiting in (self._pending, self._optional):
            for topic in [t for t in waiting if t in types and self.count_publishers(t)]:
                self._subscribe(topic, types[topic][0], leads=waiting is self._pending)
                waiting.remove(topic)

    def _announce(self) -> None:
        """Log `recording` once every subscription is connected."""
        connected = (s.get_publisher_count() for s in self._taken)
        if not self._is_announced() and all(connected):
            self._announced_s = time.monotonic()
            self._end_s = self._announced_s + self._options.duration
            self.get_logger().info('recording')

    def _is_announced(self) -> bool:
        return self._announced_s < float('inf')

    def _name_silent(self) -> None:
        """Log, once, the topics without messages; their first message is logged later."""
        self.silent_after_s = float('inf')
        self._silent = {s.topic_name for s in self._taken if not self._counts[s.topic_name]}
        if self._silent:
            self.get_logger().warning(
                f'nothing came of {", ".join(sorted(self._silent))} in the '
                f"{time.monotonic() - self._announced_s:.1f} s since 'recording'; if anything was "
                'published there, it is not in the bag'
            )

    def _check_patience(self, waited_s: float) -> None:
        if self._pending and waited_s > self._options.wait_timeout:
            raise ConfigError(
                f'nobody publishes {self._pending} after {self._options.wait_timeout:g} s; '
                'nothing was recorded'
            )

    def _subscribe(self, topic: str, msgtype: str, leads: bool) -> None:
        publishers = self.get_publishers_info_by_topic(topic)
        profile = best_offer(publishers, _DEPTH)
        offered = Qos(
            reliability=profile.reliability.name.lower(),
            durability=profile.durability.name.lower(),
            depth=publishers[0].qos_profile.depth or 10,
        )
        self._declared.append((topic, msgtype, offered))
        if self._writer is not None:
            self._writer.declare(topic, msgtype, offered)
        taken = self.create_subscription(
            message_class(msgtype),
            topic,
            self._handler(topic, msgtype, leads),
            profile,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(
                message_lost=lambda event: self._num_lost.update({topic: event.total_count_change})
            ),
        )
        self._taken.append(taken)

    def _handler(self, topic: str, msgtype: str, leads: bool) -> Callable[[bytes], None]:
        """Return the callback that writes; a leading topic dates messages without a header."""
        by_header = self._options.stamp == 'header'

        def write(data: bytes) -> None:
            if self._writer is None:
                return
            now_ns = self.get_clock().now().nanoseconds
            stamp_ns = now_ns
            if by_header:
                stamp_ns = self._last_stamp_ns or now_ns
                if has_header(msgtype) and len(data) >= MIN_STAMPED_BYTES:
                    stamp_ns = max(read_stamp(data), 0) or now_ns
                    self._last_stamp_ns = stamp_ns if leads else self._last_stamp_ns
            self._writer.write_raw(topic, msgtype, stamp_ns, data, publish_ns=now_ns)
            self._counts[topic] += 1
            if topic in self._silent:
                self._silent.remove(topic)
                waited_s = time.monotonic() - self._announced_s
                self.get_logger().info(f"{topic} began {waited_s:.1f} s after 'recording'")
            if topic not in _ENDLESS:
                self.last_message_s = time.monotonic()

        return write

    def _drain(self) -> None:
        end_s = time.monotonic() + LONGEST_DRAIN_S
        self.last_message_s = time.monotonic()
        while time.monotonic() < min(self.last_message_s + SILENCE_S, end_s):
            self._executor.spin_once(timeout_sec=0.05)


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Return the command line."""
    parser = argparse.ArgumentParser(prog='recorder', description=__doc__)
    add = parser.add_argument
    add('out', type=Path, help='folder to make; it appears when the record is complete')
    add('topics', nargs='+', metavar='TOPIC')
    add(
        '--if-published',
        nargs='+',
        default=[],
        metavar='TOPIC',
        help='record these too from when somebody publishes them, without waiting for it',
    )
    add('--overwrite', action='store_true', help='replace an existing folder')
    add(
        '--stamp',
        choices=('receive', 'header'),
        default='receive',
        help="log time of a message: when it came, or its header's stamp (predictions then lie "
        'at the time they are about); messages without a header take the last header seen of a '
        'TOPIC',
    )
    add('--wait-timeout', type=float, default=60.0, help='wait for publishers this long [s]')
    add('--duration', type=float, default=float('inf'), help='end after this long [s]')
    return parser.parse_args(arguments)


def main(args: Sequence[str] | None = None) -> int:
    """Record until SIGINT or SIGTERM; return the exit status."""
    arguments = list(sys.argv if args is None else ('recorder', *args))
    options = parse(remove_ros_args(arguments)[1:])
    try:
        with only_writer(options.out, 'folder'):
            return _record(options, arguments)
    except ConfigError as error:
        sys.stderr.write(f'ConfigError: {error}\n')
        return 1


def _record(options: argparse.Namespace, arguments: Sequence[str]) -> int:
    return run(
        lambda: Recorder(options),
        arguments,
        spin=Recorder.record,
        signals=SignalHandlerOptions.NO,
    )


if __name__ == '__main__':
    sys.exit(main())
