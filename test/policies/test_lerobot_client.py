"""The client against a server process that speaks LeRobot's asynchronous inference."""

from pathlib import Path

import numpy as np
import pytest

from test.support.policy_servers import HOME, make_policy, observe, policy_values, ROBOT, running

pytest.importorskip('grpc', reason='grpcio is not installed (pip install .[policies])')
pytest.importorskip('google.protobuf', reason='protobuf is not installed')

from mtv_world_ros.core.errors import ConfigError, PolicyError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.policies.kinds import load_policy_config

MARK = Path('/tmp/mtv_world_ros_was_here')
NOISE = np.random.default_rng(0).integers(0, 256, (2, 72, 96, 3), np.uint8)


@pytest.fixture(scope='module')
def server():
    with running('lerobot_server') as (_, port):
        yield port


def make(tmp_path, port, **changes):
    values = policy_values('lerobot')
    values['policy']['actions_per_chunk'] = 6
    values |= {'server': f'127.0.0.1:{port}', **changes}
    return make_policy(tmp_path, values)


@pytest.mark.slow
def test_actions_become_commands_in_the_robots_units_at_the_servers_rate(tmp_path, server):
    policy = make(tmp_path, server)
    policy.reset(seed=0)
    answer = policy.act(observe(), 'stack')
    assert answer.joint_names == ROBOT.joint_names
    np.testing.assert_allclose(answer.times, np.arange(1, 7) / 30)
    moved = answer.positions - HOME
    np.testing.assert_allclose(moved[:, 0], np.radians(np.arange(1, 7)), atol=1e-6)
    np.testing.assert_allclose(moved[:, 12], np.radians(np.arange(1, 7)), atol=1e-6)
    tool = ROBOT.tools[0]  # 100 on the wire is open
    span = (tool.gripper_open - tool.gripper_closed) / 100
    np.testing.assert_allclose(moved[:, 6], span * np.arange(1, 7), atol=1e-6)


def test_commands_beyond_the_limits_are_clipped_on_request():
    path = share_path('config', 'policies', 'act_exported.yaml')
    config = load_policy_config(path, ROBOT)
    actions = np.tile([ROBOT.lower - 0.1, ROBOT.upper + 0.1], (2, 1))
    commands = config.actions.trajectory(actions, observe())
    assert commands.joint_names == ROBOT.joint_names
    np.testing.assert_array_equal(commands.positions[:2], [ROBOT.lower, ROBOT.upper])
    np.testing.assert_allclose(commands.times, [0.2, 0.4, 0.6, 0.8])
    as_told = config.actions.model_copy(update={'clip': False})
    np.testing.assert_array_equal(as_told.trajectory(actions, observe()).positions, actions)


def test_observations_larger_than_a_message_are_sent_in_parts(tmp_path, server):
    images = [{'key': 'top', 'view': 'high', 'width': 1600, 'height': 1200}]  # 5.8 MB
    policy = make(tmp_path, server, images=images)
    policy.reset(seed=0)
    assert policy.act(observe(frames=NOISE), 'stack') is not None


def test_a_failure_of_the_server_is_told_and_the_next_question_goes_on(tmp_path, server):
    policy = make(tmp_path, server)
    policy.reset(seed=0)
    with pytest.raises(PolicyError, match='gave no actions; its log says why'):
        policy.act(observe(), 'fail')
    assert policy.act(observe(), 'stack') is not None


def test_an_answer_that_would_execute_code_is_refused(tmp_path, server):
    MARK.unlink(missing_ok=True)
    policy = make(tmp_path, server)
    policy.reset(seed=0)
    with pytest.raises(PolicyError, match=r"names 'posix\.system'.*was not looked up"):
        policy.act(observe(), 'evil')
    assert not MARK.exists()


def test_a_late_answer_is_told(tmp_path, server):
    policy = make(tmp_path, server, timeout_s=3.0)
    policy.reset(seed=0)
    with pytest.raises(PolicyError, match='DEADLINE_EXCEEDED'):
        policy.act(observe(), 'sleep')


@pytest.mark.slow
def test_a_server_that_dies_is_told(tmp_path):
    with running('lerobot_server') as (process, port):
        policy = make(tmp_path, port)
        policy.reset(seed=0)
        process.kill()
        process.wait()
        with pytest.raises(PolicyError, match='UNAVAILABLE'):
            policy.act(observe(), 'stack')


@pytest.mark.parametrize(
    ('changes', 'text'),
    [
        ({'polici': 1}, r"unknown key 'polici' \(did you mean 'policy'\?\)"),
        ({'policy': {'type': 'act'}}, "key 'path' is missing"),
        ({'images': [{'key': 'top', 'view': 'high'}]}, "every image needs a plain 'key'"),
        ({'state': []}, "'state' must have one entry with 'names'"),
    ],
)
def test_wrong_configurations_say_what_would_be_right(tmp_path, changes, text):
    with pytest.raises(ConfigError, match=text):
        make(tmp_path, 1, **changes)
