"""Nodes in the process of a test or in their own, and a client that talks to them."""

from collections import Counter, defaultdict
from contextlib import suppress
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rcl_interfaces.srv import GetParameters, SetParameters
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState
from std_msgs.msg import Header, String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from mtv_world_ros.cameras.calibration_file import save_calibration
from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.files import share_path
from mtv_world_ros.ros.messages.conversions import (
    NANO,
    to_stamp,
    values_of,
)
from mtv_world_ros.ros.messages.image_messages import to_compressed, to_image
from mtv_world_ros.ros.policy.node import PolicyNode
from mtv_world_ros.ros.world_model.node import main, WorldModelNode
from test.support.fake_policy import load as load_fake_policy
from test.support.fake_world_model import load as load_fake
from test.support.in_process import NodeInProcess, PATIENCE_S, run_to_end
from test.support.ros_domain import claim_domain

os.environ['ROS_DOMAIN_ID'] = str(claim_domain())
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(share_path('config', 'fastdds_heartbeat.xml'))

PACKAGES = filter(
    None,
    (
        str(Path(__file__).parents[2]),
        os.environ.get('PYTHONPATH'),
        str(Path(sys.prefix) / 'interfaces'),
    ),
)
ENVIRONMENT = {
    **os.environ,
    'PYTHONPATH': os.pathsep.join(PACKAGES),
    'OMP_NUM_THREADS': '1',
    'PYTHONFAULTHANDLER': '1',  # a crash says where, in the node's output
}
FAKE = Path(__file__).with_name('fake_world_model.py')
FAKE_POLICY = Path(__file__).with_name('fake_policy.py')
VIEWS = ('low', 'high')
JOINTS = tuple(
    f'{arm}_{joint}'
    for arm in ('left', 'right')
    for joint in (*(f'joint{n}' for n in range(1, 7)), 'gripper')
)
HOME = np.array([0.0, 1.047, 1.047, 0.0, 0.0, 0.0, 0.03] * 2)
SIZE = (96, 72)
ENDS = ('done', 'preempted', 'rejected', 'failed', 'reset')
NUM_FRAMES = 4
CHUNK_S = 0.8
ASK_AGAIN_S = 3.0
#: an answer that has not come after this time is lost [s]
ANSWER_LOST_S = 10.0
#: a client or reader that nothing matches in this time is made anew, in a participant that
#: discovers everything again: what discovery has lost once, a participant never learns [s]
MATCH_AGAIN_S = 12.0
#: messages that subscriptions of tests keep: chunks are published in bursts, while a busy machine
#: takes long to take them
KEPT = 100
TIMEOUT_S = 120.0  # a busy machine takes long to start a node


def make_calibration(path):
    """Two cameras that look at the table from the front and from above."""
    looks = {'low': ((0, 1.1, 0.6), 30.0), 'high': ((0, 0.9, 1.2), 55.0)}
    cameras = {}
    for view, (position, down) in looks.items():
        a = np.radians(down)
        T = np.eye(4)
        T[:3, :3] = np.array(
            [[-1, 0, 0], [0, -np.sin(a), -np.cos(a)], [0, -np.cos(a), np.sin(a)]]
        ).T @ np.diag([1.0, 1.0, 1.0])
        x, z = np.array([-1.0, 0, 0]), np.array([0, -np.cos(a), -np.sin(a)])
        T[:3, :3] = np.column_stack([x, np.cross(z, x), z])
        T[:3, 3] = position
        cameras[view] = CameraModel(
            view=view,
            width=SIZE[0],
            height=SIZE[1],
            K=np.array([[90.0, 0, 47.5], [0, 90.0, 35.5], [0, 0, 1]]),
            mount_link='base',
            T_mount_camera=T,
        )
    save_calibration(path, cameras)
    return path


class Participant(NamedTuple):
    """A node that DDS knows as a participant of its own."""

    context: rclpy.Context
    node: Node
    executor: SingleThreadedExecutor


