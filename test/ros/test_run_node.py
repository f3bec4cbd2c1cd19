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
