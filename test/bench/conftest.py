import pytest

from mtv_world_ros.bench.expert.expert import Expert
from mtv_world_ros.bench.world.opengl import missing_opengl
from mtv_world_ros.bench.world.workcell import workcell_of


@pytest.fixture(scope='session')
def workcell(robot):
    return workcell_of(robot)


@pytest.fixture(scope='session')
def expert(robot):
    return Expert(robot)


@pytest.fixture
def opengl():
    reason = missing_opengl()
    if reason:
        pytest.skip(reason)
