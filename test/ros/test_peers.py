"""Services of other nodes whose answers get lost."""

import signal
import time

import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed (pip install .[ros])')

from rclpy.task import Future  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from mtv_world_ros.core.errors import ConfigError  # noqa: E402
from mtv_world_ros.ros import peers as peers_module  # noqa: E402
from mtv_world_ros.ros.bags.recorder import parse  # noqa: E402
from mtv_world_ros.ros.episodes.episode_recorder import EpisodeRecorder  # noqa: E402
from mtv_world_ros.ros.peers import Peers  # noqa: E402


class LossyClient:
    """Its server's answers to the first requests are lost."""

    srv_name = '/recorder/begin'

    def __init__(self, lost):
        self.lost, self.asked = lost, 0

    def service_is_ready(self):
        return True

    def call_async(self, request):
        self.asked += 1
        future = Future()
        if self.asked > self.lost:
            future.set_result(Trigger.Response(success=True, message='here'))
        return future


class Owner:
    """The node that asks; one node offers the service."""

    def __init__(self, client):
        self.client = client

    def create_subscription(self, *_):
        return None

    def create_client(self, *_):
        return self.client

    def count_services(self, _):
        return 1


@pytest.fixture
def soon(monkeypatch):
    monkeypatch.setattr(peers_module, '_LOST_ANSWER_S', 0.05)
    monkeypatch.setattr(peers_module, '_ANSWER_S', 0.5)


def _ask(lost):
    client = LossyClient(lost)
    peers = Peers(Owner(client), lambda: time.sleep(0.005))
    return client, lambda: peers.call(Trigger, 'recorder/begin', Trigger.Request())


@pytest.mark.parametrize('lost', [0, 1, 3])
def test_a_lost_answer_is_asked_for_again(soon, lost):
    client, ask = _ask(lost)
    assert ask().message == 'here'
    assert client.asked == lost + 1


def test_nobody_answers(soon):
    _, ask = _ask(1000)
    with pytest.raises(ConfigError, match="vain for an answer of service 'recorder/begin'"):
        ask()


@pytest.fixture
def handlers_come_back():
    """A recorder, which is a process of its own otherwise, has handlers of its own."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_a_bag_that_has_begun_is_named_again(tmp_path, handlers_come_back):
    """Whoever lost the answer asks again; no empty bag stays."""
    rclpy.init()
    try:
        node = EpisodeRecorder(parse([str(tmp_path / 'out'), '/joint_states']), 'recorder')
        first = node._on_begin(Trigger.Request(), Trigger.Response())
        again = node._on_begin(Trigger.Request(), Trigger.Response())
        assert first.success and again.success and first.message == again.message
        node._on_end(Trigger.Request(), Trigger.Response())
        following = node._on_begin(Trigger.Request(), Trigger.Response())
        assert following.message.endswith('episode_00001')
        node.destroy_node()
    finally:
        rclpy.shutdown()
