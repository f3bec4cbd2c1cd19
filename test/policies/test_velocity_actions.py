"""Policies that answer joint velocities, as openpi's DROID checkpoints do."""

import numpy as np
import pytest
import yaml

from test.support.openpi_server import DROID_VELOCITIES
from test.support.policy_servers import policy_values, running

pytest.importorskip('msgpack', reason='msgpack is not installed (pip install .[policies])')
pytest.importorskip('websockets', reason='websockets is not installed (pip install .[policies])')

from mtv_world_ros.core.data_types import CameraModel, Observation
from mtv_world_ros.core.errors import ConfigError, PolicyError
from mtv_world_ros.policies.policy import EpisodeOrigin
from mtv_world_ros.policies.server_mapping import ActionOutput
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.robot.plan import Plan
from mtv_world_ros.rollout.assembly import assemble_policy

FRANKA = load_robot(robot_path('franka'))
HOME = np.array([0.0, -0.4, 0.1, -2.2, 0.2, 1.9, 0.785, 0.03])
ARM = FRANKA.joint_names[:7]


def observe(positions=HOME):
    cameras = tuple(
        CameraModel(view=view, width=32, height=24, K=np.diag([30.0, 30.0, 1.0]),
                    mount_link='table', T_mount_camera=np.eye(4))
        for view in ('front', 'wrist')
    )  # fmt: skip
    frames = np.zeros((2, 24, 32, 3), np.uint8)
    return Observation(cameras=cameras, frames=frames, positions=positions, stamp_ns=10**9)


def make(**changes):
    """Actions in rad/s, 10 a second, the gripper in metres."""
    joints = {joint: k for k, joint in enumerate(FRANKA.joint_names)}
    values = {'rate_hz': 10, 'action': 'velocity', 'joints': joints} | changes
    return ActionOutput.model_validate(values, context={'robot': FRANKA})


def chunk(velocities, gripper=0.02, count=15):
    return np.tile([*velocities, gripper], (count, 1)).astype(float)


def test_the_bundled_file_drives_a_franka_by_a_server_that_answers_droid_velocities(tmp_path):
    with running('openpi_server') as (_, port):
        values = policy_values('openpi_droid') | {'server': f'ws://127.0.0.1:{port}'}
        (tmp_path / 'droid.yaml').write_text(yaml.safe_dump(values))
        policy = assemble_policy(tmp_path / 'droid.yaml', FRANKA)(EpisodeOrigin())
        policy.reset(seed=0)
        answer = policy.act(observe(), 'put the cup down')
        policy.close()
    assert answer.joint_names == FRANKA.joint_names
    np.testing.assert_allclose(answer.times, np.arange(1, 16) / 15)
    # DROID: a value of 1 is .2 rad a step; no joint exceeds the URDF's speed limit
    fastest = np.array([2.175] * 4 + [2.61] * 3) / 15
    step = np.clip(0.2 * DROID_VELOCITIES, -fastest, fastest)
    expected, at = [], HOME[:7].copy()
    for k in range(15):
        at = at + (step if k < 7 else -step)
        expected.append(at)
    np.testing.assert_allclose(answer.positions[:, :7], expected, atol=1e-6)
    np.testing.assert_allclose(answer.positions[:, 7], [0.04] * 7 + [0.0] * 8, atol=1e-9)
    Plan.of(answer, FRANKA, observe())  # the node accepts it


def test_positions_are_the_observed_ones_plus_the_sum_of_velocities():
    answer = make().trajectory(chunk([0.3, 0, 0, 0, 0, 0, -0.1]), observe())
    np.testing.assert_allclose(answer.positions[[0, 7, 14], 0], [0.03, 0.24, 0.45])
    np.testing.assert_allclose(answer.positions[[0, 14], 6], [0.775, 0.635])
    np.testing.assert_allclose(answer.positions[:, 1:6], np.tile(HOME[1:6], (15, 1)))
    np.testing.assert_allclose(answer.positions[:, 7], 0.02)


def test_a_joint_stops_at_its_limit_and_turns_back_from_there_at_once():
    velocities = chunk([2.0, 0, 0, 0, 0, 0, 0], count=30)
    velocities[20:, 0] = -1.0
    answer = make().trajectory(velocities, observe())
    upper = FRANKA.upper[0]
    np.testing.assert_allclose(answer.positions[15:20, 0], upper)
    np.testing.assert_allclose(answer.positions[20:23, 0], upper - [0.1, 0.2, 0.3])


def test_a_joint_that_is_measured_beyond_its_limit_is_not_moved_by_a_velocity_of_zero():
    measured = HOME.copy()
    measured[0] = FRANKA.upper[0] + 0.005
    answer = make().trajectory(chunk([0.0] * 7), observe(measured))
    np.testing.assert_allclose(answer.positions[:, 0], measured[0])


def test_units_signs_and_joints_that_the_policy_does_not_move():
    joints = {joint: {'column': k, 'unit': 'deg', 'sign': -1} for k, joint in enumerate(ARM)}
    joints |= {ARM[6]: {'constant': 0.5}, 'panda_finger_joint1': {'column': 7, 'unit': 'mm'}}
    answer = make(joints=joints).trajectory(chunk([10, 0, 0, 0, 0, 0, 9], 20), observe())
    assert answer.positions[9, 0] == pytest.approx(-np.radians(10))
    np.testing.assert_allclose(answer.positions[:, 6], 0.5)
    np.testing.assert_allclose(answer.positions[:, 7], 0.02)


def test_a_gripper_is_driven_by_velocities_where_it_is_no_position():
    answer = make(positions=[]).trajectory(chunk([0.0] * 7, -0.01, 10), observe())
    np.testing.assert_allclose(answer.positions[[0, 9], 7], [0.029, 0.02])


def test_a_batch_of_one_answer_is_that_answer_and_larger_ones_are_refused():
    velocities = chunk([0.3, 0, 0, 0, 0, 0, 0])
    alone = make().trajectory(velocities, observe())
    batch = make().trajectory(velocities[None], observe())
    np.testing.assert_array_equal(batch.positions, alone.positions)
    with pytest.raises(PolicyError, match=r'have shape \(2, 15, 8\); expected \(time, column\)'):
        make().trajectory(np.stack([velocities, velocities]), observe())


@pytest.mark.parametrize(
    ('changes', 'text'),
    [
        ({'action': 'speed'}, 'valid are position, velocity'),
        ({'relative': True}, "'relative' is for positions"),
        ({'positions': ['panda_joint9']}, "positions: 'panda_joint9' is not among"),
        ({'action': 'position', 'positions': ['panda_joint1']}, "is for 'action: velocity'"),
        ({'positions': [], 'joints': {**dict.fromkeys(ARM, 0), 'panda_finger_joint1':
                                      {'column': 7, 'closed': 1, 'open': 0}}}, 'are velocities'),
        ({'joints': {**dict.fromkeys(FRANKA.joint_names, 0),
                     'panda_joint1': {'column': 0, 'offset': 0.1}}}, "leave 'offset' out"),
    ],
)  # fmt: skip
def test_settings_that_contradict_velocities_are_named(tmp_path, changes, text):
    values = policy_values('openpi_droid')
    values['actions'] |= {'clip': False} | changes
    (tmp_path / 'policy.yaml').write_text(yaml.safe_dump(values))
    with pytest.raises(ConfigError, match=text):
        assemble_policy(tmp_path / 'policy.yaml', FRANKA)(EpisodeOrigin())
