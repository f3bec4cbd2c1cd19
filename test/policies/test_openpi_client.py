"""The client against a server process that speaks openpi's protocol."""

import socket
import time

import numpy as np
import pytest

from test.support.policy_servers import HOME, make_policy, observe, policy_values, ROBOT, running

pytest.importorskip('msgpack', reason='msgpack is not installed (pip install .[policies])')
pytest.importorskip('websockets', reason='websockets is not installed (pip install .[policies])')

from mtv_world_ros.core.errors import ConfigError, PolicyError
from mtv_world_ros.policies.openpi_client import limit_sending
from mtv_world_ros.policies.server_mapping import fitted


@pytest.fixture(scope='module')
def server():
    with running('openpi_server') as (_, port):
        yield port


def make(tmp_path, port, **changes):
    values = policy_values('openpi')
    values |= {'server': f'ws://127.0.0.1:{port}', **changes}
    return make_policy(tmp_path, values)


def test_actions_become_commands_in_the_robots_units_at_the_servers_rate(tmp_path, server):
    policy = make(tmp_path, server)
    policy.reset(seed=0)
    assert policy.metadata == {'model': 'tiny', 'action_horizon': 10}
    answer = policy.act(observe(), 'stack')
    assert answer.joint_names == ROBOT.joint_names
    np.testing.assert_allclose(answer.times, 0.02 * np.arange(1, 11))
    moved = answer.positions - HOME
    arm = [k for k, name in enumerate(ROBOT.joint_names) if 'gripper' not in name]
    steps = 0.01 * np.arange(1, 11)[:, None]
    np.testing.assert_allclose(moved[:, arm], np.repeat(steps, len(arm), axis=1), atol=1e-6)
    # a gripper of 0 (closed) to 1 (open) on the wire
    tool = ROBOT.tools[0]
    span = tool.gripper_open - tool.gripper_closed
    np.testing.assert_allclose(moved[:, 6], span * steps[:, 0], atol=1e-6)


def test_images_arrive_in_the_size_and_layout_that_the_server_wants(tmp_path, server):
    frames = np.full((2, 72, 96, 3), 60, np.uint8)
    frames[1] = 200
    policy = make(tmp_path, server)
    policy.reset(seed=0)
    from mtv_world_ros.policies.openpi_client import pack

    answer = policy._exchange(pack(policy._config.request(observe(frames=frames), 'stack')))
    assert answer['seen'] == {
        'cam_high': [3, 224, 224, 'uint8'],
        'cam_low': [3, 224, 224, 'uint8'],
    }
    assert answer['state_dtype'] == 'float32'
    # 96 x 72 fills 224 x 168 of 224 x 224
    np.testing.assert_allclose(answer['mean'], [200 * 168 / 224, 60 * 168 / 224], atol=0.5)


def test_padding_keeps_the_aspect_ratio_and_centres():
    frame = np.full((72, 96, 3), 255, np.uint8)
    padded = fitted(frame, 224, 224)
    assert (padded[28:196] == 255).all() and not padded[:28].any() and not padded[196:].any()
    assert (fitted(frame, 224, 224, 'stretch') == 255).all()


def test_a_servers_traceback_is_told_and_the_next_episode_connects_again(tmp_path, server):
    policy = make(tmp_path, server)
    policy.reset(seed=0)
    with pytest.raises(PolicyError, match="failed: KeyError: 'no such checkpoint'"):
        policy.act(observe(), 'fail')
    policy.reset(seed=1)
    assert policy.act(observe(), 'stack') is not None


def test_a_late_answer_is_not_taken_for_the_next_one(tmp_path, server):
    policy = make(tmp_path, server, timeout_s=2.0)
    policy.reset(seed=0)
    with pytest.raises(PolicyError, match=r"did not answer within 2 s \('timeout_s'\)"):
        policy.act(observe(), 'sleep')
    shifted = HOME + 0.05
    answer = policy.act(observe(shifted), 'stack')
    assert answer.positions[0, 0] == pytest.approx(0.06, abs=1e-6)


def test_not_a_number_is_refused_with_its_place(tmp_path, server):
    policy = make(tmp_path, server)
    with pytest.raises(PolicyError, match='action 3 has nan in column 2'):
        policy.act(observe(), 'nan')


def test_a_server_that_dies_is_told(tmp_path):
    with running('openpi_server') as (process, port):
        policy = make(tmp_path, port)
        policy.reset(seed=0)
        process.kill()
        process.wait()
        with pytest.raises(PolicyError, match='is gone'):
            policy.act(observe(), 'stack')
        with pytest.raises(PolicyError, match='no connection .* is it running'):
            policy.reset(seed=0)


def test_the_api_key_comes_from_the_environment(tmp_path, monkeypatch):
    with running('openpi_server', '--key') as (_, port):
        policy = make(tmp_path, port, api_key_variable='OPENPI_KEY')
        with pytest.raises(ConfigError, match="'OPENPI_KEY' with the API key is not set"):
            policy.reset(seed=0)
        monkeypatch.setenv('OPENPI_KEY', 'wrong')
        with pytest.raises(PolicyError, match='401'):
            policy.reset(seed=0)
        monkeypatch.setenv('OPENPI_KEY', 'secret')
        assert policy.act(observe(), 'stack') is not None


def test_relative_actions_count_from_the_observed_positions(tmp_path, server):
    actions = {**policy_values('openpi')['actions'], 'relative': True}
    policy = make(tmp_path, server, actions=actions)
    answer = policy.act(observe(), 'stack')
    assert answer.positions[0, 1] == pytest.approx(2 * 1.047 + 0.01, abs=1e-5)


@pytest.mark.parametrize(
    ('changes', 'text'),
    [
        ({'sever': 'x'}, r"unknown key 'sever' \(did you mean 'server'\?\)"),
        ({'server': 'localhost:8000'}, r"'server' is 'localhost:8000'; expected ws://"),
        ({'images': [{'key': 'a', 'veiw': 'low'}]}, r"'veiw' \(did you mean 'view'\?\)"),
        ({'images': [{'key': 'a', 'view': 'low', 'width': 3}]}, "give both 'width' and 'height'"),
        ({'state': [{'key': 's', 'joints': {'left_joint1': 1}}]}, r'columns \[0\] of 2 get no'),
        ({'actions': {'joints': {}, 'rate_hz': 50}}, 'joints .* are missing'),
        ({'timeout_s': 0}, "'timeout_s' is 0, must be positive"),
    ],
)  # fmt: skip
def test_wrong_configurations_say_what_would_be_right(tmp_path, changes, text):
    with pytest.raises(ConfigError, match=text):
        make(tmp_path, 1, **changes)


def test_what_is_sent_to_one_that_takes_nothing_ends_in_time():
    near, far = socket.socketpair()
    with near, far:
        limit_sending(near, 0.3)
        begin_s = time.monotonic()
        with pytest.raises(BlockingIOError):
            near.sendall(bytes(2**25))
        assert time.monotonic() - begin_s < 30.0  # of a busy machine; it has no end without
