"""Plans of an ordinary client beside its cameras: each gets its verdict, and in time.

The client has Fast DDS' default settings, or those of `--transports`, never this package's
profiles. It publishes cameras, joint states and a plan every `1 / --rate` seconds, and measures
the time from publishing a plan to its verdict. A third camera is read by a process of its own.
Prints a row; the exit status is 1 if a plan had no verdict within `--limit` seconds.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
import json
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np

#: environment variables by which a process gets Fast DDS settings
SETTINGS = (
    'FASTRTPS_DEFAULT_PROFILES_FILE',
    'FASTDDS_DEFAULT_PROFILES_FILE',
    'FASTDDS_BUILTIN_TRANSPORTS',
    'RMW_FASTRTPS_USE_QOS_FROM_XML',
    'RMW_FASTRTPS_PUBLICATION_MODE',
)
for setting in SETTINGS:
    os.environ.pop(setting, None)

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
import rclpy  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: E402
from rclpy.serialization import serialize_message  # noqa: E402
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState  # noqa: E402
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMsg  # noqa: E402

from mtv_world_ros.core.data_types import JointTrajectory  # noqa: E402
from mtv_world_ros.core.files import share_path  # noqa: E402
from mtv_world_ros.core.images import resize_frames  # noqa: E402
from mtv_world_ros.data.recording import load_recording, Recording  # noqa: E402
from mtv_world_ros.ros.messages.conversions import (  # noqa: E402
    make_header,
    to_joint_state,
    to_trajectory_message,
    values_of,
    with_stamp,
)
from mtv_world_ros.ros.messages.image_messages import to_compressed, to_image  # noqa: E402
from mtv_world_ros.ros.parameters import Settings  # noqa: E402
from mtv_world_ros.ros.world_model.loading import load_named_pipeline  # noqa: E402
from test.support.ros_domain import claim_domain  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
EPISODE = share_path('resource', 'demo_episode')
#: length of a plan [s], of the cameras' joint states [Hz]
PLAN_S = 3.2
JOINT_HZ = 50.0
#: plans before those that count: the first ones of a node take longer
NUM_WARM_UP = 3
#: a plan is given up after this long [s]
PATIENCE_S = 8.0
START_S = 120.0
ENDS = ('done', 'preempted', 'rejected', 'failed', 'reset')
#: name of a camera that the model does not use
OTHER_VIEW = 'third'


class Cameras:
    """Cameras and joint states of a robot that stands still.

    Args:
        node: owner of the publishers.
        recording: its first frame is shown.
        options: of the command line.
    """

    def __init__(self, node: Node, recording: Recording, options: argparse.Namespace) -> None:
        kind_of_images = CompressedImage if options.compressed else Image
        reliability = ReliabilityPolicy.BEST_EFFORT if options.best_effort else None
        profile = QoSProfile(depth=10)
        if reliability is not None:
            profile.reliability = reliability
        suffix = '/compressed' if options.compressed else ''
        width, height = options.size
        self._outputs = []
        views = [(camera.view, row) for row, camera in enumerate(recording.cameras)]
        for view, row in [*views, (OTHER_VIEW, 0)][: options.cameras]:
            pixels = resize_frames(recording.frames[row, :1], width, height)[0]
            header = make_header(0, f'{view}_optical_frame')
            message = (
                to_compressed(pixels, header, 90)
                if options.compressed
                else to_image(pixels, header)
            )
            info = _info(recording.cameras[row], width, height, header)
            for kind, name, data in (
                (CameraInfo, f'/{view}/camera_info', info),
                (kind_of_images, f'/{view}/image_raw{suffix}', message),
            ):
                publisher = node.create_publisher(kind, name, profile)
                self._outputs.append((publisher, serialize_message(data)))
        names = recording.commands.joint_names
        self._joints = node.create_publisher(JointState, '/joint_states', 10)
        self._state = to_joint_state(names, recording.positions[0], make_header(0))
        self._period_s = 1 / options.hz
        self._next_s = self._next_joints_s = time.monotonic()
        self.num_late = 0

    @property
    def topics(self) -> list[str]:
        """Names of what is published."""
        return [*(publisher.topic_name for publisher, _ in self._outputs), '/joint_states']

    def publish_due(self) -> None:
        """Publish what is due; images that are late by a period are left out, as drivers do."""
        now_s = time.monotonic()
        if now_s >= self._next_joints_s:
            self._next_joints_s = max(self._next_joints_s + 1 / JOINT_HZ, now_s)
            self._state.header = make_header(time.time_ns())
            self._joints.publish(self._state)
        if now_s >= self._next_s:
            self._next_s += self._period_s
            if self._next_s < now_s:
                self._next_s = now_s
                self.num_late += 1
            stamp_ns = time.time_ns()
            for publisher, data in self._outputs:
                publisher.publish(with_stamp(data, stamp_ns))


def _info(camera: Any, width: int, height: int, header: Any) -> CameraInfo:
    scale = np.diag([width / camera.width, height / camera.height, 1.0])
    K = scale @ camera.K
    return CameraInfo(
        header=header,
        width=width,
        height=height,
        distortion_model='plumb_bob',
        d=[0.0] * 5,
        k=K.ravel(),
        r=np.eye(3).ravel(),
        p=np.column_stack([K, np.zeros(3)]).ravel(),
    )


class Policy:
    """Sends plans and keeps when each got its verdict.

    Args:
        node: owner of publisher and subscriptions.
        recording: its commands are the plan.
    """

    def __init__(self, node: Node, recording: Recording) -> None:
        self._plans = node.create_publisher(JointTrajectoryMsg, '/joint_trajectory', 10)
        node.create_subscription(DiagnosticArray, '/world_model/report', self._on_report, 100)
        node.create_subscription(DiagnosticArray, '/diagnostics', self._on_state, 10)
        commands = recording.commands
        kept = (commands.times > 0) & (commands.times <= PLAN_S)
        self._plan = JointTrajectory(
            joint_names=commands.joint_names,
            times=commands.times[kept],
            positions=commands.positions[kept],
        )
        self.sent: dict[int, float] = {}
        self.verdicts: dict[int, float] = {}
        self.ends: dict[int, str] = {}
        self.state: dict[str, str] = {}
        self.ages: list[float] = []

    def send(self) -> None:
        """Send a plan of its own stamp."""
        stamp_ns = time.time_ns()
        self.sent[stamp_ns] = time.monotonic()
        self._plans.publish(to_trajectory_message(self._plan, make_header(stamp_ns)))

    def forget(self) -> None:
        """Begin anew: what was sent so far does not count."""
        for kept in (self.sent, self.verdicts, self.ends, self.ages):
            kept.clear()

    def _on_report(self, message: DiagnosticArray) -> None:
        now_s = time.monotonic()
        for values in map(values_of, message.status):
            stamp_ns = int(values.get('trajectory_stamp_ns', 0))
            if stamp_ns not in self.sent:
                continue
            if values['state'] == 'chunk':
                self.verdicts.setdefault(stamp_ns, now_s - self.sent[stamp_ns])
            elif values['state'] in ENDS:
                self.ends[stamp_ns] = values.get('reason', '') or values['state']

    def _on_state(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.state = values_of(status)
            ages = [v for key, v in self.state.items() if key.startswith('image_age_s.')]
            self.ages += [float(age) for age in ages if age != 'nan']


def connect(policy: Policy, cameras: Sequence[str], spin: Any) -> None:
    """Play until the node is connected to everything that it uses."""
    end_s = time.monotonic() + START_S
    needed = [*cameras, '/joint_trajectory']
    while not all(policy.state.get(f'publishers.{t}', '0') != '0' for t in needed):
        if time.monotonic() > end_s:
            raise TimeoutError(f'the node is not connected after {START_S:g} s: {policy.state}')
        spin(0.05)


def play(options: argparse.Namespace, process: subprocess.Popen[Any]) -> dict[str, Any]:
    """Play to the node; return what became of the plans."""
    pipeline = load_named_pipeline(Settings())
    recording = load_recording(EPISODE, pipeline.spec, pipeline.robot)
    rclpy.init()
    node = rclpy.create_node('client')
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    cameras = None if options.apart else Cameras(node, recording, options)
    policy = Policy(node, recording)

    def spin(seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            if cameras is not None:
                cameras.publish_due()
            executor.spin_once(timeout_sec=0.002)

    connect(policy, [f'/{camera.view}/camera_info' for camera in recording.cameras], spin)
    for _ in range(NUM_WARM_UP):
        policy.send()
        spin(PLAN_S / 2)
    policy.forget()
    begun_s, cpu = time.monotonic(), cpu_s(process.pid)
    for number in range(options.plans):
        spin(max(begun_s + number / options.rate - time.monotonic(), 0.0))
        policy.send()
    end_s = time.monotonic() + PATIENCE_S
    while len(policy.ends) < len(policy.sent) and time.monotonic() < end_s:
        spin(0.05)
    share = (cpu_s(process.pid) - cpu) / (time.monotonic() - begun_s)
    node.destroy_node()
    rclpy.shutdown()
    return row(policy, options, share)


def cpu_s(pid: int) -> float:
    """CPU time that a process has used [s], all threads."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def row(policy: Policy, options: argparse.Namespace, cpu_share: float) -> dict[str, Any]:
    """What became of the plans."""
    seconds = np.array(sorted(policy.verdicts.values()))
    in_time = int((seconds <= options.limit).sum())
    return {
        'size': 'x'.join(map(str, options.size)) + (' compressed' if options.compressed else ''),
        'cameras': options.cameras,
        'hz': options.hz,
        'transports': options.transports or 'default',
        'plans': len(policy.sent),
        'in_time': in_time,
        'verdicts': len(seconds),
        'median_s': round(float(np.median(seconds)), 3) if len(seconds) else None,
        'worst_s': round(float(seconds[-1]), 3) if len(seconds) else None,
        'ends': dict(Counter(policy.ends.values())),
        'node_cpu': round(cpu_share, 2),
        'image_age_s': round(float(np.median(policy.ages)), 3) if policy.ages else None,
        'load': round(os.getloadavg()[0], 1),
    }


