"""Publishes predictions: the verdict of a chunk at once, its frames at the pace that is set."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
import time
from typing import NamedTuple

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState
from std_msgs.msg import Float32MultiArray, Float64, Header

from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.rollout.pipeline import WorldModelSpec
from mtv_world_ros.ros.messages.conversions import (
    make_header,
    NANO,
    to_joint_state,
    to_multi_array,
)
from mtv_world_ros.ros.messages.image_messages import scale_camera_info, to_compressed, to_image
from mtv_world_ros.ros.node_events import ignore_sent, NodeEvents
from mtv_world_ros.ros.status_publisher import create_publisher
from mtv_world_ros.ros.world_model.chunk_outcomes import Sent
from mtv_world_ros.ros.world_model.worker import Chunk, Ended, Result

#: quality of predictions as JPEG, of 100
JPEG_QUALITY = 90


class ImageStream:
    """Publishes an image, its JPEG and its CameraInfo; what nobody subscribes to is not made.

    Args:
        node: owner of the publishers.
        name: beginning of the topics.
        depth: frames kept for subscribers that ask for them again.
        has_jpeg: whether JPEG is offered, too.
    """

    def __init__(self, node: Node, name: str, depth: int, *, has_jpeg: bool) -> None:
        self._image = create_publisher(node, Image, f'{name}/image_raw', depth)
        self._info = create_publisher(node, CameraInfo, f'{name}/camera_info', depth)
        self._jpeg: Publisher | None = None
        if has_jpeg:
            topic = f'{name}/image_raw/compressed'
            self._jpeg = create_publisher(node, CompressedImage, topic, depth)
        self._scaled: tuple[CameraInfo, CameraInfo] | None = None

    @property
    def publishers(self) -> list[Publisher]:
        """Return all publishers."""
        return [self._image, self._info, *([] if self._jpeg is None else [self._jpeg])]

    @property
    def is_wanted(self) -> bool:
        """Return whether the topics have subscribers."""
        return any(publisher.get_subscription_count() for publisher in self.publishers)

    def publish(self, pixels: ByteArray, header: Header, info: CameraInfo, quality: int) -> None:
        """Publish a frame and its CameraInfo.

        Args:
            pixels: (H, W, 3) uint8 RGB, or (H, W) uint8 labels.
            header: stamp and frame.
            info: CameraInfo of the source image, of any size.
            quality: quality of JPEG.
        """
        height, width = pixels.shape[:2]
        if self._info.get_subscription_count():
            self._info.publish(self._scale(info, width, height, header))
        if self._image.get_subscription_count():
            self._image.publish(to_image(pixels, header))
        if self._jpeg is not None and self._jpeg.get_subscription_count():
            self._jpeg.publish(to_compressed(pixels, header, quality))

    def _scale(self, info: CameraInfo, width: int, height: int, header: Header) -> CameraInfo:
        """Scale an info once for all frames of a rollout."""
        if self._scaled is None or self._scaled[0] is not info:
            self._scaled = info, scale_camera_info(info, width, height, header)
        self._scaled[1].header = header
        return self._scaled[1]


#: pause between two frames of a burst [s]: other callbacks get their turn
_BURST_PERIOD_S = 0.0005
#: pause between two chunks of a rollout [s]: subscribers of one chunk's depth empty their queue
_BURST_PAUSE_S = 0.1
#: how often the clock is looked at while a frame waits for its time [s]
_LOOK_PERIOD_S = 0.01


class PredictionPublisher:
    """Publishes results in order: estimates at once, masks as fast as subscribers take them.

    The images go out at the pace that is set: in `burst` as fast as they are taken; in `realtime`
    each one period before its stamp, or at once where that has passed. In imagine mode stamps say
    nothing about the clock, and `realtime` is the model's frame rate.

    Args:
        node: owner of the publishers and timers.
        spec: spec of the world model.
        joint_names: J names, in the robot's order.
        events: has the present parameters; takes chunks that are judged or sent, and ends.
    """

    def __init__(
        self,
        node: Node,
        spec: WorldModelSpec,
        joint_names: Sequence[str],
        events: NodeEvents,
    ) -> None:
        self._node, self._joint_names, self._events = node, tuple(joint_names), events
        self._settings = events.settings
        self._period_s = 1.0 / spec.fps
        # a chunk, and the one before it should a subscriber still ask for a frame of that again
        depth = 2 * spec.num_frames
        self._streams = [self._offer(view, depth) for view in spec.views]
        self._joints = create_publisher(node, JointState, '~/predicted/joint_states', depth)
        self._success = create_publisher(node, Float64, '~/success', 10)
        self._jaccard = create_publisher(node, Float32MultiArray, '~/jaccard', 10)
        self._images = FrameQueue(
            node, self._publish_images, self._wait_s, events.on_sent, events.on_error
        )
        self._masks = FrameQueue(
            node, self._publish_masks, _burst_wait_s, ignore_sent, events.on_error
        )

    def subscriber_counts(self) -> dict[str, int]:
        """Return the subscribers that each topic is connected to, as `subscribers.<topic>`."""
        outputs = [self._joints, self._success, self._jaccard]
        for offered in self._streams:
            outputs += [publisher for one in offered.values() for publisher in one.publishers]
        return {f'subscribers.{o.topic_name}': o.get_subscription_count() for o in outputs}

    def add(self, result: Result) -> None:
        """Publish a result.

        Without imagine mode, frames of older rollouts that are not out yet are dropped by the
        first chunk of a newer one: they show a future that is no longer planned.
        """
        if isinstance(result, Ended):
            self._events.on_ended(result)
            return
        try:
            self._publish_estimate(result)
        except Exception as error:  # an error must not stop the node
            self._events.on_error(error)
        self._events.on_judged(result)
        for frames in (self._masks, self._images):
            if not result.request.imagine:
                frames.drop_others(result.request.rollout)
            frames.add(result)

    def reset(self) -> None:
        """Drop all frames that are not out yet."""
        for frames in (self._masks, self._images):
            frames.drop_others(None)

    def _offer(self, view: str, depth: int) -> dict[str, ImageStream]:
        """Return the streams of a view by name; pictures are made for subscribers alone."""
        return {
            name: ImageStream(
                self._node,
                f'~/{view}/{name}',
                depth,
                has_jpeg=name == 'predicted',
            )
            for name in ('predicted', 'trajectory', 'mask')
        }

    def _wait_s(self, chunk: Chunk, index: int, last: Last) -> float:
        """Pace of the images."""
        if self._settings().pace == 'burst':
            return _burst_wait_s(chunk, index, last)
        if chunk.request.imagine:
            return last.out_s + self._period_s - time.monotonic()
        return self._lead_s(chunk, index) - self._period_s

    def _lead_s(self, chunk: Chunk, index: int) -> float:
        """Time until the stamp of a frame [s], by the node's clock."""
        now_ns = self._node.get_clock().now().nanoseconds
        return (stamp_of(chunk, index, 'target') - now_ns) / NANO

    def _publish_images(self, chunk: Chunk, index: int, sent: Sent) -> None:
        begin_s = time.monotonic()
        sent.leads_s.append(self._lead_s(chunk, index))
        stamp_ns = self._publish(chunk, ('predicted', 'trajectory'), index)
        positions = chunk.prediction.positions[index]
        self._joints.publish(to_joint_state(self._joint_names, positions, make_header(stamp_ns)))
        sent.out_s.append(time.monotonic())
        sent.publish_s += sent.out_s[-1] - begin_s

    def _publish_masks(self, chunk: Chunk, index: int, sent: Sent) -> None:
        self._publish(chunk, ('mask',), index)
        sent.out_s.append(time.monotonic())

    def _publish(self, chunk: Chunk, streams: Sequence[str], index: int) -> int:
        """Publish a frame of streams that somebody subscribes to; return its stamp [ns]."""
        stamp_ns = stamp_of(chunk, index, self._settings().stamp_mode)
        for view, offered in enumerate(self._streams):
            info = chunk.scene.camera_infos[view]
            for name in streams:
                if name in offered and offered[name].is_wanted:
                    pixels = _pixels(chunk, name, view, index)
                    header = make_header(stamp_ns, info.header.frame_id)
                    offered[name].publish(pixels, header, info, JPEG_QUALITY)
        return stamp_ns

    def _publish_estimate(self, chunk: Chunk) -> None:
        prediction = chunk.prediction
        self._success.publish(Float64(data=float(prediction.success.probability)))
        labels = (
            f'view: {", ".join(prediction.video.views)}',
            f'object: {", ".join(prediction.masks.names)}',
        )
        self._jaccard.publish(to_multi_array(prediction.success.jaccard, labels))


