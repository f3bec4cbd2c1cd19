"""The reset that an imagined episode waits for, without a world model that answers."""

import pytest
from rclpy.task import Future
from std_srvs.srv import Trigger

from mtv_world_ros.ros.messages.rejection import Rejection
from mtv_world_ros.ros.policy import node
from mtv_world_ros.ros.policy.node import WorldModelReset


class Client:
    """A client of a service; a request without an answer is kept until it is given up."""

    srv_name = '/world_model/reset'

    def __init__(self):
        self.pending, self.num_sent = [], 0

    def create_client(self, *_):
        return self

    def call_async(self, _):
        future = Future()
        self.pending.append(future)
        future.add_done_callback(self.pending.remove)
        self.num_sent += 1
        return future

    def answer(self, number, *, success=True):
        self.pending[number].set_result(Trigger.Response(success=success, message='why'))


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(node.time, 'monotonic', lambda: now[0])
    return now


def refusal(reset):
    with pytest.raises(Rejection) as refused:
        reset.check()
    return str(refused.value)


def test_nothing_is_waited_for_that_was_not_asked(clock):
    WorldModelReset(Client(), 'world_model').check()


def test_requests_without_an_answer_do_not_pile_up(clock):
    client = Client()
    reset = WorldModelReset(client, 'world_model')
    reset.ask()
    for _ in range(50):
        assert 'has not reset the world model yet' in refusal(reset)
        clock[0] += 5.0
    assert client.num_sent == 50 and len(client.pending) == 3
    reset.ask()
    assert len(client.pending) == 1


def test_a_slow_answer_to_an_earlier_request_counts(clock):
    client = Client()
    reset = WorldModelReset(client, 'world_model')
    reset.ask()
    clock[0] += 5.0
    refusal(reset)
    client.answer(0, success=False)
    assert refusal(reset).endswith(': why')
    client.answer(0)
    reset.check()
    assert not client.pending
    clock[0] += 50.0
    reset.check()
    assert client.num_sent == 2
