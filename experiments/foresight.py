"""How long before a plan's end is its verdict known?

    python experiments/foresight.py [--seconds 10] [--old] [--out experiments/results]

The real node with the bundled checkpoint runs in a process of its own. This process plays the
robot of the bundled episode (images, camera infos, joint states at 10 Hz) and its policy, which
sends the commands of the next 3.2 s at a fixed rate; in the last line plans of 9.6 s from a scene
that stands still. A line is one version, one pace and one rate. With `--old` the node of the tag
v0.1.0 runs beside, line by line in turns, so that both meet the same load.
"""

from __future__ import annotations

import argparse
from collections import Counter
from contextlib import nullcontext
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
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import String

from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.ros.messages.conversions import (
    make_header,
    to_joint_state,
    to_trajectory_message,
    values_of,
)
from mtv_world_ros.ros.messages.image_messages import to_image
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.world_model.loading import load_named_pipeline

EPISODE = share_path('resource', 'demo_episode')
PLAN_S, LONG_S, SCENE_HZ = 3.2, 9.6, 10.0
#: plans a second, and how long they are [s]
LINES = ((0.25, PLAN_S), (1.0, PLAN_S), (5.0, PLAN_S), (1.0, LONG_S))
PACES = ('realtime', 'burst')
#: environment variables by which a process gets Fast DDS settings
FAST_DDS_SETTINGS = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_BUILTIN_TRANSPORTS')
ENDS = ('done', 'preempted', 'rejected', 'failed', 'reset')


class Robot:
    """Publishes the episode over and over and keeps what the node says of it."""

    def __init__(self, node: Node, recording: Recording, executor: SingleThreadedExecutor) -> None:
        self._recording, self._executor = recording, executor
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
        """Wait for the node and tell it the instruction."""
        keys = [f'publishers.{topic}' for topic in self._publishers]
        while not all(self.state.get(key, '0') != '0' for key in keys):
            self._executor.spin_once(timeout_sec=0.05)
        self._publishers['/instruction'].publish(String(data=self._recording.instruction))

    def live(self, seconds: float, rate: float, plan_s: float = PLAN_S) -> None:
        """Play for a while and send plans at a rate; end when all plans have ended.

        Long plans begin in the first frame, which is shown all the time.
        """
        self.reports.clear()
        loop_s = self._loop_s if plan_s == PLAN_S else 1e-9
        begin_s = next_scene_s = next_plan_s = time.monotonic()
        num_plans = 0
        while (now_s := time.monotonic()) < begin_s + seconds:
            if now_s >= next_scene_s:
                next_scene_s += 1 / SCENE_HZ
                stamp_ns = self._show((now_s - begin_s) % loop_s)
                if now_s >= next_plan_s:
                    next_plan_s += 1 / rate
                    num_plans += 1
                    plan = self._plan((now_s - begin_s) % loop_s, plan_s)
                    message = to_trajectory_message(plan, make_header(stamp_ns))
                    self._publishers['/joint_trajectory'].publish(message)
            self._executor.spin_once(timeout_sec=0.005)
        end_s = time.monotonic() + 60
        while self._count(ENDS) < num_plans and time.monotonic() < end_s:
            self._executor.spin_once(timeout_sec=0.05)
        while self._count(('published',)) < self._count(('chunk',)) and time.monotonic() < end_s:
            self._executor.spin_once(timeout_sec=0.05)

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

    def _plan(self, at_s: float, plan_s: float = PLAN_S) -> JointTrajectory:
        commands = self._recording.commands
        kept = (commands.times > at_s + 1e-6) & (commands.times <= at_s + plan_s)
        return JointTrajectory(
            joint_names=commands.joint_names,
            times=commands.times[kept] - at_s,
            positions=commands.positions[kept],
        )


def row(
    reports: list[dict[str, str]], head: list[str], plan_s: float, node_cpu_s: float
) -> list[str]:
    """One line of the table."""
    chunks = {r['rollout']: r for r in reports if r['state'] == 'chunk'}
    foreseen = {r['rollout']: r for r in reports if r['state'] == 'foreseen'}
    sent = {r['rollout']: r for r in reports if r['state'] == 'published'}
    ends = Counter(r['state'] for r in reports if r['state'] in ENDS)

    def median(key: str, source: dict[str, dict[str, str]]) -> str:
        values = [float(r[key]) for r in source.values() if key in r]
        return f'{np.median(values):.2f}' if values else '–'

    leads = [float(r['lead_s']) for r in chunks.values()]
    early = sum(lead > plan_s / 2 for lead in leads)
    computed = sum(int(r.get('num_chunks', 0)) > 0 for r in reports if r['state'] in ENDS)
    return [
        *head,
        str(sum(ends.values())),
        ', '.join(f'{number} {state}' for state, number in ends.items()),
        str(computed),
        str(len(chunks)),
        str(len(foreseen.keys() | chunks.keys())),
        median('latency_s', foreseen),
        median('latency_s', chunks),
        median('lead_s', chunks),
        f'{min(leads):.2f}' if leads else '–',
        f'{early} of {len(leads)}',
        f'{node_cpu_s / len(chunks):.2f}' if chunks else '–',
        median('first_frame_s', sent),
        median('frame_lead_s', sent),
    ]


