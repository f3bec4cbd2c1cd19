"""A node that loads says so, and answers the last plan that came meanwhile."""

import threading

import pytest

from mtv_world_ros.ros.world_model import loading_watch
from mtv_world_ros.ros.world_model.loading_watch import WaitingLog
from test.support.fake_world_model import load as load_fake


@pytest.fixture
def client(ros):
    client = ros.Client()
    yield client
    client.close()


def test_a_plan_that_comes_while_the_node_loads_is_answered_once(
    tmp_path, ros, client, monkeypatch
):
    monkeypatch.setattr(loading_watch, 'SAY_EVERY_S', 0.2)
    loading, may_go_on = threading.Event(), threading.Event()

    def load(settings):
        loading.set()
        assert may_go_on.wait(60)
        return load_fake(settings)

    made = []
    thread = threading.Thread(
        target=lambda: made.append(ros.start_node(tmp_path, 'pace:=burst', load=load))
    )
    thread.start()
    try:
        assert loading.wait(60)
        client.connect_inputs({'/joint_trajectory': ros.INPUTS['/joint_trajectory']})
        client.send_trajectory()

        def says_so():
            found = [s for s in client.statuses('/diagnostics') if s.name == 'world_model']
            return bool(found) and 'loading' in found[-1].message

        client.wait(says_so, 'diagnostics of a node that loads')
    finally:
        may_go_on.set()
        thread.join()
    try:
        topics = {name: kind for name, kind in ros.INPUTS.items() if name != '/joint_trajectory'}
        client.connect_inputs(topics)
        for _ in range(20):  # a plan waits a second for the first images
            client.send_scene()
            client.spin_for(0.05)
        client.wait_for_ends(1, 0)
        client.spin_for(0.5)
        assert len([v for v in client.report_values() if v['state'] in ros.ENDS]) == 1
        assert "loading '" in made[0].output() and 'the last plan is kept' in made[0].output()
    finally:
        assert made[0].stop() == 0, made[0].output()


class Logger:
    def __init__(self):
        self.lines = []

    def info(self, line):
        self.lines.append(line)


def test_what_a_node_waits_for_is_said_at_once_again_and_when_it_is_lost(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(loading_watch.time, 'monotonic', lambda: now[0])
    logger = Logger()
    waits = WaitingLog(logger)

    def at(seconds, missing, has_begun=False):
        now[0] = seconds
        before = len(logger.lines)
        waits.update(missing, has_begun)
        return logger.lines[before:]

    assert at(0, ['no images', 'no joints']) == ['waits for: no images; no joints']
    assert at(1, ['no images', 'no joints']) == []
    assert at(5, ['no joints']) == ['waits for: no joints']
    assert at(6, []) == []
    assert at(20, ['images are 3.0 s old'], True) == ['waits for: images are 3.0 s old']
    assert at(30, ['images are 13.0 s old'], True) == []
