"""The client against a server process that speaks LeRobot's asynchronous inference."""

from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest
import yaml

pytest.importorskip('grpc', reason='grpcio is not installed (pip install .[policies])')
pytest.importorskip('google.protobuf', reason='protobuf is not installed')

from mtv_world_ros.assembly import assemble_policy, robot_path
from mtv_world_ros.data_types import CameraModel, Observation
from mtv_world_ros.errors import ConfigError, PolicyError
from mtv_world_ros.files import share_path
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.policies.policy import EpisodeOrigin, load_policy_config

SERVER = Path(__file__).with_name('lerobot_server.py')
ROBOT = load_robot(robot_path('yam_bimanual'))
HOME = np.array([0.0, 1.047, 1.047, 0.0, 0.0, 0.0, 0.03] * 2)
MARK = Path('/tmp/mtv_world_ros_was_here')


def start_server():
    process = subprocess.Popen([sys.executable, str(SERVER)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    return process, int(process.stdout.readline())


@pytest.fixture(scope='module')
def server():
    process, port = start_server()
    yield process, port
    process.kill()
    process.wait()


def make_policy(tmp_path, port, **changes):
    values = yaml.safe_load(share_path('config', 'policies', 'lerobot.yaml').read_text())
    values['policy']['actions_per_chunk'] = 6
    values |= {'server': f'127.0.0.1:{port}', 'timeout_s': 1.5, **changes}
    path = tmp_path / 'policy.yaml'
    path.write_text(yaml.safe_dump(values))
    return assemble_policy(path, ROBOT)(EpisodeOrigin())


def observe():
    cameras = tuple(
        CameraModel(view=view, width=96, height=72, K=np.diag([90.0, 90.0, 1.0]),
                    mount_link='base', T_mount_camera=np.eye(4))
        for view in ('low', 'high')
    )  # fmt: skip
    frames = np.random.default_rng(0).integers(0, 256, (2, 72, 96, 3), np.uint8)
    return Observation(cameras=cameras, frames=frames, positions=HOME, stamp_ns=10**9)


def test_actions_become_commands_in_the_robots_units_at_the_servers_rate(tmp_path, server):
    policy = make_policy(tmp_path, server[1])
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
    policy = make_policy(tmp_path, server[1], images=images)
    policy.reset(seed=0)
    assert policy.act(observe(), 'stack') is not None


def test_a_failure_of_the_server_is_told_and_the_next_question_goes_on(tmp_path, server):
    policy = make_policy(tmp_path, server[1])
    policy.reset(seed=0)
    with pytest.raises(PolicyError, match='gave no actions; its log says why'):
        policy.act(observe(), 'fail')
    assert policy.act(observe(), 'stack') is not None


def test_an_answer_that_would_execute_code_is_refused(tmp_path, server):
    MARK.unlink(missing_ok=True)
    policy = make_policy(tmp_path, server[1])
    policy.reset(seed=0)
    with pytest.raises(PolicyError, match=r"names 'posix\.system'.*was not looked up"):
        policy.act(observe(), 'evil')
    assert not MARK.exists()


def test_a_late_answer_is_told(tmp_path, server):
    policy = make_policy(tmp_path, server[1])
    policy.reset(seed=0)
    with pytest.raises(PolicyError, match='DEADLINE_EXCEEDED'):
        policy.act(observe(), 'sleep')


def test_a_server_that_dies_is_told(tmp_path):
    process, port = start_server()
    policy = make_policy(tmp_path, port)
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
        make_policy(tmp_path, 1, **changes)