def _new_participant(name):
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node(name, context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    return Participant(context, node, executor)


class Client:
    """Plays cameras, arms and policy, and keeps what the node publishes."""

    def __init__(self, *, sim_time=False):
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node(
            'client',
            context=self.context,
            parameter_overrides=[Parameter('use_sim_time', value=sim_time)],
        )
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.callers = [Participant(self.context, self.node, self.executor)]
        self.received, self.totals = defaultdict(list), Counter()
        self.publishers, self.services, self.subscriptions = {}, {}, {}
        self.gone = set()
        self.subscribe(DiagnosticArray, '/world_model/report', 100)
        self.subscribe(DiagnosticArray, '/diagnostics', 10)

    def close(self):
        for caller in self.callers:
            caller.executor.shutdown()
            caller.node.destroy_node()
            rclpy.shutdown(context=caller.context)

    def forget_node(self):
        """The node was killed: the graph shows it for 20 s more, and it answers nothing."""
        for publisher in self.publishers.values():
            infos = self.node.get_subscriptions_info_by_topic(publisher.topic_name)
            self.gone |= {bytes(info.endpoint_gid) for info in infos}
            self.node.destroy_publisher(publisher)
        for name in tuple(self.services):
            self._destroy_client(name)
        for kept in (self.publishers, self.services, self.received):
            kept.clear()

    def subscribe(
        self,
        kind,
        topic,
        depth=KEPT,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE,
        node=None,
    ):
        def keep(message):
            self.received[topic].append(message)
            self.totals[topic] += 1

        profile = QoSProfile(depth=depth, reliability=reliability, durability=durability)
        if topic in self.subscriptions:  # of an earlier test: each message would come twice
            for caller in self.callers:  # of another node's subscription, it does nothing
                caller.node.destroy_subscription(self.subscriptions[topic])
        self.subscriptions[topic] = (node or self.node).create_subscription(
            kind, topic, keep, profile
        )

    def publish(self, topic, message, *, latched=False):
        """Publish reliably; the first time on a topic waits until the node is connected."""
        if topic not in self.publishers:
            self.connect_inputs({topic: type(message)}, latched=latched)
        self.publishers[topic].publish(message)

    def connect_inputs(self, topics, *, latched=False):
        """Create publishers for `{topic: type}` and wait until the node is connected."""
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        profile = QoSProfile(depth=10, durability=durability)
        for topic, kind in topics.items():
            self.publishers[topic] = self.node.create_publisher(kind, topic, profile)
        since = [time.monotonic()]

        def are_settled():
            """For a while: graph and middleware tell each other with a delay."""
            if not all(self._is_settled(topic) for topic in topics):
                since[0] = time.monotonic()
            return time.monotonic() > since[0] + 0.3

        self.wait(are_settled, f'subscribers of {list(topics)}')

    def _is_settled(self, topic):
        """The node's subscription asks for what is offered, no other is left, and it is there."""
        publisher = self.publishers[topic]
        infos = self.node.get_subscriptions_info_by_topic(publisher.topic_name)
        reliable = [i.qos_profile.reliability == ReliabilityPolicy.RELIABLE for i in infos]
        is_known = self.diagnostic_values().get(f'publishers.{topic}', '1') != '0'
        is_there = any(bytes(info.endpoint_gid) not in self.gone for info in infos)
        are_matched = publisher.get_subscription_count() == len(infos)
        return all(reliable) and is_known and is_there and are_matched

    def wait(self, condition, what='it', timeout_s=TIMEOUT_S):
        """Spin until the condition holds."""
        end = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < end, f'waited {timeout_s} s for {what}'
            self._spin_once()

    def hear(self, process, kind, topic):
        """Subscribe to a topic of a node in this process, and wait until that node knows it.

        That a participant knows a publisher does not mean that the publisher knows its reader.
        A reader that it does not know for long is made anew, in a participant that it has still to
        discover, as for a service.
        """

        def is_known():
            found = [p for p in process.node.publishers if p.topic_name == topic]
            return bool(found) and all(p.get_subscription_count() for p in found)

        self.wait(lambda: getattr(process, 'node', None), 'the node')
        end = time.monotonic() + TIMEOUT_S
        while True:
            self.subscribe(kind, topic, node=self.callers[-1].node)
            with suppress(AssertionError):
                self.wait(is_known, topic, MATCH_AGAIN_S)
                return
            assert time.monotonic() < end, f'{topic} does not know its reader'
            self._add_participant()

    def wait_until_seen(self, process, stamp_ns):
        """Wait until a node in this process has the images of a moment, of all views.

        Its subscriptions have depth 1, as for any camera: the next image would replace them.
        """
        buffer = process.node._configured._buffer
        self.wait(lambda: buffer.newest_stamp_ns == stamp_ns, 'the images in the node')

    def wait_until_told(self, process, **texts):
        """Wait until a node in this process has `instruction` or `stored_objects`."""
        maker = process.node._configured._maker
        self.wait(lambda: all(getattr(maker, key) == text for key, text in texts.items()), texts)

    def spin_for(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._spin_once()

    def _spin_once(self):
        for caller in self.callers[1:]:
            caller.executor.spin_once(timeout_sec=0)
        self.executor.spin_once(timeout_sec=0.02)

    def connect_outputs(self, topics, timeout_s=TIMEOUT_S, depth=KEPT):
        """Subscribe to `{topic: type}` and wait for their publishers."""
        for topic, kind in topics.items():
            self.subscribe(kind, topic, depth)
        for topic in topics:
            self.wait(
                lambda topic=topic: self.node.count_publishers(topic), f'a publisher of {topic}'
            )
        self.wait(lambda: all(self._is_matched(topic) for topic in topics), 'matching', timeout_s)

    def _is_matched(self, topic):
        subscriptions = [s for s in self.node.subscriptions if s.topic_name == topic]
        return all(s.get_publisher_count() for s in subscriptions)

    def _ready_client(self, kind, name):
        """A client that its service has matched; one that it does not match is made anew."""
        end = time.monotonic() + TIMEOUT_S
        while True:
            if name not in self.services:
                self.services[name] = self.callers[-1].node.create_client(kind, name)
            client = self.services[name]
            patience_s = min(MATCH_AGAIN_S, max(end - time.monotonic(), 0.1))
            try:
                self.wait(client.service_is_ready, f'service {name}', patience_s)
            except AssertionError as error:
                if time.monotonic() > end:
                    raise AssertionError(f'{error}; {self._known_ends(name)}') from error
                self._destroy_client(name)
                self._add_participant()
            else:
                return client

    def _add_participant(self):
        """What is made on the newest one is discovered from the start."""
        self.callers.append(_new_participant(f'client_{len(self.callers)}'))

    def _destroy_client(self, name):
        client = self.services.pop(name)
        for caller in self.callers:
            caller.node.destroy_client(client)  # of another node's client, it does nothing

    def _known_ends(self, name):
        """What each participant knows of a service: who reads its requests, who writes answers."""
        known = []
        for caller in self.callers:
            ends = (
                caller.node.get_subscriptions_info_by_topic(f'rq{name}Request', no_mangle=True),
                caller.node.get_publishers_info_by_topic(f'rr{name}Reply', no_mangle=True),
            )
            known.append([[info.node_name for info in infos] for infos in ends])
        return f'servers that read, and that answer, as each participant knows them: {known}'

    def call(self, kind, name, request):
        client = self._ready_client(kind, name)
        asked = []

        def is_answered():
            # a request may have gone to a node that was killed, and the answer is lost where the
            # node has not yet discovered the client's reader (rmw_fastrtps drops it)
            patience_s = ASK_AGAIN_S if self.gone else ANSWER_LOST_S
            if not asked or time.monotonic() > asked[-1][0] + patience_s:
                asked.append((time.monotonic(), client.call_async(request)))
            return any(future.done() for _, future in asked)

        self.wait(is_answered, f'an answer of {name}')
        return next(future.result() for _, future in asked if future.done())

    def reset(self):
        return self.call(Trigger, '/world_model/reset', Trigger.Request())

    def imagine(self, on):
        return self.call(SetBool, '/world_model/imagine', SetBool.Request(data=on))

    def set(self, **values):
        """Set parameters of the node; return the first refusal's reason, or ''."""
        return self.set_on('/world_model', **values)

    def set_on(self, node, **values):
        """Set parameters of a node; return the first refusal's reason, or ''."""
        parameters = [Parameter(name, value=v).to_parameter_msg() for name, v in values.items()]
        request = SetParameters.Request(parameters=parameters)
        results = self.call(SetParameters, f'{node}/set_parameters', request).results
        return next((r.reason for r in results if not r.successful), '')

    def get(self, name):
        """Return a text parameter of the node."""
        request = GetParameters.Request(names=[name])
        answer = self.call(GetParameters, '/world_model/get_parameters', request)
        return answer.values[0].string_value

    def now_ns(self):
        return self.node.get_clock().now().nanoseconds

    # what the robot's drivers publish

    def send_scene(self, stamp_ns=None, **changes):
        """Publish both images, their infos and the joint state, all stamped alike.

        `changes`: image_<view>, info_<view>, joints = a message instead, or None = not at all.
        """
        stamp_ns = self.now_ns() if stamp_ns is None else stamp_ns
        for view in VIEWS:
            self._send(f'/{view}/camera_info', changes, f'info_{view}', make_info(view, stamp_ns))
            self._send(f'/{view}/image_raw', changes, f'image_{view}', make_image(view, stamp_ns))
        self._send('/joint_states', changes, 'joints', make_joint_state(stamp_ns))
        return stamp_ns

    def _send(self, topic, changes, key, default):
        message = changes.get(key, default)
        if message is not None:
            self.publish(topic, message)

    def send_trajectory(self, message=None, **fields):
        self.publish('/joint_trajectory', message or make_trajectory(**fields))

    def send_trajectory_and_wait_until_it_runs(self):
        self.received['/diagnostics'].clear()
        self.send_trajectory()
        sent_s = time.monotonic()

        def is_busy():
            nonlocal sent_s
            if time.monotonic() > sent_s + ANSWER_LOST_S:  # sent before the readers were matched
                sent_s = time.monotonic()
                self.send_scene()
                self.send_trajectory()
            return self.diagnostic_values().get('busy') == 'true'

        self.wait(is_busy, 'the model')

    # what the node said

    def statuses(self, topic):
        return [status for array in self.received[topic] for status in array.status]

    def report_values(self, state=None):
        values = [values_of(s) for s in self.statuses('/world_model/report')]
        return [v for v in values if state is None or v['state'] == state]

    def diagnostic_values(self):
        found = [s for s in self.statuses('/diagnostics') if s.name == 'world_model']
        return values_of(found[-1]) if found else {}

    def wait_for_all(self, topics, timeout_s=TIMEOUT_S):
        """Wait until the frames of all chunks are out and here, on all topics."""

        def all_here():
            sent = self.report_values('published')
            if len(sent) < len(self.report_values('chunk')):
                return False
            total = int(sent[-1]['frames_published_total']) if sent else 0
            return all(self.totals[topic] == total for topic in topics)

        self.wait(all_here, 'frames that were reported as published', timeout_s)

    def settle(self, topics):
        """Wait until what earlier tests asked for is here; what they lost counts as received.

        A frame or a report lost on a busy machine fails the test that waits for it. Without
        this it would fail all that follow, since they count from the node's start.
        """
        try:
            self.wait_for_all(topics, ANSWER_LOST_S)
        except AssertionError as error:
            print(f'lost before this test: {error}', file=sys.stderr)
            last = self.reports_of('published')[-1:]
            # as many chunks as are published, so that the next one is awaited
            chunk = self.reports_of('chunk')[-1:] if last else []
            self.received['/world_model/report'] = chunk + last
            total = int(self.report_values()[-1]['frames_published_total']) if last else 0
            self.totals.update({topic: total - self.totals[topic] for topic in topics})

    def reports_of(self, state):
        return [
            message
            for message in self.received['/world_model/report']
            if any(values_of(status)['state'] == state for status in message.status)
        ]

    def wait_for_state(self, state, since):
        """Wait for a report of a state after the first `since` reports."""
        self.wait(lambda: any(v['state'] == state for v in self.report_values()[since:]), state)

    def next_end(self, since):
        """Wait for the next report after the first `since` that ends a rollout."""
        return self.wait_for_ends(1, since)[0]

    def wait_for_ends(self, count, since):
        """Wait until so many rollouts have ended; return the reports of that."""

        def ended():
            return [v for v in self.report_values()[since:] if v['state'] in ENDS]

        self.wait(lambda: len(ended()) >= count, f'{count} ends of rollouts')
        return ended()

    def imagine_one(self, *, scene=None, **fields):
        """Send a scene and a trajectory; return the report of how it ended."""
        since = len(self.report_values())
        if scene is None:
            self.send_scene()
        self.send_trajectory(**fields)
        return self.next_end(since)


def make_header(view, stamp_ns):
    return Header(stamp=to_stamp(stamp_ns), frame_id=f'{view}_optical_frame')


def make_pixels(view, size=SIZE):
    """A picture of a red and a blue block on grey, different for each view."""
    pixels = np.full((size[1], size[0], 3), 128, np.uint8)
    shift = 5 if view == 'low' else 15
    pixels[40:52, 20 + shift : 32 + shift] = (215, 40, 40)
    pixels[40:52, 50 + shift : 62 + shift] = (40, 70, 215)
    return pixels


def make_image(view, stamp_ns, **changes):
    message = to_image(make_pixels(view), make_header(view, stamp_ns))
    for field, value in changes.items():
        setattr(message, field, value)
    return message


def make_jpeg(view, stamp_ns):
    return to_compressed(make_pixels(view), make_header(view, stamp_ns), 95)


def make_info(view, stamp_ns=0, fx=90.0, size=SIZE):
    return CameraInfo(
        header=make_header(view, stamp_ns),
        width=size[0],
        height=size[1],
        distortion_model='plumb_bob',
        d=[0.0] * 5,
        k=[fx, 0.0, 47.5, 0.0, 90.0, 35.5, 0.0, 0.0, 1.0],
        r=[1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0],
        p=[fx, 0.0, 47.5, 0.0, 0.0, 90.0, 35.5, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def make_joint_state(stamp_ns, names=JOINTS, positions=HOME):
    return JointState(
        header=Header(stamp=to_stamp(stamp_ns)), name=list(names), position=list(positions)
    )


def make_trajectory(*, stamp_ns=0, names=JOINTS, seconds=CHUNK_S, times=None, positions=None):
    """The left arm turns by 0.2 rad in `seconds`."""
    if times is None:
        times = np.linspace(0, seconds, 5)[1:]
    if positions is None:
        positions = np.repeat(HOME[None, : len(names)], len(times), axis=0)
        positions[:, 0] += np.linspace(0, 0.2, len(times))
    message = JointTrajectory(header=Header(stamp=to_stamp(stamp_ns)), joint_names=list(names))
    for time_s, row in zip(times, positions, strict=True):
        point = JointTrajectoryPoint(positions=[float(x) for x in row])
        point.time_from_start.sec, point.time_from_start.nanosec = divmod(
            round(time_s * NANO), NANO
        )
        message.points.append(point)
    return message


class NodeProcess:
    """The node as its own process."""

    def __init__(self, command, log):
        self._log = log.open('w+')
        self.process = subprocess.Popen(
            command, stdout=self._log, stderr=subprocess.STDOUT, env=ENVIRONMENT
        )

    def stop(self, number=signal.SIGTERM):
        if self.process.poll() is None:
            self.process.send_signal(number)
        self.process.wait(timeout=PATIENCE_S)
        return self.process.returncode

    def output(self):
        self._log.seek(0)
        return self._log.read()


def start_node(folder, *parameters, remaps=(), load=load_fake, clock=None):
    """Start the node in this process, with `name:=value` parameters and remappings."""
    words = ['--ros-args', *node_options(folder, *parameters)]
    words += [part for rule in remaps for part in ('-r', rule)]

    def make(context):
        node = WorldModelNode(load, context)
        if clock is not None:
            node._clock = clock(node.get_clock())
        try:
            node.start()
        except BaseException:
            node.close()
            raise
        return node

    return NodeInProcess(make, words)


def run_node(folder, *parameters):
    """Return the exit status of a node that ends by itself, and what it said."""
    words = ['world_model', '--ros-args', *node_options(folder, *parameters)]
    return run_to_end(lambda: main(words, load_fake))


def start_node_process(folder, *parameters, program=(str(FAKE),), remaps=()):
    """Start the node in a process of its own."""
    command = [sys.executable, *program, '--ros-args', *node_options(folder, *parameters)]
    command += [part for rule in remaps for part in ('-r', rule)]
    return NodeProcess(command, folder / 'node.log')


def node_options(folder, *parameters):
    """Words for `name:=value` parameters and those that all nodes get here."""
    calibration = make_calibration(folder / 'calibration.yaml')
    values = (
        f'calibration_file:={calibration}',
        'diagnostics_period_s:=0.2',
        # this machine may be busy; tests of staleness set their own limits
        'max_image_age_s:=10.0',
        'max_joint_state_age_s:=10.0',
        *parameters,
    )
    return [part for value in values for part in ('-p', value)]


def make_checkpoint(folder):
    """A card of the fake world model's sizes, for who reads no weights."""
    card = json.loads(share_path('resource', 'checkpoint', 'world_model.json').read_text())
    folder.mkdir()
    card |= {'num_frames': NUM_FRAMES, 'width': 48, 'height': 36, 'fps': 5.0}
    (folder / 'world_model.json').write_text(json.dumps(card))
    return folder


def policy_options(folder, *parameters, remaps=()):
    values = (
        f'checkpoint:={folder / "checkpoint"}',
        f'calibration_file:={make_calibration(folder / "calibration.yaml")}',
        'diagnostics_period_s:=0.2',
        *parameters,
    )
    options = [part for value in values for part in ('-p', value)]
    return ['--ros-args', *options, *(part for rule in remaps for part in ('-r', rule))]


def start_policy(folder, *parameters, remaps=()):
    """Start the policy node in this process."""
    words = policy_options(folder, *parameters, remaps=remaps)
    return NodeInProcess(lambda context: PolicyNode(load_fake_policy, context), words)


INPUTS = {
    **{f'/{view}/image_raw': Image for view in VIEWS},
    **{f'/{view}/camera_info': CameraInfo for view in VIEWS},
    '/joint_states': JointState,
    '/joint_trajectory': JointTrajectory,
}


COMPRESSED = CompressedImage
IMAGE = Image
INFO = CameraInfo
JOINT_STATE = JointState
PLAN = JointTrajectory
STRING = String
REPORT = DiagnosticArray
TRIGGER = Trigger
LATCHED_QOS = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
