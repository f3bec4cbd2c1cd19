"""The action `~/follow_joint_trajectory`, by real action clients over the middleware."""

import importlib
import sys

from action_msgs.msg import GoalStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import numpy as np
import pytest
from rclpy.action import ActionClient
from rclpy.duration import Duration
from trajectory_msgs.msg import JointTrajectoryPoint

NAME = '/world_model/follow_joint_trajectory'
BLOCKS, SLOW = 1200, 1400  # seeds: a rollout that lasts until it is stopped, and 0.3 s a chunk
CHUNK_S = 0.8
needs_control_msgs = pytest.mark.control_msgs


@pytest.fixture(scope='module')
def node(tmp_path_factory, ros):
    node = ros.start_node(tmp_path_factory.mktemp('node'), 'pace:=burst')
    yield node
    assert node.stop() == 0, node.output()
    assert 'Traceback' not in node.output(), node.output()


@pytest.fixture
def client(node, client, ros):
    if not client.publishers:
        client.connect_inputs(ros.INPUTS)
    client.set(seed=0, least_goal_success=0.0)
    client.reset()
    client.send_scene()
    return client


def readers(node):
    """Those that a node knows of the action's feedback."""
    infos = node.get_subscriptions_info_by_topic(f'{NAME}/_action/feedback')
    return {bytes(info.endpoint_gid) for info in infos}


class Controller:
    """A client of the action, as MoveIt has one."""

    def __init__(self, client, node):
        self.client = client
        self.messages = importlib.import_module('control_msgs.action').FollowJointTrajectory
        tolerance = importlib.import_module('control_msgs.msg').JointTolerance
        self.tolerance = lambda name, position: tolerance(name=name, position=position)
        self.actions = ActionClient(client.node, self.messages, NAME)
        # rclpy's own client drops feedback that a result overtakes
        self.subscription = client.node.create_subscription(
            self.messages.Impl.FeedbackMessage, f'{NAME}/_action/feedback', self.keep, 10
        )
        client.wait(self.actions.server_is_ready, 'the action')
        # the node discovers this client's readers a moment later; before, feedback is lost
        client.wait(lambda: readers(client.node) <= readers(node), 'readers of feedback')
        client.spin_for(0.5)
        self.received, self.goals = [], set()

    def send(self, trajectory, **fields):
        """Send a goal; return its handle once it is accepted."""
        goal = self.messages.Goal(trajectory=trajectory, **fields)
        asked = self.actions.send_goal_async(goal)
        self.client.wait(asked.done, 'acceptance')
        assert asked.result().accepted
        self.goals.add(bytes(asked.result().goal_id.uuid))
        return asked.result()

    def keep(self, message):
        self.received.append(message)

    @property
    def feedback(self):
        """Feedback of this client's goals."""
        return [m.feedback for m in self.received if bytes(m.goal_id.uuid) in self.goals]

    def wait_for_feedback(self, count):
        """Return what came; a result may overtake it, for it takes another way."""
        self.client.wait(lambda: len(self.feedback) >= count, 'feedback')
        return self.feedback

    def close(self):
        self.actions.destroy()
        self.client.node.destroy_subscription(self.subscription)

    def result(self, handle):
        """Return status, code and text of a goal's end."""
        asked = handle.get_result_async()
        self.client.wait(asked.done, 'a result')
        result = asked.result().result
        return asked.result().status, result.error_code, result.error_string


@pytest.fixture
def new_controller(client, node):
    made = []

    def new_controller():
        made.append(Controller(client, node.node))
        return made[-1]

    yield new_controller
    for controller in made:
        controller.close()


def code(controller, name):
    return getattr(controller.messages.Result, name)


def change(client, transition):
    request = ChangeState.Request(transition=Transition(id=transition))
    assert client.call(ChangeState, '/world_model/change_state', request).success


