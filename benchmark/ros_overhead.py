"""What does the node cost beside the model?

    python benchmark/ros_overhead.py [--repeats 30] [--out benchmark/results]

The real node runs in a process of its own; its world model answers at once with copies of the
start frame. For each size: time from the trajectory's arrival to the last frame handed to the
middleware, without the model, by stage; and CPU times, which other work on the machine changes
less.
"""

from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import page
import rclpy
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from mtv_world_ros.assembly import robot_path
from mtv_world_ros.data_types import CameraModel
from mtv_world_ros.files import share_path
from mtv_world_ros.geometry.calibration_file import save_calibration
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.pipeline import Pipeline, WorldModelSpec
from mtv_world_ros.rendering.trajectory_video import TrajectoryVideoConfig
from mtv_world_ros.ros.messages.conversions import to_joint_state, values_of
from mtv_world_ros.ros.messages.image_messages import to_image
from mtv_world_ros.ros.messages.stamps import make_header
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.world_model.node import main as node_main
from mtv_world_ros.success.estimator import load_tasks, SuccessEstimator
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter

VIEWS = ('low', 'high')
SIZES = ((96, 72, 16), (384, 288, 16), (384, 288, 80))
INSTRUCTION = 'stack the red block on the blue block'
HOME = np.array([0.0, 1.047, 1.047, 0.0, 0.0, 0.0, 0.03] * 2)
FPS = 5.0


class StillWorldModel:
    """Answers at once: nothing moves."""

    def __init__(self, width: int, height: int, num_frames: int) -> None:
        self.spec = WorldModelSpec(
            views=VIEWS,
            fps=FPS,
            num_frames=num_frames,
            width=width,
            height=height,
            robot='yam_bimanual',
        )

    def predict(self, start_frame: np.ndarray, *_: object, **__: object) -> np.ndarray:
        """Returns the start frame again and again."""
        return np.repeat(start_frame[:, None], self.spec.num_frames, axis=1)


def run_node(width: int, height: int, num_frames: int) -> int:
    """The node process."""

    def load(_: Settings) -> Pipeline:
        return Pipeline(
            robot=load_robot(robot_path('yam_bimanual')),
            world_model=StillWorldModel(width, height, num_frames),
            segmenter=ColourSegmenter(),
            estimator=SuccessEstimator(load_tasks(share_path('config', 'tasks'))),
            rendering=TrajectoryVideoConfig(),
        )

    return node_main(sys.argv[:1] + sys.argv[sys.argv.index('--ros-args') :], load=load)


def make_cameras(width: int, height: int) -> dict[str, CameraModel]:
    """Two cameras that look at the table from 1.2 m."""
    T = np.eye(4)
    T[:3, :3] = np.array([[-1, 0, 0], [0, 0.5, -0.866], [0, -0.866, -0.5]])
    T[:3, 3] = (0.0, 1.3, 0.8)
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
    return {
        view: CameraModel(
            view=view, width=width, height=height, K=K, mount_link='base', T_mount_camera=T
        )
        for view in VIEWS
    }


