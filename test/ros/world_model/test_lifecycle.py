"""The lifecycle of the node: transitions by services, also while a plan is imagined."""

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import State, Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetState
import pytest

PREDICTED = '/world_model/low/predicted/image_raw'
BLOCKS = 1200  # this seed's rollout lasts until it is stopped
CONFIGURE, CLEANUP = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP
ACTIVATE, DEACTIVATE = Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_DEACTIVATE
SHUTDOWN = Transition.TRANSITION_ACTIVE_SHUTDOWN


class Manager:
    """A client that also does what a lifecycle manager does."""

    def __init__(self, client):
        self.client = client
        client.subscribe(TransitionEvent, '/world_model/transition_event', 20)

    def change(self, transition=0, label=''):
        request = ChangeState.Request(transition=Transition(id=transition, label=label))
        return self.client.call(ChangeState, '/world_model/change_state', request).success

    def state(self):
        answer = self.client.call(GetState, '/world_model/get_state', GetState.Request())
        return answer.current_state.label

    def goals(self):
        events = self.client.received['/world_model/transition_event']
        return [event.goal_state.id for event in events]


@pytest.fixture
def client(ros):
    client = ros.Client()
    yield client
    client.close()


def start_blocked_rollout(client, ros):
    """Start a plan that is imagined until something stops it; return the reports before."""
    client.connect_inputs(ros.INPUTS)
    client.set(seed=BLOCKS)
    since = len(client.report_values())
    client.send_scene()
    client.send_trajectory_and_wait_until_it_runs()
    return since


def test_it_configures_and_activates_itself(start, client):
    start()
    manager = Manager(client)
    assert manager.state() == 'active'
    client.wait(lambda: client.diagnostic_values().get('lifecycle') == 'active', 'diagnostics')


def test_without_autostart_nothing_is_loaded_until_a_manager_asks(start, client, ros):
    process = start('autostart:=false')
    manager = Manager(client)
    assert manager.state() == 'unconfigured'
    request = GetAvailableStates.Request()
    states = client.call(GetAvailableStates, '/world_model/get_available_states', request)
    assert {state.label for state in states.available_states} >= {'inactive', 'active'}
    client.wait(lambda: client.diagnostic_values().get('lifecycle') == 'unconfigured', 'health')
    assert client.statuses('/diagnostics')[-1].message == 'the node is unconfigured'
    assert not client.node.count_publishers(PREDICTED)
    assert not client.node.count_subscribers('/joint_trajectory')

    assert manager.change(CONFIGURE)
    assert manager.state() == 'inactive'
    client.connect_inputs(ros.INPUTS)
    refused = client.imagine_one()
    assert (refused['state'], refused['reason']) == ('rejected', 'not_active')
    assert 'ready' not in process.output()

    assert manager.change(ACTIVATE)
    assert client.imagine_one()['state'] == 'done'
    client.wait(lambda: manager.goals()[-1:] == [State.PRIMARY_STATE_ACTIVE], 'events')
    assert State.PRIMARY_STATE_INACTIVE in manager.goals()


def test_deactivating_in_mid_rollout_preempts_the_plan(start, client, ros):
    start()
    manager = Manager(client)
    since = start_blocked_rollout(client, ros)
    assert manager.change(DEACTIVATE)
    end = client.next_end(since)
    assert (end['state'], end['text']) == ('preempted', 'the node was deactivated')
    assert manager.state() == 'inactive'

    client.set(seed=0)
    assert manager.change(ACTIVATE)
    assert client.imagine_one()['state'] == 'done'


def test_it_is_cleaned_up_and_configured_again(start, client, ros):
    start()
    manager = Manager(client)
    client.connect_inputs(ros.INPUTS)
    assert client.imagine_one()['state'] == 'done'
    for _ in range(2):
        assert manager.change(DEACTIVATE)
        assert manager.change(CLEANUP)
        client.wait(lambda: not client.node.count_publishers(PREDICTED), 'the end of topics')
        client.wait(lambda: not client.node.count_subscribers('/low/image_raw'), 'and inputs')
        assert manager.change(CONFIGURE)
        assert manager.change(ACTIVATE)
    client.wait(lambda: client.node.count_publishers(PREDICTED) == 1, 'topics')
    client.wait(lambda: all(client._is_settled(topic) for topic in ros.INPUTS), 'inputs')
    assert client.imagine_one()['state'] == 'done'
    assert client.set(calibration_file='/nowhere')  # checked as before


def test_shutdown_in_mid_rollout_preempts_the_plan(start, client, ros):
    start()
    manager = Manager(client)
    since = start_blocked_rollout(client, ros)
    assert manager.change(SHUTDOWN)
    assert client.next_end(since)['state'] == 'preempted'
    assert manager.state() == 'finalized'
    assert not manager.change(CONFIGURE)
    assert not manager.change(label='configure')
    client.wait(lambda: not client.node.count_publishers(PREDICTED), 'the end of topics')
    client.wait(lambda: client.diagnostic_values().get('lifecycle') == 'finalized', 'health')


def test_what_cannot_be_loaded_leaves_it_unconfigured_and_says_why(tmp_path, start, client, ros):
    start('autostart:=false')
    manager = Manager(client)
    client.subscribe(DiagnosticArray, '/diagnostics', 10)
    assert manager.state() == 'unconfigured'
    path = tmp_path / 'calibration.yaml'
    path.rename(tmp_path / 'moved.yaml')
    assert not manager.change(CONFIGURE)
    assert manager.state() == 'unconfigured'

    def says_why():
        messages = [status.message for status in client.statuses('/diagnostics')]
        return any('not configured' in text and 'calibration.yaml' in text for text in messages)

    client.wait(says_why, 'the reason in /diagnostics')
    (tmp_path / 'moved.yaml').rename(path)
    assert manager.change(CONFIGURE)
    assert manager.change(ACTIVATE)
    client.connect_inputs(ros.INPUTS)
    assert client.imagine_one()['state'] == 'done'


def test_a_later_configure_that_fails_is_said_with_autostart_as_well(tmp_path, start, client, ros):
    process = start()
    manager = Manager(client)
    client.subscribe(DiagnosticArray, '/diagnostics', 10)
    assert manager.change(DEACTIVATE) and manager.change(CLEANUP)
    (tmp_path / 'calibration.yaml').rename(tmp_path / 'moved.yaml')
    assert not manager.change(CONFIGURE)
    assert manager.state() == 'unconfigured'

    def says_why():
        messages = [status.message for status in client.statuses('/diagnostics')]
        return any('not configured' in text and 'calibration.yaml' in text for text in messages)

    client.wait(says_why, 'the reason in /diagnostics')
    said = [line for line in process.output().splitlines() if 'not configured' in line]
    assert len(said) == 1 and 'calibration.yaml' in said[0]
