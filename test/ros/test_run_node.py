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
run(lambda: Node('any'), ['any'], spin=lambda node: print(os.environ['{VARIABLE}']))
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
    assert done.stdout.strip() == (own or str(share_path('config', 'fastdds_heartbeat.xml')))
    assert 'XMLPARSER' not in done.stdout + done.stderr  # Fast DDS understood the file