class Last(NamedTuple):
    """Last published frame: time by `time.monotonic` [s], rollout and chunk."""

    out_s: float = 0.0
    rollout: int = 0
    chunk: int = 0


class FrameQueue:
    """Publishes the frames of chunks in order, each when its time has come.

    Args:
        node: owner of the timer.
        publish: publishes a frame and notes it.
        wait_s: time until a frame is due, from the one before [s].
        on_sent: called with a chunk when its last frame is out, or when the rest was dropped.
        on_error: called with what publishing raised; the rest of the chunk is dropped.
    """

    def __init__(
        self,
        node: Node,
        publish: Callable[[Chunk, int, Sent], None],
        wait_s: Callable[[Chunk, int, Last], float],
        on_sent: Callable[[Chunk, Sent], None],
        on_error: Callable[[Exception], None],
    ) -> None:
        self._publish, self._wait_s = publish, wait_s
        self._on_sent, self._on_error = on_sent, on_error
        self._chunks: deque[Chunk] = deque()
        self._sent, self._last = Sent(), Last()
        self._timer = node.create_timer(
            _BURST_PERIOD_S, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self._timer.cancel()

    def add(self, chunk: Chunk) -> None:
        """Publish the frames of a chunk after those before it."""
        self._chunks.append(chunk)
        if self._timer.is_canceled():
            self._timer.reset()
            self._tick()

    def drop_others(self, rollout: int | None) -> None:
        """Drop the frames of all rollouts but one."""
        while self._chunks and self._chunks[0].request.rollout != rollout:
            self._finish()

    def _tick(self) -> None:
        """Publish the next frame if its time has come; without one the timer stops."""
        if not self._chunks:
            self._timer.cancel()
            return
        chunk, index = self._chunks[0], self._sent.num_frames
        try:
            wait_s = self._wait_s(chunk, index, self._last)
            if wait_s <= 0:
                self._publish(chunk, index, self._sent)
                self._last = Last(time.monotonic(), chunk.request.rollout, chunk.prediction.chunk)
        except Exception as error:  # an error must not stop the node
            self._on_error(error)
            self._finish()
            return
        if self._sent.num_frames == len(chunk.prediction.video.times):
            self._finish()
        period_s = min(max(wait_s, _BURST_PERIOD_S), _LOOK_PERIOD_S)
        if self._timer.timer_period_ns != round(period_s * NANO):
            self._timer.timer_period_ns = round(period_s * NANO)

    def _finish(self) -> None:
        chunk, sent = self._chunks.popleft(), self._sent
        self._sent = Sent()
        self._on_sent(chunk, sent)


def _burst_wait_s(chunk: Chunk, index: int, last: Last) -> float:
    """Pace of a burst: frames at once, but a pause between two chunks of a rollout."""
    is_next = last.rollout == chunk.request.rollout and last.chunk != chunk.prediction.chunk
    return last.out_s + _BURST_PAUSE_S - time.monotonic() if is_next and not index else 0.0


def stamp_of(chunk: Chunk, index: int, stamp_mode: str) -> int:
    """Stamp of a chunk's frame [ns]: its predicted time, or that of the real frames behind it."""
    if stamp_mode == 'source':
        return chunk.scene.source_stamp_ns
    return chunk.prediction.stamp_ns + round(chunk.prediction.video.times[index] * NANO)


def _pixels(chunk: Chunk, stream: str, view: int, index: int) -> ByteArray:
    """Return a frame of a stream, (H, W, 3) RGB or (H, W) labels."""
    prediction = chunk.prediction
    if stream == 'mask':  # 0 = no object, i + 1 = object i; the later one where two overlap
        labels = np.zeros(prediction.masks.masks.shape[-2:], np.uint8)
        for number, mask in enumerate(prediction.masks.masks[view, :, index], start=1):
            labels[mask] = number
        return labels
    if stream == 'trajectory':
        return prediction.trajectory_video.frames[view, index + 1]
    return prediction.video.frames[view, index]
