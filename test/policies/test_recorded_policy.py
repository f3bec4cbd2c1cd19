"""A recorded episode's commands are sent again, from the moment that the episode begins from."""

import numpy as np
import pytest

from mtv_world_ros.core.data_types import JointTrajectory, Observation
from mtv_world_ros.core.errors import ConfigError, PolicyError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.policies.policy import EpisodeOrigin, RecordedPolicy
from mtv_world_ros.ranking.policy_list import load_policy_list
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.robot.resample import resample
from mtv_world_ros.rollout.assembly import assemble_policy
from mtv_world_ros.rollout.imagined_episodes import check_recording

ROBOT = load_robot(robot_path('yam_bimanual'))
COMMANDS = JointTrajectory(
    joint_names=('a', 'b'),
    times=np.array([-0.2, 0.1, 0.5, 0.9]),
    positions=np.array([[0.0, 9.0], [1.0, 8.0], [2.0, 7.0], [3.0, 6.0]]),
)


def at(seconds, names=('a', 'b')):
    """An observation this long after the first one."""
    return Observation(
        cameras=(), frames=np.zeros((0, 1, 1, 3), np.uint8), positions=np.zeros(len(names)),
        stamp_ns=7_000_000_000 + round(seconds * 1e9),
    )  # fmt: skip


def test_it_goes_on_by_time_and_holds_at_the_end():
    policy = RecordedPolicy(COMMANDS, 0.4)
    for _ in range(2):
        policy.reset(seed=3)
        first, second, last = (policy.act(at(s), '') for s in (0.0, 0.4, 1.2))
        np.testing.assert_allclose(first.times, [0.1, 0.5, 0.9, 1.3])
        np.testing.assert_array_equal(first.positions[:, 0], [1, 2, 3, 3])
        np.testing.assert_allclose(second.times, [0.1, 0.5, 0.9])
        np.testing.assert_array_equal(second.positions[:, 1], [7, 6, 6])
        np.testing.assert_allclose(last.times, [0.1])
        assert policy.act(at(1.3), '') is None


def test_a_start_after_the_last_command_holds():
    commands = JointTrajectory(
        joint_names=('a',), times=np.array([-2.0, -1.0]), positions=np.array([[1.0], [2.0]])
    )
    policy = RecordedPolicy(commands, 0.6)
    policy.reset(seed=0)
    answer = policy.act(at(0.0), '')
    np.testing.assert_allclose((answer.times[-1], answer.positions[-1, 0]), (0.6, 2.0))
    assert policy.act(at(0.6), '') is None


def test_it_commands_what_the_episode_did():
    folder = share_path('resource', 'demo_episode')
    episode = read_episode(folder)
    begin = episode.images['low'].stamps_ns[7]
    make = assemble_policy('recorded', ROBOT)
    policy = make(EpisodeOrigin(recording=str(folder), recording_ns=int(begin)))
    policy.reset(seed=0)
    answer = policy.act(at(0.0), '')
    stamp, sent = episode.trajectories[0]
    assert answer.joint_names == ROBOT.joint_names
    columns = [sent.joint_names.index(name) for name in ROBOT.joint_names]
    later = np.array([1.1, 1.7])
    np.testing.assert_allclose(
        resample(answer, answer.positions[0], later),
        resample(sent, sent.positions[0], later + (begin - stamp) / 1e9)[:, columns],
        atol=1e-9,
    )


def test_without_a_recording_it_says_where_one_is_given():
    with pytest.raises(PolicyError, match="give --episodes .* the parameter 'recording'"):
        assemble_policy('recorded', ROBOT)(EpisodeOrigin())
    with pytest.raises(ConfigError, match="policy 'recorded' repeats .* give --episodes"):
        check_recording('recorded', ROBOT, is_recorded=False)


def test_a_ranking_refuses_it(tmp_path):
    file = tmp_path / 'policies.yaml'
    file.write_text('policies: [{name: again, policy: {kind: recorded}}]')
    with pytest.raises(ConfigError, match="'again' is of kind 'recorded': .* scenes of its own"):
        load_policy_list(file, ROBOT)
