"""Nodes that a test starts with parameters of its own."""

import pytest


@pytest.fixture
def start(tmp_path, ros):
    """Start the node with parameters; it must end cleanly at the test's end."""
    started = []

    def start(*parameters):
        started.append(ros.start_node(tmp_path, 'pace:=burst', *parameters))
        return started[-1]

    yield start
    for process in started:
        assert process.stop() == 0, process.output()
        assert 'Traceback' not in process.output(), process.output()
