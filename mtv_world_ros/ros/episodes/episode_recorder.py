"""Records one bag for each episode, from `~/begin` to `~/end`, without connecting anew."""

from __future__ import annotations

from collections.abc import Sequence
import sys
import time

from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from std_srvs.srv import Trigger

from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.data.bag.writer import BagWriter
from mtv_world_ros.ros.bags.recorder import parse, Recorder, SILENCE_S
from mtv_world_ros.ros.run_node import run

#: frames of an episode may be published at the pace of their stamps [s]
_LONGEST_DRAIN_S = 10.0


class EpisodeRecorder(Recorder):
    """Writes `<out>/episode_00000` and so on; a bag appears there when it is complete."""

    silent_after_s = float('inf')  # nothing comes before an episode begins

    def _open(self) -> BagWriter | None:
        self._number, self._bag = 0, self._options.out
        self._end_before_s = float('inf')
        self.create_service(Trigger, '~/begin', self._on_begin)
        self.create_service(Trigger, '~/end', self._on_end)
        return None

    def _on_begin(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Begin a bag after closing an ending one; a second call returns the same bag."""
        if self._writer is not None and self._end_before_s == float('inf'):
            response.success, response.message = True, str(self._bag)
            return response
        self._close_bag()
        path = self._options.out / f'episode_{self._number:05d}'
        try:
            writer = BagWriter(path, overwrite=self._options.overwrite, keep=True)
        except MtvWorldError as error:
            response.message = str(error)
            return response
        self._number += 1
        for topic, msgtype, qos in self._declared:
            writer.declare(topic, msgtype, qos)
        self._writer, self._bag = writer, path
        response.success, response.message = True, str(path)
        return response

    def _on_end(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Close the bag once the topics are silent."""
        now_s = time.monotonic()
        self.last_message_s, self._end_before_s = now_s, now_s + _LONGEST_DRAIN_S
        response.success = True
        return response

    def _after_spin(self) -> None:
        super()._after_spin()
        now_s = time.monotonic()
        is_ending = self._end_before_s < float('inf')
        if is_ending and now_s > min(self.last_message_s + SILENCE_S, self._end_before_s):
            self._close_bag()

    def _close_bag(self) -> None:
        self._end_before_s = float('inf')
        super()._close_bag()


def main(args: Sequence[str] | None = None) -> int:
    """Record until SIGINT or SIGTERM; return the exit status."""
    arguments = list(sys.argv if args is None else ('episode_recorder', *args))
    options = parse(remove_ros_args(arguments)[1:])
    return run(
        lambda: EpisodeRecorder(options, 'episode_recorder'),
        arguments,
        spin=Recorder.record,
        signals=SignalHandlerOptions.NO,
    )


if __name__ == '__main__':
    sys.exit(main())
