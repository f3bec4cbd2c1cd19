"""Publishers of one view: predicted, trajectory and mask images, each with its CameraInfo."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header

from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.ros.messages.image_messages import scale_camera_info, to_compressed, to_image
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.status_publisher import create_publisher


class ViewPublisher:
    """Publishes the frames of one view; what nobody subscribes to is not made.

    Args:
        node: owner of the publishers.
        view: name of the view.
        depth: frames kept for subscribers that ask for them again.
        settings: what is offered is decided once, here.
    """

    def __init__(self, node: Node, view: str, depth: int, settings: Settings) -> None:
        self._streams = {'predicted': _Stream(node, f'~/{view}/predicted', depth)}
        if settings.publish_compressed:
            self._streams['predicted'].offer_compressed(node)
        if settings.publish_trajectory_video:
            self._streams['trajectory'] = _Stream(node, f'~/{view}/trajectory', depth)
        if settings.publish_masks:
            self._streams['mask'] = _Stream(node, f'~/{view}/mask', depth)

    def publishers(self) -> list[Publisher]:
        """All of them."""
        return [p for stream in self._streams.values() for p in stream.publishers()]

    def wants(self, stream: str) -> bool:
        """Whether somebody subscribes to a stream: `predicted`, `trajectory` or `mask`."""
        return stream in self._streams and self._streams[stream].is_wanted()

    def publish(
        self, stream: str, pixels: ByteArray, header: Header, info: CameraInfo, quality: int
    ) -> None:
        """Publishes a frame, (H, W, 3) RGB or (H, W) labels, and its CameraInfo.

        Args:
            stream: `predicted`, `trajectory` or `mask`.
            pixels: uint8.
            header: stamp and frame.
            info: CameraInfo of the source image, of any size.
            quality: of JPEG.
        """
        self._streams[stream].publish(pixels, header, info, quality)


class _Stream:
    """Image, optionally compressed image, and CameraInfo under one name."""

    def __init__(self, node: Node, name: str, depth: int) -> None:
        self._name, self._depth = name, depth
        self._image = create_publisher(node, Image, f'{name}/image_raw', depth)
        self._info = create_publisher(node, CameraInfo, f'{name}/camera_info', depth)
        self._compressed: Publisher | None = None
        self._scaled: tuple[CameraInfo, CameraInfo] | None = None

    def offer_compressed(self, node: Node) -> None:
        topic = f'{self._name}/image_raw/compressed'
        self._compressed = create_publisher(node, CompressedImage, topic, self._depth)

    def is_wanted(self) -> bool:
        return any(publisher.get_subscription_count() for publisher in self.publishers())

    def publish(self, pixels: ByteArray, header: Header, info: CameraInfo, quality: int) -> None:
        height, width = pixels.shape[:2]
        if self._info.get_subscription_count():
            self._info.publish(self._scale(info, width, height, header))
        if self._image.get_subscription_count():
            self._image.publish(to_image(pixels, header))
        if self._compressed is not None and self._compressed.get_subscription_count():
            self._compressed.publish(to_compressed(pixels, header, quality))

    def _scale(self, info: CameraInfo, width: int, height: int, header: Header) -> CameraInfo:
        """Scales an info once for all frames of a rollout."""
        if self._scaled is None or self._scaled[0] is not info:
            self._scaled = info, scale_camera_info(info, width, height, header)
        self._scaled[1].header = header
        return self._scaled[1]

    def publishers(self) -> list[Publisher]:
        optional = [self._compressed] if self._compressed is not None else []
        return [self._image, self._info, *optional]