def test_without_control_msgs_the_node_says_so_once_and_goes_on(tmp_path, ros, monkeypatch):
    for name in ('control_msgs', 'control_msgs.action'):
        monkeypatch.setitem(sys.modules, name, None)
    node, client = ros.start_node(tmp_path, 'pace:=burst', remaps=['__ns:=/other']), ros.Client()
    try:
        client.wait(lambda: client.node.count_publishers('/other/world_model/report'), 'the node')
        assert node.output().count('control_msgs is not installed') == 1
        assert client.node.count_publishers('/other/world_model/success')
    finally:
        client.close()
        assert node.stop() == 0, node.output()


@needs_control_msgs
def test_a_goal_is_accepted_followed_by_feedback_and_succeeds_with_the_verdict(
    client, new_controller, ros
):
    controller, since = new_controller(), len(client.report_values())
    handle = controller.send(ros.make_trajectory(seconds=2 * CHUNK_S))
    status, error_code, text = controller.result(handle)
    assert (status, error_code) == (GoalStatus.STATUS_SUCCEEDED, 0)
    assert text.startswith('2 of 2 chunks imagined; cannot tell, because ')
    assert client.next_end(since)['state'] == 'done'  # the same path as a plan on the topic

    first, last = controller.wait_for_feedback(2)
    assert list(first.joint_names) == list(ros.JOINTS)
    after = [Duration.from_msg(one.actual.time_from_start).nanoseconds for one in (first, last)]
    assert after == [800_000_000, 1_600_000_000]
    assert last.actual.positions[0] == pytest.approx(ros.HOME[0] + 0.2)
    assert last.desired.positions == last.actual.positions
    assert np.allclose(last.error.positions, 0)
    assert 0 < first.actual.positions[0] < last.actual.positions[0]


@needs_control_msgs
def test_one_arms_joints_suffice(client, new_controller, ros):
    controller = new_controller()
    handle = controller.send(ros.make_trajectory(names=ros.JOINTS[:7]))
    assert controller.result(handle)[0] == GoalStatus.STATUS_SUCCEEDED
    assert list(controller.wait_for_feedback(1)[0].joint_names) == list(ros.JOINTS[:7])


@needs_control_msgs
def test_cancel_in_mid_chunk(client, new_controller, ros):
    controller, since = new_controller(), len(client.report_values())
    client.set(seed=BLOCKS)
    handle = controller.send(ros.make_trajectory())
    client.wait(lambda: client.diagnostic_values().get('busy') == 'true', 'the model')
    answer = handle.cancel_goal_async()
    client.wait(answer.done, 'an answer')
    assert [one.goal_id for one in answer.result().goals_canceling] == [handle.goal_id]
    status, _, text = controller.result(handle)
    assert status == GoalStatus.STATUS_CANCELED
    assert text == 'cancelled by its client; nothing was imagined'
    end = client.next_end(since)
    assert (end['state'], end['text']) == ('preempted', 'cancelled by its client')

    client.set(seed=0)  # the node goes on
    assert client.imagine_one()['state'] == 'done'


@needs_control_msgs
def test_cancel_right_behind_the_goal(client, new_controller, ros):
    controller = new_controller()
    client.set(seed=BLOCKS)
    for _ in range(5):
        client.send_scene()
        handle = controller.send(ros.make_trajectory())
        answer = handle.cancel_goal_async()
        client.wait(answer.done, 'an answer')
        assert answer.result().goals_canceling
        assert controller.result(handle)[0] == GoalStatus.STATUS_CANCELED


@needs_control_msgs
def test_cancel_after_a_chunk_tells_what_was_known(client, new_controller, ros):
    controller = new_controller()
    client.set(seed=SLOW)
    handle = controller.send(ros.make_trajectory(seconds=8 * CHUNK_S))
    client.wait(lambda: controller.feedback, 'feedback')
    client.wait(handle.cancel_goal_async().done, 'an answer')
    status, _, text = controller.result(handle)
    assert status == GoalStatus.STATUS_CANCELED
    assert 'of 8 chunks imagined; cannot tell, because ' in text
    assert not text.startswith('8 of 8')


