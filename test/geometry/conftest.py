from pathlib import Path

import pytest

from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.geometry.robot.model import RobotModel

ROBOTS = Path(__file__).resolve().parents[2] / 'config' / 'robots'


@pytest.fixture(scope='session')
def yam() -> RobotModel:
    return load_robot(ROBOTS / 'yam_bimanual.yaml')
