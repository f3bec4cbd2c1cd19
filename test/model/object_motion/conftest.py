import os
import time

import pytest

from mtv_world_ros.model.object_motion.helpers import Helpers


@pytest.fixture
def helpers():
    """One process beside this one, which is ready."""
    found, who = Helpers(1), ['__import__("os").getpid()'] * 2
    deadline = time.monotonic() + 60
    while set(found.map(eval, who)) == {os.getpid()}:
        assert time.monotonic() < deadline, 'no helper came'
        time.sleep(0.05)
    return found
