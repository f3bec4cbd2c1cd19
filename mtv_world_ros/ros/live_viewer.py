"""Shows what cameras, robots and the world model publish, while they do, in the Rerun viewer."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
import sys
from typing import Any

from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from mtv_world_ros.data.bag.message_sizes import check_size
from mtv_world_ros.data.bag.reader import BagMessage
from mtv_world_ros.ros.messages.conversions import has_header, message_class, read_stamp
from mtv_world_ros.ros.qos_profiles import best_offer, QosWatch
from mtv_world_ros.ros.run_node import run
from mtv_world_ros.viewing import rerun_log
from mtv_world_ros.viewing.streams import add_message, shown_as, Streams
from mtv_world_ros.viewing.viewer_process import PageAddress

#: new topics are looked for this often [s]
_LOOK_PERIOD_S = 0.5
#: messages kept while the viewer is busy; older ones are dropped
_DEPTH = 10
_ROOT = '/live'


class LiveViewer(Node):
    """Subscribes to every topic that the viewer can show, once it has a publisher.

    Args:
        stream: recording of the viewer, which is served or saved already.
        name: name of the node.
    """

    def __init__(self, stream: Any, name: str = 'viewer') -> None:
        super().__init__(name)
        self._stream = stream
        self._topics: dict[tuple[str, ...], str] = {}
        self._shown = Streams()
        self._begin_ns = self._last_ns = 0
        self._num_refused = 0
        self._watch = QosWatch(self)
        self.create_timer(_LOOK_PERIOD_S, self._look)

    def _look(self) -> None:
        """Subscribe to new topics; of raw and compressed images of one view to the latter."""
        self._watch.refresh()
        found = dict(self.get_topic_names_and_types())
        for topic in sorted(found, key=lambda topic: (not topic.endswith('compressed'), topic)):
            kind = shown_as(topic, found[topic][0])
            if kind is None or kind in self._topics or not self.count_publishers(topic):
                continue
            self._topics[kind] = topic
            self._subscribe(topic, found[topic][0])

    def _subscribe(self, topic: str, msgtype: str) -> None:
        profile = best_offer(self.get_publishers_info_by_topic(topic), _DEPTH)
        self.get_logger().info(f'showing {topic}')
        self.create_subscription(
            message_class(msgtype), topic, self._handler(topic, msgtype), profile, raw=True
        )

    def _handler(self, topic: str, msgtype: str) -> Callable[[bytes], None]:
        def show(data: bytes) -> None:
            try:
                self._show(topic, msgtype, data)
            except Exception as error:  # the viewer never ends of a message
                self._num_refused += 1
                text = f'{self._num_refused} messages cannot be shown; the last, of {topic}: '
                self.get_logger().warning(f'{text}{error}', throttle_duration_sec=5.0)

        return show

    def _show(self, topic: str, msgtype: str, data: bytes) -> None:
        check_size(msgtype, data)
        # what has no stamp is about the last frame
        stamp_ns = read_stamp(data) if has_header(msgtype) else self._last_ns
        stamp_ns = stamp_ns or self._last_ns or self.get_clock().now().nanoseconds
        self._begin_ns = self._begin_ns or stamp_ns
        self._last_ns = stamp_ns
        taken = Streams()
        add_message(
            taken,
            BagMessage(
                topic=topic, msgtype=msgtype, stamp_ns=stamp_ns, data=data, publish_ns=stamp_ns
            ),
        )
        if not {*taken.images} <= {*self._shown.images} or (
            taken.success and not self._shown.success
        ):
            self._shown.images.update({key: [] for key in taken.images})
            self._shown.success.extend(taken.success)
            self._stream.send_blueprint(rerun_log.layout({_ROOT: self._shown}))
        rerun_log.log_streams(self._stream, taken, _ROOT, self._begin_ns)


def main(args: Sequence[str] | None = None) -> int:
    """Show topics until Ctrl-C; return the exit status."""
    arguments = list(sys.argv if args is None else ('live_viewer', *args))
    parser = argparse.ArgumentParser(prog='live_viewer', description=__doc__)
    parser.add_argument('--port', type=PageAddress.parse, default=PageAddress())
    parser.add_argument('--save', type=Path)
    parser.add_argument('--native', action='store_true')
    options = parser.parse_args(remove_ros_args(arguments)[1:])
    stream = rerun_log.recording('live')
    note = rerun_log.open_viewer(stream, None, options.port, options.save, options.native)
    sys.stdout.write(f'{note}\nCtrl-C ends it\n')
    sys.stdout.flush()
    status = run(lambda: LiveViewer(stream), arguments)
    stream.flush()
    return status


if __name__ == '__main__':
    sys.exit(main())