def make_pixels(width: int, height: int) -> np.ndarray:
    """Grey with a red and a blue block."""
    pixels = np.full((height, width, 3), 130, np.uint8)
    side = width // 8
    pixels[height // 2 :, side : 2 * side][:side] = (215, 40, 40)
    pixels[height // 2 :, 4 * side : 5 * side][:side] = (40, 70, 215)
    return pixels


class Robot:
    """Publishes what the node needs and keeps its reports."""

    def __init__(self, node: Node, width: int, height: int) -> None:
        self.node = node
        self.reports: list[dict[str, str]] = []
        self.state: dict[str, str] = {}
        self._pixels = make_pixels(width, height)
        self._cameras = make_cameras(width, height)
        kinds: dict[str, Any] = {'/joint_states': JointState, '/instruction': String}
        kinds |= {f'/{view}/image_raw': Image for view in VIEWS}
        kinds |= {f'/{view}/camera_info': CameraInfo for view in VIEWS}
        kinds |= {'/joint_trajectory': JointTrajectory}
        self._publishers: dict[str, Publisher] = {
            topic: node.create_publisher(kind, topic, 10) for topic, kind in kinds.items()
        }
        self.images: list[Any] = []
        for view in VIEWS:
            for kind, name in ((Image, 'image_raw'), (CameraInfo, 'camera_info')):
                topic = f'/world_model/{view}/predicted/{name}'
                profile = QoSProfile(depth=100)
                node.create_subscription(kind, topic, self.images.append, profile)
        node.create_subscription(DiagnosticArray, '/world_model/report', self._on_report, 100)
        node.create_subscription(DiagnosticArray, '/diagnostics', self._on_state, 10)

    def _on_report(self, message: DiagnosticArray) -> None:
        self.reports.append(values_of(next(iter(message.status))))

    def _on_state(self, message: DiagnosticArray) -> None:
        self.state = values_of(next(iter(message.status)))

    def wait(self, condition: Callable[[], object]) -> None:
        """Spins until the condition holds."""
        end = time.monotonic() + 60
        while not condition():
            if time.monotonic() > end:
                raise TimeoutError('the node did not answer within 60 s')
            rclpy.spin_once(self.node, timeout_sec=0.02)

    def connect(self) -> None:
        """Waits until the node is connected to all topics."""
        inputs = [f'publishers.{topic}' for topic in self._publishers]
        self.wait(lambda: all(self.state.get(key, '0') != '0' for key in inputs))
        self._publishers['/instruction'].publish(String(data=INSTRUCTION))

    def imagine(self, num_frames: int) -> dict[str, str]:
        """Sends scenes and trajectories of one chunk until one is out; returns its reports."""
        ends = ('published', 'rejected', 'failed', 'preempted')
        while True:
            before = len(self.reports)
            self._send(num_frames)
            self.wait(lambda n=before: any(r['state'] in ends for r in self.reports[n:]))
            by_state = {report['state']: report for report in self.reports[before:]}
            if 'published' in by_state:
                return by_state['published'] | by_state['chunk']

    def _send(self, num_frames: int) -> None:
        stamp_ns = self.node.get_clock().now().nanoseconds
        for view, camera in self._cameras.items():
            header = make_header(stamp_ns, f'{view}_optical_frame')
            info = CameraInfo(header=header, width=camera.width, height=camera.height)
            info.distortion_model, info.d, info.k = 'plumb_bob', [0.0] * 5, camera.K.ravel()
            info.p = np.column_stack([camera.K, np.zeros(3)]).ravel()
            self._publishers[f'/{view}/camera_info'].publish(info)
            self._publishers[f'/{view}/image_raw'].publish(to_image(self._pixels, header))
        names = load_robot(robot_path('yam_bimanual')).joint_names
        state = to_joint_state(names, HOME, make_header(stamp_ns))
        self._publishers['/joint_states'].publish(state)
        points: list[JointTrajectoryPoint] = []
        for second in range(1, int(num_frames / FPS) + 1):
            turned = [0.05 * second, *HOME[1:].tolist()]
            points.append(JointTrajectoryPoint(positions=turned))
            points[-1].time_from_start.sec = second
        plan = JointTrajectory(joint_names=list(names), points=points)
        self._publishers['/joint_trajectory'].publish(plan)


def masks_cpu_ms(size: tuple[int, int, int], repeats: int) -> float:
    """CPU time of all threads for the masks of a chunk, median [ms]."""
    width, height, num_frames = size
    still = np.broadcast_to(
        make_pixels(width, height), (len(VIEWS), num_frames, height, width, 3)
    ).copy()
    segmenter, times = ColourSegmenter(), []
    for _ in range(repeats):
        start = time.process_time()
        segmenter.segment(still, ('red block', 'blue block'))
        times.append(time.process_time() - start)
    return 1e3 * float(np.median(times))


def measure_node(node: Node, size: tuple[int, int, int], repeats: int) -> list[str]:
    """One row of the first table; milliseconds."""
    width, height, num_frames = size
    with tempfile.TemporaryDirectory() as folder:
        calibration = Path(folder) / 'calibration.yaml'
        save_calibration(calibration, make_cameras(width, height))
        command = [sys.executable, __file__, '--node', *map(str, size), '--ros-args']
        for value in (f'calibration_file:={calibration}', 'pace:=burst', 'max_image_age_s:=10.0'):
            command += ['-p', value]
        process = subprocess.Popen(command)
        try:
            robot = Robot(node, width, height)
            robot.connect()
            robot.imagine(num_frames)
            robot.imagine(num_frames)
            before_s = page.cpu_s(process.pid)
            reports = [robot.imagine(num_frames) for _ in range(repeats)]
            node_cpu_s = (page.cpu_s(process.pid) - before_s) / repeats
        finally:
            process.terminate()
            process.wait()

    def stage(name: str) -> float:
        return 1e3 * float(np.median([float(r[f'stage_s.{name}']) for r in reports]))

    total = [1e3 * (float(r['last_frame_s']) - float(r['stage_s.model'])) for r in reports]
    stages = [stage(n) for n in ('trajectory_video', 'publish')]
    masks = stage('start_masks') + stage('masks')
    rest = float(np.median(total)) - sum(stages) - masks - stage('success')
    frames = int(reports[0]['frames'])
    cpu = masks_cpu_ms((width, height, frames), repeats)
    cells = [np.median(total), np.percentile(total, 95), stages[0], masks, cpu, stage('success')]
    cells += [stages[1], rest, 1e3 * node_cpu_s]
    return [f'{width}x{height}', str(frames), *(f'{cell:.1f}' for cell in cells)]


def main() -> int:
    """Measures and prints the page."""
    if '--node' in sys.argv:
        at = sys.argv.index('--node')
        return run_node(*(int(x) for x in sys.argv[at + 1 : at + 4]))
    options = page.parse_arguments(__doc__, repeats=30)
    os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    rclpy.init()
    rows = []
    for number, size in enumerate(SIZES):
        node = rclpy.create_node(f'robot_{number}')
        rows.append(measure_node(node, size, options.repeats))
        node.destroy_node()
    header = ['two views of', 'frames', 'outside the model', '95th percentile',
              'trajectory video', 'masks', 'masks: CPU', 'success', 'publishing',
              'rest', 'CPU of the node']  # fmt: skip
    body = (
        'Node time a chunk outside the model [ms], median: from the arrival of the trajectory to '
        'the last frame handed to the middleware, images and camera infos of both views '
        'subscribed by another process, pace burst. `rest` is checks, observation, threads and '
        'the 0.5 ms between two frames of a burst. `masks: CPU` is the CPU time of all threads '
        'for the same masks, in this process; `CPU of the node` is that of a whole chunk, images '
        'taken in and the still world model included.\n\n'
        + page.table(header, rows)
        + f'\n\nLoad of the machine meanwhile (other work included): {os.getloadavg()[0]:.1f} on '
        f'{os.cpu_count()} cores.'
    )
    rclpy.try_shutdown()
    versions = 'rclpy over Fast DDS (ros-rclpy 7.1.6 wheels)'
    command = 'python benchmark/ros_overhead.py'
    page.publish('ros_overhead', 'The node beside the model', command, body, options, versions)
    return 0


if __name__ == '__main__':
    sys.exit(main())