@needs_control_msgs
def test_a_goal_that_is_over_is_not_cancelled(client, new_controller, ros):
    controller = new_controller()
    handle = controller.send(ros.make_trajectory())
    assert controller.result(handle)[0] == GoalStatus.STATUS_SUCCEEDED
    answer = handle.cancel_goal_async()
    client.wait(answer.done, 'an answer')
    assert not answer.result().goals_canceling


@needs_control_msgs
def test_a_goal_preempts_a_plan_of_the_topic_and_a_plan_preempts_a_goal(
    client, new_controller, ros
):
    controller, since = new_controller(), len(client.report_values())
    client.set(seed=SLOW)
    client.send_trajectory(seconds=8 * CHUNK_S)
    client.wait_for_state('chunk', since)
    handle = controller.send(ros.make_trajectory(seconds=8 * CHUNK_S))
    assert client.next_end(since)['state'] == 'preempted'

    client.wait(lambda: controller.feedback, 'feedback')
    client.set(seed=0)
    client.send_trajectory()
    status, error_code, text = controller.result(handle)
    assert (status, error_code) == (
        GoalStatus.STATUS_ABORTED, code(controller, 'INVALID_GOAL'),
    )  # fmt: skip
    assert text.startswith('pre-empted by a newer plan; ')
    states = [end['state'] for end in client.wait_for_ends(3, since)]
    assert states == ['preempted', 'preempted', 'done']


@needs_control_msgs
def test_of_two_clients_the_newer_goal_wins(client, new_controller, ros):
    first, second = new_controller(), new_controller()
    client.set(seed=SLOW)
    older = first.send(ros.make_trajectory(seconds=8 * CHUNK_S))
    client.wait(lambda: first.feedback, 'feedback')
    newer = second.send(ros.make_trajectory())
    status, error_code, text = first.result(older)
    assert (status, error_code) == (GoalStatus.STATUS_ABORTED, code(first, 'INVALID_GOAL'))
    assert 'pre-empted by a newer plan' in text
    assert second.result(newer)[:2] == (GoalStatus.STATUS_SUCCEEDED, 0)
    assert len(second.wait_for_feedback(1)) == 1  # none of the other's


@needs_control_msgs
@pytest.mark.parametrize(
    ('changes', 'fields', 'code_name', 'said'),
    [
        ({'names': ('left_joint1', 'elbow')}, {}, 'INVALID_JOINTS', 'elbow'),
        ({'stamp_ns': 1}, {}, 'OLD_HEADER_TIMESTAMP', 'before the observation'),
        ({'times': [0.2, 0.2, 0.3, 0.4]}, {}, 'INVALID_GOAL', 'increas'),
        ({}, {'path_tolerance': ('elbow', 0.1)}, 'INVALID_JOINTS', "tolerances name the joints"),
    ],
)  # fmt: skip
def test_a_goal_that_cannot_be_imagined_says_why(
    client, new_controller, ros, changes, fields, code_name, said
):
    controller, since = new_controller(), len(client.report_values())
    fields = {name: [controller.tolerance(*value)] for name, value in fields.items()}
    handle = controller.send(ros.make_trajectory(**changes), **fields)
    status, error_code, text = controller.result(handle)
    assert (status, error_code) == (GoalStatus.STATUS_ABORTED, code(controller, code_name))
    assert said in text
    assert client.next_end(since)['state'] == 'rejected'