class Played:
    """A node, and the robot that is played to it.

    Args:
        recording: of the robot.
        pace: of the node's pictures.
        name: of its ROS node.
        old: a checkout of another version whose node runs; None = this one.
    """

    def __init__(self, recording: Recording, pace: str, name: str, old: Path | None) -> None:
        command = [sys.executable, '-m', 'mtv_world_ros.ros.world_model.node', '--ros-args']
        calibration = EPISODE / 'calibration.yaml'
        for value in (f'pace:={pace}', f'calibration_file:={calibration}', 'max_image_age_s:=2.0'):
            command += ['-p', value]
        # in a domain of its own, as both of two versions are called world_model
        domain = 1 + (os.getpid() + len(name)) % 100
        env = os.environ | {'ROS_DOMAIN_ID': str(domain)}
        if old is not None:
            env['PYTHONPATH'] = str(old)
        self._context = rclpy.Context()
        self._context.init(domain_id=domain)
        self.process = subprocess.Popen(command, env=env, cwd=old)
        self._node = rclpy.create_node(name, context=self._context)
        executor = SingleThreadedExecutor(context=self._context)
        executor.add_node(self._node)
        self.robot = Robot(self._node, recording, executor)

    def warm_up(self) -> None:
        """Wait for the node, and let it imagine a few plans: the first ones take longer."""
        self.robot.connect()
        self.robot.live(2 * PLAN_S, 1 / PLAN_S)

    def line(self, seconds: float, head: list[str], rate: float, plan_s: float) -> list[str]:
        """Return a line of the table."""
        before_s = page.cpu_s(self.process.pid)
        self.robot.live(seconds, rate, plan_s)
        head = [*head, f'{rate:g}', f'{plan_s:g}', f'{os.getloadavg()[0]:.1f}']
        spent_s = page.cpu_s(self.process.pid) - before_s
        return row(self.robot.reports, head, plan_s, spent_s)

    def close(self) -> None:
        """End the node."""
        self._node.destroy_node()
        self.process.terminate()
        self.process.wait()
        self._context.try_shutdown()


def measure(options: argparse.Namespace, old: Path | None) -> list[list[str]]:
    """The table."""
    pipeline = load_named_pipeline(Settings())
    recording = load_recording(EPISODE, pipeline.spec, pipeline.robot)
    rows = []
    for pace in options.paces:
        played = {'this': Played(recording, pace, 'robot', None)}
        if old is not None:
            played[page.OLD_TAG] = Played(recording, pace, 'old_robot', old)
        try:
            for one in played.values():
                one.warm_up()
            for rate, plan_s in LINES:
                for version, one in played.items():
                    rows.append(one.line(options.seconds, [version, pace], rate, plan_s))
                    print(*rows[-1], sep=' | ', flush=True)
        finally:
            for one in played.values():
                one.close()
    return rows


def more(parser: argparse.ArgumentParser) -> None:
    """Add options."""
    parser.add_argument('--seconds', type=float, default=10.0, help='of each line')
    parser.add_argument('--paces', nargs='+', choices=PACES, default=PACES)
    parser.add_argument('--old', action='store_true', help=f'{page.OLD_TAG} beside it, in turns')


def main() -> int:
    """Measure and print the page."""
    options = page.parse_arguments(
        __doc__,
        repeats=1,
        more=more,
    )
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    for name in FAST_DDS_SETTINGS:  # the client is an ordinary one
        os.environ.pop(name, None)
    with page.old_checkout() if options.old else nullcontext() as old:
        rows = measure(options, old)
    header = ['version', 'pace', 'plans a second', 'of [s]', 'load', 'plans', 'ended',
              'with a chunk', 'with a final verdict', 'with a verdict',
              'plan to first verdict [s]', 'plan to final verdict [s]', 'lead [s]',
              'least lead [s]', 'in the first half',
              'CPU a chunk [s]', 'plan to first frame [s]', 'frames ahead [s]']  # fmt: skip
    body = (
        f'Plans on the bundled episode, {options.seconds:g} s a line, as the '
        'node reports them; medians. The first verdict is that of the futures (`foreseen`), the '
        'final one has the imagined frames, too. Lead: time from the final verdict to the end of '
        'what it judges. '
        'In the first half: verdicts that were there before half of the plan was over. CPU a '
        'chunk: CPU time of the whole node (all threads, images taken in, real frames looked at, '
        'rollouts pre-empted) for each chunk computed. Frames ahead: time from publishing an '
        'image to its stamp.\n\n'
        + page.table(header, rows)
        + f'\n\nLoad: mean over the last minute at the end of a line, other work and this '
        f'script included, on {os.cpu_count()} cores.'
    )
    versions = 'rclpy over Fast DDS (ros-rclpy 7.1.6 wheels)'
    command = f'python experiments/{Path(__file__).name}'
    page.publish('foresight', 'Verdicts before the motion', command, body, options, versions)
    return 0


if __name__ == '__main__':
    sys.exit(main())
