"""A client of running nodes, and what tests need to start them."""

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed (pip install .[ros])')

from test.support import ros_nodes


@pytest.fixture(scope='session', autouse=True)
def ros_home(tmp_path_factory):
    """A folder of the tests' own for what nodes keep of robot cells."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp('ros_home')
        patch.setenv('ROS_HOME', str(folder))
        yield folder


@pytest.fixture(scope='module')
def client():
    client = ros_nodes.Client()
    yield client
    client.close()


@pytest.fixture(scope='module')
def ros():
    """The module `test.support.ros_nodes`."""
    return ros_nodes
