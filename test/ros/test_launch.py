"""The launch files, read by the real `ros2 launch`."""

import os
import signal
import subprocess

import pytest

from mtv_world_ros.files import share_path


@pytest.mark.native_ros
@pytest.mark.parametrize(
    ('name', 'arguments'),
    [
        ('world_model.launch.py', ('params_file', 'mode', 'calibration_file', 'large_images')),
        ('policy_in_the_loop.launch.py', ('policy', 'episodes', 'max_chunks', 'live')),
        ('replay.launch.py', ('episode', 'calibration_file', 'rate', 'pace')),
    ],
)
def test_launch_file_shows_its_arguments(name, arguments):
    command = ['ros2', 'launch', str(share_path('launch', name)), '--show-args']
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    for argument in arguments:
        assert f"'{argument}'" in shown


@pytest.fixture
def launch(tmp_path):
    """Runs `ros2 launch` on the package as colcon installed it; returns all that was said."""
    found = subprocess.run(['ros2', 'pkg', 'prefix', 'mtv_world_ros'], capture_output=True)
    if found.returncode != 0:
        pytest.skip('mtv_world_ros is not built by colcon and sourced')
    domain = str(1 + os.getpid() % 100)
    environment = {
        **os.environ, 'ROS_DOMAIN_ID': domain, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    }  # fmt: skip

    def launch(name, *arguments):
        return subprocess.Popen(
            ['ros2', 'launch', 'mtv_world_ros', name, *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=tmp_path,
            env=environment,
        )  # fmt: skip

    return launch


def check_end(process):
    """The launch ends by itself and well; returns what was said."""
    said, _ = process.communicate(timeout=600)
    assert process.returncode == 0, said
    assert 'process has died' not in said, said  # `ros2 launch` returns 0 for these too
    return said


@pytest.mark.native_ros
def test_node_starts_and_ends_on_ctrl_c(launch):
    process = launch('world_model.launch.py', 'mode:=imagine')
    for line in process.stdout:
        if 'ready: low, high' in line:
            break
    process.send_signal(signal.SIGINT)
    check_end(process)
