"""Publishes chunks frame by frame, at the model's rate or in a burst."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
import time

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32MultiArray, Float64

from mtv_world_ros.data_types import ByteArray, ObjectMasks
from mtv_world_ros.pipeline import WorldModelSpec
from mtv_world_ros.ros.messages.conversions import to_joint_state, to_multi_array
from mtv_world_ros.ros.messages.stamps import make_header, NANO
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.status_publisher import create_publisher
from mtv_world_ros.ros.world_model.view_publisher import ViewPublisher
from mtv_world_ros.ros.world_model.worker import Chunk, Ended, Result

#: pause between two frames of a burst [s]: other callbacks get their turn
_BURST_PERIOD_S = 0.0005
#: pause between two chunks of a rollout [s]: subscribers of one chunk's depth empty their queue
_BURST_PAUSE_S = 0.1


@dataclass(slots=True)
class Sent:
    """What became of a chunk.

    Attributes:
        num_frames: frames published.
        publish_s: time spent on publishing [s].
        first_s, last_s: when the first and the last frame went out [s], of `time.monotonic`.
    """

    num_frames: int = 0
    publish_s: float = 0.0
    first_s: float = 0.0
    last_s: float = 0.0


class PredictionPublisher:
    """Takes results in order and publishes them; reports each when it is out.

    Args:
        node: owner of the publishers and the timer.
        spec: of the world model.
        joint_names: J names, in the robot's order.
        settings: the present parameters.
        on_sent: called with a chunk when its last frame is out, or when the rest was dropped.
        on_ended: called with a request's end when all its chunks are out.
        on_error: called with what publishing raised.
    """

    def __init__(
        self,
        node: Node,
        spec: WorldModelSpec,
        joint_names: Sequence[str],
        settings: Callable[[], Settings],
        *,
        on_sent: Callable[[Chunk, Sent], None],
        on_ended: Callable[[Ended], None],
        on_error: Callable[[Exception], None],
    ) -> None:
        self._joint_names, self._settings = tuple(joint_names), settings
        self._on_sent, self._on_ended, self._on_error = on_sent, on_ended, on_error
        self._period_s = 1.0 / spec.fps
        # a chunk, and the one before it should a subscriber still ask for a frame of that again
        depth = 2 * spec.num_frames
        self._views = [ViewPublisher(node, view, depth, settings()) for view in spec.views]
        self._joints = create_publisher(node, JointState, '~/predicted/joint_states', depth)
        self._success = create_publisher(node, Float64, '~/success', 10)
        self._jaccard = create_publisher(node, Float32MultiArray, '~/jaccard', 10)
        self._queue: deque[Result] = deque()
        self._sent = Sent()
        self._not_before_s = 0.0
        self._timer = node.create_timer(
            self._period_s, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self._timer.cancel()

    def subscriber_counts(self) -> dict[str, int]:
        """Subscribers that each topic is connected to, as `subscribers.<topic>`."""
        outputs = [self._joints, self._success, self._jaccard]
        outputs += [publisher for view in self._views for publisher in view.publishers()]
        return {f'subscribers.{o.topic_name}': o.get_subscription_count() for o in outputs}

    def add(self, result: Result) -> None:
        """Publishes a result after those before it.

        Without imagine mode, frames of older rollouts that are not out yet are dropped by the
        first chunk of a newer one: they show a future that is no longer planned.
        """
        if isinstance(result, Chunk) and not result.request.imagine:
            self._drop_others(result.request.rollout)
        self._queue.append(result)
        if self._timer.is_canceled():
            is_burst = self._settings().pace == 'burst'
            period = _BURST_PERIOD_S if is_burst else self._period_s
            self._timer.timer_period_ns = round(period * NANO)
            self._timer.reset()
            self._tick()

    def reset(self) -> None:
        """Drops all frames that are not out yet."""
        self._drop_others(None)

    def _drop_others(self, rollout: int | None) -> None:
        kept = deque(r for r in self._queue if r.request.rollout == rollout)
        dropped = [r for r in self._queue if r.request.rollout != rollout]
        self._queue = kept
        for result in dropped:
            self._finish(result)

    def _tick(self) -> None:
        """Publishes the next frame; a chunk that cannot be published is dropped."""
        try:
            self._publish_next()
        except Exception as error:  # the node goes on
            self._on_error(error)
            self._queue.popleft()
            self._sent = Sent()

    def _publish_next(self) -> None:
        """The first call without a frame stops the timer."""
        self._finish_ended()
        if not self._queue:
            self._timer.cancel()
            return
        chunk = self._queue[0]
        assert isinstance(chunk, Chunk)
        if self._sent.num_frames == 0 and time.monotonic() < self._not_before_s:
            return
        self._publish_frame(chunk)
        if self._sent.num_frames == len(chunk.prediction.video.times):
            self._queue.popleft()
            self._publish_estimate(chunk)
            self._finish(chunk)
            self._finish_ended()

    def _finish_ended(self) -> None:
        while self._queue and isinstance(self._queue[0], Ended):
            self._finish(self._queue.popleft())

    def _finish(self, result: Result) -> None:
        if isinstance(result, Ended):
            self._on_ended(result)
            return
        sent, self._sent = self._sent, Sent()
        is_last = result.prediction.chunk + 1 == result.prediction.num_chunks
        self._not_before_s = 0.0 if is_last else time.monotonic() + _BURST_PAUSE_S
        self._on_sent(result, sent)

    def _publish_frame(self, chunk: Chunk) -> None:
        begin = time.monotonic()
        index = self._sent.num_frames
        self._sent.first_s = self._sent.first_s or begin
        stamp_ns = stamp_of(chunk, index, self._settings().stamp_mode)
        for view, publisher in enumerate(self._views):
            self._publish_view(chunk, view, publisher, index, stamp_ns)
        positions = chunk.prediction.positions[index]
        header = make_header(stamp_ns)
        self._joints.publish(to_joint_state(self._joint_names, positions, header))
        self._sent.num_frames += 1
        self._sent.last_s = time.monotonic()
        self._sent.publish_s += self._sent.last_s - begin

    def _publish_view(
        self, chunk: Chunk, view: int, publisher: ViewPublisher, index: int, stamp_ns: int
    ) -> None:
        prediction, info = chunk.prediction, chunk.scene.camera_infos[view]
        frames: dict[str, Callable[[], ByteArray]] = {
            'predicted': lambda: prediction.video.frames[view, index],
            'trajectory': lambda: prediction.trajectory_video.frames[view, index + 1],
            'mask': lambda: label_image(prediction.masks, view, index),
        }
        for stream, frame in frames.items():
            if publisher.wants(stream):
                header = make_header(stamp_ns, info.header.frame_id)
                quality = self._settings().jpeg_quality
                publisher.publish(stream, frame(), header, info, quality)

    def _publish_estimate(self, chunk: Chunk) -> None:
        prediction = chunk.prediction
        self._success.publish(Float64(data=float(prediction.success.probability)))
        labels = (
            f'view: {", ".join(prediction.video.views)}',
            f'object: {", ".join(prediction.masks.names)}',
        )
        self._jaccard.publish(to_multi_array(prediction.success.jaccard, labels))


def stamp_of(chunk: Chunk, index: int, stamp_mode: str) -> int:
    """Stamp of a chunk's frame [ns]: its predicted time, or that of the real frames behind it."""
    if stamp_mode == 'source':
        return chunk.scene.source_stamp_ns
    return chunk.prediction.stamp_ns + round(chunk.prediction.video.times[index] * NANO)


def label_image(masks: ObjectMasks, view: int, index: int) -> ByteArray:
    """(H, W) uint8: 0 = none, i + 1 = object i; the later object where two overlap."""
    labels = np.zeros(masks.masks.shape[-2:], np.uint8)
    for number, mask in enumerate(masks.masks[view, :, index], start=1):
        labels[mask] = number
    return labels