@needs_control_msgs
def test_a_path_that_begins_elsewhere_violates_its_tolerance(client, new_controller, ros):
    positions = np.repeat(ros.HOME[None], 2, axis=0)
    positions[:, 0] += 0.3
    trajectory = ros.make_trajectory(times=[0.0, 0.8], positions=positions)
    controller = new_controller()
    allowed = [controller.tolerance('left_joint1', 0.5), controller.tolerance('left_joint2', 0.1)]
    handle = controller.send(trajectory, path_tolerance=allowed)
    assert controller.result(handle)[0] == GoalStatus.STATUS_SUCCEEDED

    tight = [controller.tolerance('left_joint1', 0.1)]
    status, error_code, text = controller.result(controller.send(trajectory, path_tolerance=tight))
    assert status == GoalStatus.STATUS_ABORTED
    assert error_code == code(controller, 'PATH_TOLERANCE_VIOLATED')
    assert "joint 'left_joint1' is 0.3000 from the path; path_tolerance allows 0.1" in text


@needs_control_msgs
def test_an_estimate_that_is_too_low_fails_the_goal(client, new_controller, ros):
    controller = new_controller()
    client.set(least_goal_success=0.5)
    status, error_code, text = controller.result(controller.send(ros.make_trajectory()))
    assert status == GoalStatus.STATUS_ABORTED
    assert error_code == code(controller, 'GOAL_TOLERANCE_VIOLATED')
    assert "'least_goal_success' asks for 0.5" in text


@needs_control_msgs
def test_reset_ends_a_goal(client, new_controller, ros):
    controller = new_controller()
    client.set(seed=BLOCKS)
    handle = controller.send(ros.make_trajectory())
    client.wait(lambda: client.diagnostic_values().get('busy') == 'true', 'the model')
    client.reset()
    status, _, text = controller.result(handle)
    assert status == GoalStatus.STATUS_ABORTED and text.startswith('the node was reset; ')


@needs_control_msgs
def test_an_inactive_node_aborts_goals_and_says_so(client, new_controller, ros):
    controller = new_controller()
    client.set(seed=BLOCKS)
    running = controller.send(ros.make_trajectory())
    client.wait(lambda: client.diagnostic_values().get('busy') == 'true', 'the model')
    change(client, Transition.TRANSITION_DEACTIVATE)
    assert 'the node was deactivated' in controller.result(running)[2]
    refused = controller.send(ros.make_trajectory())
    assert 'the node is inactive' in controller.result(refused)[2]
    change(client, Transition.TRANSITION_ACTIVATE)
    client.set(seed=0)
    client.send_scene()
    assert controller.result(controller.send(ros.make_trajectory()))[1] == 0


@needs_control_msgs
def test_a_goal_of_many_points_is_refused_before_it_is_decoded(node, client, new_controller):
    controller = new_controller()
    goal = controller.messages.Goal()
    goal.trajectory.points = [JointTrajectoryPoint()] * 20_001
    before = int(client.diagnostic_values().get('rejected.message_too_large', 0))
    answer = controller.actions.send_goal_async(goal)
    client.wait(answer.done, 'the answer')
    assert not answer.result().accepted
    client.wait(
        lambda: int(client.diagnostic_values().get('rejected.message_too_large', 0)) == before + 1,
        'the count in /diagnostics',
    )
    said = client.diagnostic_values()['last_rejection']
    assert 'the request has 20001 items; at most 20000 are read' in said
    assert client.imagine_one()['state'] == 'done'


@needs_control_msgs
def test_shutting_down_in_mid_rollout_ends_the_goal(client, new_controller, ros):
    """The last one: the node is finalized after it."""
    controller = new_controller()
    client.set(seed=BLOCKS)
    running = controller.send(ros.make_trajectory())
    client.wait(lambda: client.diagnostic_values().get('busy') == 'true', 'the model')
    change(client, Transition.TRANSITION_ACTIVE_SHUTDOWN)
    status, _, text = controller.result(running)
    assert status == GoalStatus.STATUS_ABORTED and 'the node was deactivated' in text
    client.wait(lambda: client.diagnostic_values().get('lifecycle') == 'finalized', 'health')
