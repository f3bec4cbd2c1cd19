"""Episodes of a policy in imagination: how they end, and what is left on the disk."""

import json
import threading
import time

import numpy as np
import pytest

from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.errors import ConfigError, EpisodeError
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.policies.policy import EpisodeOrigin
from mtv_world_ros.rollout import imagined_episodes
from mtv_world_ros.rollout.imagined_episodes import (
    EpisodeOptions,
    EpisodeStart,
    imagine_episodes,
    recorded_start,
)


class Scripted:
    """Holds still; its answers are what a test sets."""

    name = 'of a test'

    def __init__(self, robot, act=lambda number: None):
        self.robot, self.behave, self.number = robot, act, 0
        self.threads = set()

    def reset(self, *, seed):
        self.number = 0
        self.threads.add(threading.current_thread())

    def act(self, observation, instruction):
        self.threads.add(threading.current_thread())
        self.number += 1
        self.behave(self.number)
        if self.number > 2:
            return None
        rows = np.repeat(observation.positions[None], 2, axis=0)
        names, times = self.robot.joint_names, np.array([0.5, 2.0])
        return JointTrajectory(joint_names=names, times=times, positions=rows)


@pytest.fixture(scope='module')
def pipeline(make_pipeline):
    return make_pipeline()


@pytest.fixture(scope='module')
def observation(pipeline, make_episode, tmp_path_factory):
    path = make_episode(tmp_path_factory.mktemp('recorded') / 'episode')
    return recorded_start(path, pipeline).observation


@pytest.fixture
def imagine(pipeline, observation, tmp_path, monkeypatch):
    """Run episodes of a policy; return the entries of episodes.json and the policy."""

    def run(act=lambda number: None, starts=None, **options):
        policy = Scripted(pipeline.robot, act)
        monkeypatch.setattr(imagined_episodes, 'assemble_policy', lambda *_: lambda origin: policy)
        start = EpisodeStart(
            source='live', observation=observation, instruction='', origin=EpisodeOrigin()
        )
        found = imagine_episodes(
            pipeline,
            EpisodeOptions(policy='test', **options),
            iter([start] * 9) if starts is None else starts,
            tmp_path / 'out',
            overwrite=True,
        )
        assert found == json.loads((tmp_path / 'out' / 'episodes.json').read_text())
        return found, policy

    return run


def fail(number):
    if number == 2:
        raise ValueError('a fault')


def test_an_episode_ends_when_the_policy_says_so(imagine):
    (found,), policy = imagine()
    assert (found['how'], found['num_chunks'], found['start']) == ('done', 2, 'live')
    assert len(policy.threads) == 1  # some policies are bound to a thread


def test_a_policy_that_fails_ends_its_episode_and_the_next_one_begins(imagine):
    found, _ = imagine(fail, count=2)
    assert [(one['how'], one['num_chunks']) for one in found] == [('policy_failed', 1)] * 2
    assert found[0]['text'] == 'ValueError: a fault'


def test_a_policy_that_hangs_ends_its_episode_at_the_longest_time(imagine, monkeypatch):
    monkeypatch.setattr(imagined_episodes, 'LONGEST_EPISODE_S', 4.0)
    is_over = threading.Event()

    def hang(number):
        if number == 2:
            is_over.wait(60.0)

    begun_s = time.monotonic()
    (found,), _ = imagine(hang)
    is_over.set()
    assert time.monotonic() - begun_s < 30.0  # on a busy machine
    assert (found['how'], found['num_chunks']) == ('max_seconds', 1)
    assert found['text'] == 'the policy had not answered when 4 s were over'
    topics = BagReader(found['bag']).topics()
    assert '/world_model/success' in topics  # the chunk before is there


def interrupt(number):
    if number == 2:
        raise KeyboardInterrupt


def test_an_interruption_leaves_a_readable_bag_and_the_chunks_before(imagine, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        imagine(interrupt)
    (found,) = json.loads((tmp_path / 'out' / 'episodes.json').read_text())
    assert (found['how'], found['num_chunks']) == ('interrupted', 1)
    assert '/world_model/success' in BagReader(found['bag']).topics()


def no_start():
    raise EpisodeError('no camera')
    yield


def test_earlier_episodes_stay_where_the_first_start_fails(imagine, tmp_path):
    (found,), _ = imagine()
    with pytest.raises(EpisodeError, match='no camera'):
        imagine(starts=no_start())
    assert BagReader(found['bag']).topics()


def test_the_described_robot_is_imagined(imagine, pipeline, observation):
    other = pipeline.robot
    start = EpisodeStart(
        source='live', observation=observation, instruction='', origin=EpisodeOrigin(), robot=other
    )
    (found,), _ = imagine(starts=iter([start]))
    assert found['how'] == 'done'


def test_a_start_takes_the_name_of_a_robot_cell(observation):
    start = EpisodeStart(
        source='live', observation=observation, instruction='', origin=EpisodeOrigin()
    )
    named = start.at_place('cell 3')
    assert named.observation.place == 'cell 3' and start.observation.place == observation.place
    np.testing.assert_array_equal(named.observation.frames, observation.frames)


def test_episodes_are_not_overwritten_unasked(imagine, pipeline, tmp_path):
    imagine()
    with pytest.raises(ConfigError, match='--overwrite'):
        imagined_episodes.clear_episodes(tmp_path / 'out', overwrite=False)
