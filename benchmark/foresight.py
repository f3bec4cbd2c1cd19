"""How long before a plan's end is its verdict known?

    python benchmark/foresight.py [--seconds 19] [--out benchmark/results]

The real node with the bundled checkpoint runs in a process of its own. This process plays the
robot of the bundled episode (images, camera infos, joint states at 10 Hz) and its policy, which
sends the commands of the next 3.2 s at a fixed rate. A line is one pace and one rate.
"""

from __future__ import annotations

import argparse
from collections import Counter
import os
from pathlib import Path
import subprocess
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import page
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import String

from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.data_types import JointTrajectory
from mtv_world_ros.files import share_path
from mtv_world_ros.ros.messages.conversions import (
    to_joint_state,
    to_trajectory_message,
    values_of,
)
from mtv_world_ros.ros.messages.image_messages import to_image
from mtv_world_ros.ros.messages.stamps import make_header
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.world_model.loading import load_named_pipeline

EPISODE = share_path('resource', 'demo_episode')
PLAN_S, SCENE_HZ = 3.2, 10.0
PACES, RATES = ('realtime', 'burst'), (0.25, 1.0, 5.0)
ENDS = ('done', 'preempted', 'rejected', 'failed', 'reset')


class Robot:
    """Publishes the episode over and over and keeps what the node says of it."""

    def __init__(self, node: Node, recording: Recording) -> None:
        self._node, self._recording = node, recording
        self.reports: list[dict[str, str]] = []
        self.state: dict[str, str] = {}
        kinds: dict[str, Any] = {'/joint_states': JointState, '/instruction': String}
        for camera in recording.cameras:
            kinds[f'/{camera.view}/image_raw'] = Image
            kinds[f'/{camera.view}/camera_info'] = CameraInfo
            topic = f'/world_model/{camera.view}/predicted/image_raw'
            node.create_subscription(Image, topic, lambda _: None, QoSProfile(depth=50))
        kinds['/joint_trajectory'] = type(to_trajectory_message(self._plan(0.0), make_header(0)))
        self._publishers = {t: node.create_publisher(k, t, 10) for t, k in kinds.items()}
        node.create_subscription(DiagnosticArray, '/world_model/report', self._on_report, 1000)
        node.create_subscription(DiagnosticArray, '/diagnostics', self._on_state, 10)

    def _on_report(self, message: DiagnosticArray) -> None:
        self.reports += [values_of(status) for status in message.status]

    def _on_state(self, message: DiagnosticArray) -> None:
        self.state = values_of(next(iter(message.status)))

    def connect(self) -> None:
        """Waits for the node and tells it the instruction."""
        keys = [f'publishers.{topic}' for topic in self._publishers]
        while not all(self.state.get(key, '0') != '0' for key in keys):
            rclpy.spin_once(self._node, timeout_sec=0.05)
        self._publishers['/instruction'].publish(String(data=self._recording.instruction))

    def live(self, seconds: float, rate: float) -> None:
        """Plays for a while and sends plans at a rate; ends when all plans have ended."""
        self.reports.clear()
        begin_s = next_scene_s = next_plan_s = time.monotonic()
        num_plans = 0
        while (now_s := time.monotonic()) < begin_s + seconds:
            if now_s >= next_scene_s:
                next_scene_s += 1 / SCENE_HZ
                stamp_ns = self._show((now_s - begin_s) % self._loop_s)
                if now_s >= next_plan_s:
                    next_plan_s += 1 / rate
                    num_plans += 1
                    plan = self._plan((now_s - begin_s) % self._loop_s)
                    message = to_trajectory_message(plan, make_header(stamp_ns))
                    self._publishers['/joint_trajectory'].publish(message)
            rclpy.spin_once(self._node, timeout_sec=0.005)
        end_s = time.monotonic() + 60
        while self._count(ENDS) < num_plans and time.monotonic() < end_s:
            rclpy.spin_once(self._node, timeout_sec=0.05)
        while self._count(('published',)) < self._count(('chunk',)) and time.monotonic() < end_s:
            rclpy.spin_once(self._node, timeout_sec=0.05)

    def _count(self, states: tuple[str, ...]) -> int:
        return sum(report['state'] in states for report in self.reports)

    @property
    def _loop_s(self) -> float:
        return float(self._recording.times[-1]) - PLAN_S

    def _show(self, at_s: float) -> int:
        recording, stamp_ns = self._recording, time.time_ns()
        frame = int(np.searchsorted(recording.times, at_s))
        for view, camera in enumerate(recording.cameras):
            header = make_header(stamp_ns, f'{camera.view}_optical_frame')
            info = CameraInfo(header=header, width=camera.width, height=camera.height)
            info.distortion_model, info.d, info.k = 'plumb_bob', [0.0] * 5, camera.K.ravel()
            info.p = np.column_stack([camera.K, np.zeros(3)]).ravel()
            self._publishers[f'/{camera.view}/camera_info'].publish(info)
            image = to_image(recording.frames[view, frame], header)
            self._publishers[f'/{camera.view}/image_raw'].publish(image)
        names = recording.commands.joint_names
        state = to_joint_state(names, recording.positions[frame], make_header(stamp_ns))
        self._publishers['/joint_states'].publish(state)
        return stamp_ns

    def _plan(self, at_s: float) -> JointTrajectory:
        commands = self._recording.commands
        kept = (commands.times > at_s + 1e-6) & (commands.times <= at_s + PLAN_S)
        return JointTrajectory(
            joint_names=commands.joint_names,
            times=commands.times[kept] - at_s,
            positions=commands.positions[kept],
        )


