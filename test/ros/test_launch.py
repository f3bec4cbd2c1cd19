"""The launch files, read by the real `ros2 launch`."""

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
