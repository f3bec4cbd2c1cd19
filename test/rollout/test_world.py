import numpy as np
import pytest

from mtv_world_ros.core.data_types import JointTrajectory, Observation
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.policies.policy import first_part
from mtv_world_ros.rollout.world import End, run_policy

START_NS = 1_700_000_000_000_000_000


def _observation(stamp_ns=START_NS):
    return Observation(
        cameras=(), frames=np.zeros((0, 1, 1, 3), np.uint8), positions=[0.0], stamp_ns=stamp_ns
    )


def _ramp(seconds=3.0, velocities=None):
    times = np.arange(1, round(seconds / 0.5) + 1) * 0.5
    return JointTrajectory(
        joint_names=('j',), times=times, positions=2 * times[:, None], velocities=velocities
    )


class _Policy:
    name = 'ramp'

    def __init__(self, num_answers):
        self.stamps, self._left = [], num_answers

    def reset(self, *, seed):
        self.stamps = []

    def act(self, observation, instruction):
        self.stamps.append((observation.stamp_ns - START_NS) / 1e9)
        self._left -= 1
        return None if self._left < 0 else _ramp()


class _World:
    instruction, chunk_s = 'go', 1.2

    def __init__(self, verdicts=()):
        self.executed, self._verdicts = [], iter(verdicts)

    def reset(self, *, seed):
        self.observation = _observation()
        return self.observation

    def step(self, answer):
        self.executed.append(float(answer.times[-1]))
        self.observation = _observation(self.observation.stamp_ns + round(answer.times[-1] * 1e9))
        return self.observation

    def is_done(self):
        return next(self._verdicts)


def _run(policy, world, max_chunks, **more):
    return run_policy(policy, world, max_chunks=max_chunks, **more)


def test_the_policy_sees_what_its_answer_led_to_and_ends_the_episode():
    policy, world = _Policy(2), _World()
    run = _run(policy, world, 5)
    assert policy.stamps == pytest.approx([0.0, 1.2, 2.4])
    assert world.executed == pytest.approx([1.2, 1.2])
    assert (run.num_chunks, run.is_over) == (2, True)


def test_an_endless_policy_is_cut_off_at_the_limit():
    policy, world = _Policy(100), _World()
    run = _run(policy, world, 3)
    assert (run.num_chunks, run.is_over, len(world.executed)) == (3, False, 3)


@pytest.mark.parametrize(
    ('verdicts', 'end', 'num_chunks'),
    [
        ((False, True, False, True, True, True), End.HELD, 5),
        ((None, True, None, None), End.ABSTAINS, 4),
        ((None, True, None, False, True, False), End.TIME_OUT, 6),
    ],
)
def test_an_episode_ends_when_success_or_doubt_is_held(verdicts, end, num_chunks):
    run = _run(_Policy(100), _World(verdicts), 6, hold=2)
    assert (run.end, run.num_chunks) == (end, num_chunks)


def test_without_hold_nobody_is_asked_whether_it_is_done():
    assert _run(_Policy(2), _World(), 6).end == End.POLICY


def test_an_answer_is_cut_with_a_point_at_the_cut():
    cut = first_part(_ramp(), np.zeros(1), 1.2)
    np.testing.assert_allclose(cut.times, [0.5, 1.0, 1.2])
    np.testing.assert_allclose(cut.positions[:, 0], [1.0, 2.0, 2.4])
    whole = _ramp(velocities=np.full((6, 1), 2.0))
    at_a_point = first_part(whole, np.zeros(1), 1.5)
    np.testing.assert_allclose(at_a_point.times, [0.5, 1.0, 1.5])
    assert at_a_point.velocities is not None
    np.testing.assert_allclose(at_a_point.velocities, 2.0)
    assert first_part(whole, np.zeros(1), 3.0) is whole
    with pytest.raises(ConfigError, match='must be positive'):
        first_part(whole, np.zeros(1), 0.0)
