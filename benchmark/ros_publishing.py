"""How fast does the node publish images, against bare rclpy?

    python benchmark/ros_publishing.py [--repeats 30] [--out benchmark/results]

Images with their CameraInfo through the node's publisher, which rescales the CameraInfo, and
through bare rclpy publishers, taking turns in one process, to one subscriber in another. Then
best-effort images of 640x480 that arrive, with and without the Fast DDS profile of the package.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import os
import subprocess
import sys
import time

import numpy as np
import page
import rclpy
from rclpy._rclpy_pybind11 import RCLError
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image

from mtv_world_ros.files import share_path
from mtv_world_ros.ros.messages.image_messages import to_image
from mtv_world_ros.ros.messages.stamps import make_header
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.world_model.view_publisher import ViewPublisher

NUM_IMAGES = 200
CAMERA_HZ = 30.0


def run_subscriber() -> int:
    """The subscriber process of the first part: takes images as fast as it can."""
    rclpy.init()
    node = rclpy.create_node('subscriber')
    for topic, kind in (
        ('/bare', Image),
        ('/bare_info', CameraInfo),
        ('/publisher/low/predicted/image_raw', Image),
        ('/publisher/low/predicted/camera_info', CameraInfo),
    ):
        node.create_subscription(kind, topic, lambda _: None, 10)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException, RCLError):
        rclpy.spin(node)
    return 0


def measure_publishing(repeats: int, seed: int) -> list[list[str]]:
    """Rows of the first table: images a second, and ours against bare in the same turn."""
    node = rclpy.create_node('publisher')
    settings = Settings(
        publish_compressed=False, publish_trajectory_video=False, publish_masks=False
    )
    ours = ViewPublisher(node, 'low', 16, settings)
    bare_image = node.create_publisher(Image, '/bare', 16)
    bare_info = node.create_publisher(CameraInfo, '/bare_info', 16)
    process = subprocess.Popen([sys.executable, __file__, '--subscriber'])
    rows = []
    try:
        while not (ours.wants('predicted') and bare_info.get_subscription_count()):
            rclpy.spin_once(node, timeout_sec=0.02)
        time.sleep(0.5)  # the other publishers of either side
        for width, height in ((96, 72), (384, 288)):
            shape = (height, width, 3)
            pixels = np.random.default_rng(seed).integers(0, 255, shape, np.uint8)
            info = CameraInfo(width=2 * width, height=2 * height, d=[0.0] * 5)

            def publish_ours(pixels: np.ndarray = pixels, info: CameraInfo = info) -> None:
                ours.publish('predicted', pixels, make_header(1, 'low'), info, 90)

            def publish_bare(pixels: np.ndarray = pixels, info: CameraInfo = info) -> None:
                bare_info.publish(info)
                bare_image.publish(to_image(pixels, make_header(1, 'low')))

            rates = [(_rate(publish_ours), _rate(publish_bare)) for _ in range(repeats)]
            ratios = [a / b for a, b in rates]
            mine, bare = np.median(rates, axis=0)
            spread = f'{np.percentile(ratios, 5):.2f}–{np.percentile(ratios, 95):.2f}'
            ratio = f'{np.median(ratios):.2f} ({spread})'
            rows.append([f'{width}x{height}', f'{mine:.0f}', f'{bare:.0f}', ratio])
    finally:
        process.terminate()
        process.wait()
        node.destroy_node()
    return rows


def _rate(publish: Callable[[], None]) -> float:
    begin = time.perf_counter()
    for _ in range(NUM_IMAGES):
        publish()
    return NUM_IMAGES / (time.perf_counter() - begin)


def count_arrivals() -> int:
    """The camera's subscriber: prints how many of the images came."""
    rclpy.init()
    node = rclpy.create_node('viewer')
    stamps: list[int] = []

    def keep(message: Image) -> None:
        stamps.append(message.header.stamp.sec)

    profile = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    node.create_subscription(Image, '/vga', keep, profile)
    end = time.monotonic() + 40
    while time.monotonic() < end and (not stamps or stamps[-1] <= NUM_IMAGES):
        rclpy.spin_once(node, timeout_sec=0.05)
    print(sum(stamp <= NUM_IMAGES for stamp in stamps))
    return 0


def send_camera() -> int:
    """A camera of 640x480 at 30 Hz; sends more than are counted, should the last be lost."""
    rclpy.init()
    node = rclpy.create_node('camera')
    publisher = node.create_publisher(Image, '/vga', 10)
    while not publisher.get_subscription_count():
        rclpy.spin_once(node, timeout_sec=0.02)
    pixels = np.zeros((480, 640, 3), np.uint8)
    begin = time.monotonic()
    for number in range(1, NUM_IMAGES + 30):
        time.sleep(max(0.0, begin + number / CAMERA_HZ - time.monotonic()))
        publisher.publish(to_image(pixels, make_header(number * 10**9)))
    return 0


def measure_arrivals(repeats: int) -> list[list[str]]:
    """Rows of the second table."""
    profile = str(share_path('config', 'fastdds_profile.xml'))
    setups = {
        'as it is': {},
        'config/fastdds_profile.xml': {'FASTRTPS_DEFAULT_PROFILES_FILE': profile},
    }
    shares: dict[str, list[float]] = {name: [] for name in setups}
    for _ in range(repeats):  # in turns
        for name, extra in setups.items():
            environment = {**os.environ, **extra}
            viewer = subprocess.Popen(
                [sys.executable, __file__, '--viewer'], env=environment, stdout=subprocess.PIPE
            )
            subprocess.run([sys.executable, __file__, '--camera'], env=environment, check=True)
            shares[name].append(int(viewer.communicate()[0]) / NUM_IMAGES)
    return [[name, ', '.join(f'{x:.0%}' for x in found)] for name, found in shares.items()]


ROLES = {'--subscriber': run_subscriber, '--viewer': count_arrivals, '--camera': send_camera}


def main() -> int:
    """Measures and prints the page."""
    for role, act in ROLES.items():
        if role in sys.argv:
            return act()
    options = page.parse_arguments(__doc__, repeats=30)
    os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    rclpy.init()
    header = ['size', 'node', 'bare rclpy', 'ratio, median (5th–95th percentile)']
    body = (
        f'Images with their CameraInfo published a second (wall time), {NUM_IMAGES} a turn.\n\n'
        + page.table(header, measure_publishing(options.repeats, options.seed))
        + f'\n\nBest-effort images of 640x480 at {CAMERA_HZ:g} Hz that arrive at depth 1, of '
        f'{NUM_IMAGES}; three runs.\n\n' + page.table(['Fast DDS', 'arrived'], measure_arrivals(3))
    )
    rclpy.try_shutdown()
    versions = 'rclpy over Fast DDS (ros-rclpy 7.1.6 wheels)'
    command = 'python benchmark/ros_publishing.py'
    page.publish('ros_publishing', 'Publishing images', command, body, options, versions)
    return 0


if __name__ == '__main__':
    sys.exit(main())
