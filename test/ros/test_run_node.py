"""What every node of the package gets from `run`."""

import subprocess
import sys

import pytest

from mtv_world_ros.core.files import share_path

VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
NODE = f"""
import os
from rclpy.node import Node
from mtv_world_ros.ros.run_node import run

def make():
    print(os.environ['{VARIABLE}'])
    return Node('any')

run(make, ['any'], spin=lambda node: print(os.environ.get('{VARIABLE}', 'as before')))
"""


@pytest.mark.parametrize('own', [None, str(share_path('config', 'fastdds_profile.xml'))])
def test_the_middleware_repeats_soon_unless_it_is_told_otherwise(own, ros):
    environment = {name: value for name, value in ros.ENVIRONMENT.items() if name != VARIABLE}
    if own:
        environment[VARIABLE] = own
    done = subprocess.run(
        [sys.executable, '-c', NODE], env=environment, capture_output=True, text=True, timeout=180
    )
    assert done.returncode == 0, done.stderr
    inside, after = done.stdout.split('\n')[:2]
    assert inside == (own or str(share_path('config', 'fastdds_heartbeat.xml')))
    assert after == (own or 'as before')  # for processes that the node starts
    assert 'XMLPARSER' not in done.stdout + done.stderr  # Fast DDS understood the file


ENDED_IN_AN_EVENT = """
import os
from pathlib import Path
import signal
import sys
import time

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from std_msgs.msg import String

from mtv_world_ros.ros.run_node import run


class Ended(Node):
    def __init__(self):
        super().__init__('ended')
        events = SubscriptionEventCallbacks(matched=self.end)
        self.create_subscription(String, 'words', print, 10, event_callbacks=events)
        self.create_publisher(String, 'words', 10)

    def end(self, event):
        os.kill(os.getpid(), signal.SIGTERM)
        while self.context.ok():
            time.sleep(0.001)


status = run(Ended, ['ended'])
print(*sorted(p.read_text().strip() for p in Path('/proc/self/task').glob('*/comm')))
sys.exit(status)
"""


@pytest.mark.skipif(not sys.platform.startswith('linux'), reason='threads are listed by Linux')
def test_no_thread_of_the_middleware_is_left_whatever_callback_a_signal_meets(ros):
    """The process ends after `run`: what receives then uses what the end takes away."""
    done = subprocess.run(
        [sys.executable, '-c', ENDED_IN_AN_EVENT],
        env=ros.ENVIRONMENT, capture_output=True, text=True, timeout=180,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    names = [name for name in done.stdout.split() if name.startswith('dds.')]
    # it looks after shared memory and belongs to no participant
    assert names in ([], ['dds.shm.wdog']), done.stdout