def show_cameras(options: argparse.Namespace) -> None:
    """Publish cameras and joint states until the process is ended."""
    pipeline = load_named_pipeline(Settings())
    recording = load_recording(EPISODE, pipeline.spec, pipeline.robot)
    rclpy.init()
    node = rclpy.create_node('cameras')
    cameras = Cameras(node, recording, options)
    while rclpy.ok():
        cameras.publish_due()
        time.sleep(0.002)


def view(options: argparse.Namespace) -> None:
    """Read the camera that the model does not use, as a viewer does."""
    rclpy.init()
    node = rclpy.create_node('viewer')
    kind, suffix = (CompressedImage, '/compressed') if options.compressed else (Image, '')
    profile = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    topic = f'/{OTHER_VIEW}/image_raw{suffix}'
    node.create_subscription(kind, topic, lambda _: None, profile, raw=True)
    rclpy.spin(node)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition('x')
    return int(width), int(height)


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').splitlines()[0])
    add = parser.add_argument
    add('--plans', type=int, default=50)
    add('--rate', type=float, default=1.0, help='plans a second')
    add('--size', type=_size, default=(384, 288), help='of the images, e.g. 640x480')
    add('--cameras', type=int, choices=(2, 3), default=2)
    add('--hz', type=float, default=20.0, help='images a second of each camera')
    add('--compressed', action='store_true', help='JPEG instead of raw images')
    add('--best-effort', action='store_true', help='cameras publish best effort')
    add('--transports', default='', help="the client's FASTDDS_BUILTIN_TRANSPORTS")
    add('--apart', action='store_true', help='cameras in a process of their own')
    add('--limit', type=float, default=0.6, help='a verdict is in time within this [s]')
    add('--node', type=Path, default=ROOT, help='checkout whose node runs')
    add('--role', choices=('client', 'cameras', 'viewer'), default='client')
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Play; 1 if a plan had no verdict in time."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = parse(words)
    if options.role != 'client':
        {'cameras': show_cameras, 'viewer': view}[options.role](options)
        return 0
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ['ROS_DOMAIN_ID'] = str(claim_domain())
    environment = {**os.environ, 'PYTHONPATH': str(options.node), 'OMP_NUM_THREADS': '1'}
    if options.transports:
        os.environ['FASTDDS_BUILTIN_TRANSPORTS'] = options.transports
    command = [sys.executable, '-m', 'mtv_world_ros.ros.world_model.node', '--ros-args']
    calibration = EPISODE / 'calibration.yaml'
    for value in (
        f'calibration_file:={calibration}',
        f'compressed_input:={str(options.compressed).lower()}',
        'pace:=burst',
        'diagnostics_period_s:=0.2',
    ):
        command += ['-p', value]
    with ExitStack() as stack, tempfile.TemporaryFile('w+') as log:

        def start(
            command: list[str], environment: Mapping[str, str], folder: Path
        ) -> subprocess.Popen[Any]:
            process = subprocess.Popen(
                command, env=environment, cwd=folder, stdout=log, stderr=subprocess.STDOUT
            )
            stack.callback(process.wait)
            stack.callback(process.terminate)
            return process

        process = start(command, environment, options.node)
        roles = ['cameras'] * options.apart + ['viewer'] * (options.cameras > 2)
        for role in roles:
            start(
                [sys.executable, '-m', 'robustness.default_client', *words, '--role', role],
                os.environ,
                ROOT,
            )
        try:
            found = play(options, process)
        finally:
            log.seek(0)
            (ROOT / 'out').mkdir(exist_ok=True)
            (ROOT / 'out' / 'default_client.log').write_text(log.read())
    sys.stdout.write(json.dumps(found) + '\n')
    return int(found['in_time'] < found['plans'])


if __name__ == '__main__':
    raise SystemExit(main())
