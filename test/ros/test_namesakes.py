"""Two nodes of one name say so in log and diagnostics, with the other's process and host."""

from __future__ import annotations

import os
import socket
import time

import pytest

rclpy = pytest.importorskip('rclpy')
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402

from mtv_world_ros.ros.messages.conversions import values_of  # noqa: E402
from mtv_world_ros.ros.status_publisher import StatusPublisher  # noqa: E402


class Group:
    """Nodes that publish diagnostics, and what was received of them."""

    def __init__(self, *names):
        rclpy.init(args=['x', '--ros-args', '--log-level', 'FATAL'])
        self.nodes = [
            Node(name.rpartition('/')[2], namespace=name.rpartition('/')[0]) for name in names
        ]
        self.listener = Node('listener')
        self.received = []
        self.listener.create_subscription(
            DiagnosticArray, '/diagnostics', lambda m: self.received.extend(m.status), 100
        )
        self.executor = SingleThreadedExecutor()
        for node in (*self.nodes, self.listener):
            self.executor.add_node(node)
        self.statuses = [StatusPublisher(node) for node in self.nodes]

    def spin(self, seconds=0.5):
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            self.executor.spin_once(timeout_sec=0.05)

    def publish(self):
        """Publish the diagnostics of all twice; return those of the second time."""
        for _ in range(2):
            self.received.clear()
            for status in self.statuses:
                status.publish_diagnostics({})
            end_s = time.monotonic() + 20.0
            while len(self.received) < len(self.nodes) and time.monotonic() < end_s:
                self.spin(0.1)
            self.spin()
        return self.received

    def close(self):
        for node in (*self.nodes, self.listener):
            node.destroy_node()
        rclpy.try_shutdown()


@pytest.fixture
def group():
    made = []

    def make(*names):
        made.append(Group(*names))
        made[-1].spin(1.0)
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_two_of_one_name_warn_of_each_other_with_process_and_host(group):
    said = group('/twin', '/twin').publish()
    assert [status.level for status in said] == [DiagnosticStatus.WARN] * 2
    processes = {values_of(status)['process'] for status in said}
    assert len(processes) == 2
    for status in said:
        (other,) = processes - {values_of(status)['process']}
        assert f"other nodes are named '/twin', too: process {other}; " in status.message
        assert other.startswith(f'{os.getpid()} on host {socket.gethostname()} (')


def test_other_names_and_namespaces_are_no_namesakes(group):
    said = group('/one', '/other', '/cell/one').publish()
    assert [status.message for status in said] == ['ready'] * 3


def test_one_alone_that_is_gone_is_not_warned_of(group, monkeypatch):
    nodes = group('/twin', '/twin')
    assert all('too: process' in status.message for status in nodes.publish())
    monkeypatch.setattr('mtv_world_ros.ros.namesakes._GONE_S', 0.2)
    nodes.statuses.pop()
    nodes.nodes.pop().destroy_node()
    nodes.spin(0.3)
    nodes.received.clear()
    nodes.statuses[0].publish_diagnostics({})
    end_s = time.monotonic() + 20.0
    while not nodes.received and time.monotonic() < end_s:
        nodes.spin(0.1)
    assert [status.message for status in nodes.received] == ['ready']


def test_what_another_program_says_under_this_name_is_shown_short(group):
    nodes = group('/twin')
    for at in range(100):
        value = KeyValue(key='process', value=f'{at}\x1b[31m' + 'x' * 10_000)
        status = DiagnosticStatus(name='twin', values=[value])
        nodes.statuses[0]._namesakes._take(DiagnosticArray(status=[status]))
    (said,) = nodes.publish()
    assert '\\x1b[31m' in said.message and '\x1b' not in said.message
    assert len(said.message) < 4000
