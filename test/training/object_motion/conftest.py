import pytest

from mtv_world_ros.assembly import checkpoint_path
from mtv_world_ros.files import share_path
from mtv_world_ros.geometry.robot_file import load_robot
from mtv_world_ros.model.object_motion.predictor import load_response


@pytest.fixture(scope='session')
def robot():
    return load_robot(share_path('config', 'robots', 'yam_bimanual.yaml'))


@pytest.fixture(scope='session')
def response(robot):
    return load_response(checkpoint_path('bundled') / 'object_motion', robot)
