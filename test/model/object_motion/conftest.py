import time

import pytest

from mtv_world_ros.model.object_motion.helpers import Helpers


@pytest.fixture
def helpers():
    """One process beside this one, which is ready."""
    found = Helpers(1)
    deadline = time.monotonic() + 60
    while not found._ready:
        assert time.monotonic() < deadline, 'no helper came'
        time.sleep(0.05)
        found.start(eval)
    return found