def row(reports: list[dict[str, str]], pace: str, rate: float, node_cpu_s: float) -> list[str]:
    """One line of the table."""
    chunks = {r['rollout']: r for r in reports if r['state'] == 'chunk'}
    sent = {r['rollout']: r for r in reports if r['state'] == 'published'}
    ends = Counter(r['state'] for r in reports if r['state'] in ENDS)

    def median(key: str, source: dict[str, dict[str, str]]) -> str:
        values = [float(r[key]) for r in source.values() if key in r]
        return f'{np.median(values):.2f}' if values else '–'

    leads = [float(r['lead_s']) for r in chunks.values()]
    early = sum(lead > PLAN_S / 2 for lead in leads)
    computed = sum(int(r.get('num_chunks', 0)) > 0 for r in reports if r['state'] in ENDS)
    return [
        pace,
        f'{rate:g}',
        str(sum(ends.values())),
        ', '.join(f'{number} {state}' for state, number in ends.items()),
        str(computed),
        str(len(chunks)),
        median('latency_s', chunks),
        median('lead_s', chunks),
        f'{min(leads):.2f}' if leads else '–',
        f'{early} of {len(leads)}',
        f'{node_cpu_s / len(chunks):.2f}' if chunks else '–',
        median('first_frame_s', sent),
        median('frame_lead_s', sent),
    ]


def measure(options: argparse.Namespace) -> list[list[str]]:
    """The table."""
    spec = load_named_pipeline(Settings()).spec
    recording = load_recording(EPISODE, spec, load_named_pipeline(Settings()).robot)
    rows = []
    for pace in PACES:
        command = [sys.executable, '-m', 'mtv_world_ros.ros.world_model.node', '--ros-args']
        calibration = EPISODE / 'calibration.yaml'
        for value in (f'pace:={pace}', f'calibration_file:={calibration}', 'max_image_age_s:=2.0'):
            command += ['-p', value]
        process = subprocess.Popen(command)
        node = rclpy.create_node('robot')
        try:
            robot = Robot(node, recording)
            robot.connect()
            robot.live(2 * PLAN_S, 1 / PLAN_S)  # the first ones take longer
            for rate in RATES:
                before_s = page.cpu_s(process.pid)
                robot.live(options.seconds, rate)
                rows.append(row(robot.reports, pace, rate, page.cpu_s(process.pid) - before_s))
                print(*rows[-1], sep=' | ', flush=True)
        finally:
            node.destroy_node()
            process.terminate()
            process.wait()
    return rows


def add_seconds(parser: argparse.ArgumentParser) -> None:
    """Adds the option."""
    parser.add_argument('--seconds', type=float, default=19.0)


def main() -> int:
    """Measures and prints the page."""
    options = page.parse_arguments(
        __doc__,
        repeats=1,
        more=add_seconds,
    )
    os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    rclpy.init()
    rows = measure(options)
    header = ['pace', 'plans a second', 'plans', 'ended', 'with a chunk', 'with a verdict',
              'plan to verdict [s]', 'lead [s]', 'least lead [s]', 'in the first half',
              'CPU a chunk [s]', 'plan to first frame [s]', 'frames ahead [s]']  # fmt: skip
    load = os.getloadavg()
    body = (
        f'Plans of {PLAN_S:g} s on the bundled episode, {options.seconds:g} s a line, as the '
        'node reports them; medians. Lead: time from the verdict to the end of what it judges. '
        'In the first half: verdicts that were there before half of the plan was over. CPU a '
        'chunk: CPU time of the whole node (all threads, images taken in, real frames looked at, '
        'rollouts pre-empted) for each chunk computed. Frames ahead: time from publishing an '
        'image to its stamp.\n\n'
        + page.table(header, rows)
        + f'\n\nLoad of the machine meanwhile (other work included): {load[1]:.1f} on '
        f'{os.cpu_count()} cores.'
    )
    rclpy.try_shutdown()
    versions = 'rclpy over Fast DDS (ros-rclpy 7.1.6 wheels)'
    command = f'python benchmark/{Path(__file__).name}'
    page.publish('foresight', 'Verdicts before the motion', command, body, options, versions)
    return 0


if __name__ == '__main__':
    sys.exit(main())
