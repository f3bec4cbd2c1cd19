"""The tests' own client of services finds those that discovery has lost."""

import pytest
from rcl_interfaces.srv import GetParameters
from std_srvs.srv import Trigger

from test.support import ros_nodes

SERVICE = '/server/ask'


@pytest.fixture
def server(client):
    node = ros_nodes.Client()  # any node that is spun offers services
    node.node.create_service(Trigger, SERVICE, lambda _, answer: answer)
    client.callers.append(ros_nodes.Participant(node.context, node.node, node.executor))
    yield node
    client.callers.pop(1)
    node.close()


def test_a_service_that_a_participant_never_discovers_is_asked_from_another(
    client, server, monkeypatch
):
    monkeypatch.setattr(ros_nodes, 'MATCH_AGAIN_S', 0.3)
    client.services[SERVICE] = client.node.create_client(GetParameters, '/not_there')
    answer = client.call(Trigger, SERVICE, Trigger.Request())
    assert answer.success is False
    assert client.callers[-1].node.get_name().startswith('client_')
    assert client.services[SERVICE] in client.callers[-1].node.clients


def test_a_service_that_nobody_offers_is_named_with_what_each_participant_knows(
    client, monkeypatch
):
    monkeypatch.setattr(ros_nodes, 'MATCH_AGAIN_S', 0.2)
    monkeypatch.setattr(ros_nodes, 'TIMEOUT_S', 0.5)
    with pytest.raises(AssertionError, match=r'service /nobody.*knows them: \[\[\[\], \[\]\]'):
        client.call(Trigger, '/nobody', Trigger.Request())
