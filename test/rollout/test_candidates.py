"""A policy of several candidates: the best plan in simulated futures is executed."""

from __future__ import annotations

from dataclasses import replace
import json

import numpy as np
import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.data_types import Observation
from mtv_world_ros.core.errors import CheckpointError, ConfigError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.rollout.candidates import (
    candidate_policy,
    CandidatePolicy,
    check_candidates,
    comparing_pipeline,
)
from mtv_world_ros.rollout.world import run_policy
from mtv_world_ros.success.comparison import Comparison


class Fixed:
    """A policy with one answer, which it gives as often as it is asked."""

    name = 'fixed'

    def __init__(self, answer):
        self.answer, self.seed, self.num_asked = answer, None, 0

    def reset(self, *, seed):
        self.seed = seed

    def act(self, observation, instruction):
        self.num_asked += 1
        return self.answer


class Told:
    """A pipeline whose comparison is given: outcomes by the last position of the first joint."""

    def __init__(self, robot, outcomes):
        self.robot, self._outcomes, self.asked = robot, outcomes, []

    def compare(self, observation, plans, options):
        self.asked.append((plans, options))
        return Comparison.of([self._outcomes[round(p.positions[-1, 0], 3)] for p in plans])


@pytest.fixture(scope='module')
def plan(recording):
    """Return a plan that moves the first joint to an angle."""

    def make(angle, seconds=1.0):
        times = np.linspace(0.2, seconds, 5)
        positions = np.repeat(recording.positions[:1], 5, axis=0)
        positions[:, 0] = angle
        return replace(recording.commands, times=times, positions=positions, velocities=None)

    return make


@pytest.fixture(scope='module')
def start(recording):
    return Observation(
        cameras=recording.cameras,
        frames=recording.frames[:, 0],
        positions=recording.positions[0],
        stamp_ns=1,
        place='cell 3',
    )


@pytest.fixture(scope='module')
def first_joint(recording):
    return round(float(recording.positions[0, 0]), 3)


ALL, NONE = (True,) * 4, (False,) * 4


class Planned(Fixed):
    """A policy that answers with the first part of a plan that it knows."""

    def __init__(self, plan, answer):
        super().__init__(answer)
        self.plan = plan


@pytest.mark.slow
def test_a_policy_that_knows_its_whole_plan_is_judged_by_it(pipeline, plan, start, first_joint):
    good, part = round(first_joint + 0.05, 3), plan(first_joint)
    told = Told(pipeline.robot, {first_joint: NONE, good: ALL})
    asked = [Planned(plan(first_joint, 3.0), part), Planned(plan(good, 3.0), part)]
    policy = CandidatePolicy(asked, told)
    policy.reset(seed=0)
    assert policy.act(start, '') is part and policy.choice.startswith('plan 2 of 2')
    assert {one.times[-1] for one in told.asked[0][0]} == {3.0}


@pytest.mark.slow
def test_the_best_candidate_acts_for_the_rest_of_the_episode(pipeline, plan, start, first_joint):
    bad, good = first_joint, round(first_joint + 0.05, 3)
    told = Told(pipeline.robot, {bad: NONE, good: ALL})
    asked = [Fixed(plan(bad)), Fixed(plan(good, 1.5)), Fixed(plan(good))]
    policy = CandidatePolicy(asked, told)
    policy.reset(seed=7)
    assert [one.seed for one in asked] == [7, 8, 9] and policy.choice == ''
    answer = policy.act(start, 'stack')
    assert answer is asked[1].answer
    assert policy.choice.startswith('plan 2 of 3: succeeds in 4 of 4 futures, plan 1 in 0 (better')
    # plans of other lengths hold their last positions for the comparison, not in the answer
    plans, options = told.asked[0]
    assert {one.times[-1] for one in plans} == {1.5} and options.instruction == 'stack'
    assert policy.act(start, 'stack') is answer
    assert [one.num_asked for one in asked] == [1, 2, 1] and len(told.asked) == 1
    policy.reset(seed=0)
    assert policy.choice == ''


@pytest.mark.slow
def test_where_none_is_better_the_first_candidate_acts(pipeline, plan, start, first_joint):
    told = Told(pipeline.robot, {first_joint: ALL})
    asked = [Fixed(plan(first_joint)), Fixed(plan(first_joint))]
    policy = CandidatePolicy(asked, told)
    policy.reset(seed=0)
    assert policy.act(start, '') is asked[0].answer
    assert 'plan 1 of 2' in policy.choice and 'no other plan is better' in policy.choice


@pytest.mark.slow
def test_plans_that_cannot_be_executed_are_no_candidates(pipeline, plan, start, first_joint):
    good = round(first_joint + 0.05, 3)
    told = Told(pipeline.robot, {first_joint: NONE, good: ALL})
    broken = plan(1e3)
    policy = CandidatePolicy([Fixed(broken), Fixed(plan(first_joint)), Fixed(plan(good))], told)
    policy.reset(seed=0)
    policy.act(start, '')
    assert policy.choice.startswith('plan 3 of 3') and 'plan 2 in 0' in policy.choice
    alone = CandidatePolicy([Fixed(broken), Fixed(None), Fixed(plan(good))], told)
    alone.reset(seed=0)
    assert alone.act(start, '') is not None and alone.choice == 'plan 3 of 3: 1 can be executed'
    over = CandidatePolicy([Fixed(None), Fixed(None)], told)
    over.reset(seed=0)
    assert over.act(start, '') is None
    assert len(told.asked) == 1
    one = Fixed(None)
    assert candidate_policy([one], told) is one


@pytest.mark.slow
def test_plans_are_compared_without_weights_and_a_checkpoint_without_physics_is_refused(
    recording, tmp_path
):
    checkpoint = Checkpoint.open('bundled')
    robot = checkpoint.load_robot(None)
    pipeline = comparing_pipeline(checkpoint, robot)
    good = recording.commands
    kept = good.times > 1e-6
    good = replace(good, times=good.times[kept], positions=good.positions[kept])
    idle = replace(good, positions=np.repeat(good.positions[:1], len(good.times), axis=0))
    policy = CandidatePolicy([Fixed(idle), Fixed(good)], pipeline)
    policy.reset(seed=0)
    start = Observation(
        cameras=recording.cameras,
        frames=recording.frames[:, 0],
        positions=recording.positions[0],
        stamp_ns=1,
        place='cell 3',
    )
    assert policy.act(start, recording.instruction) is good
    assert 'plan 2 of 2' in policy.choice
    with pytest.raises(CheckpointError, match='imagines no frames'):
        list(pipeline.begin(start).extend(good))
    paper = Checkpoint.open('bundled-paper')
    with pytest.raises(ConfigError, match='foresees no object motion.*set candidates to 1'):
        comparing_pipeline(paper, robot)


def test_a_server_of_one_client_is_refused():
    robot = Checkpoint.open('bundled').load_robot(None)
    with pytest.raises(ConfigError, match='serves one client at a time, and candidates is 4'):
        check_candidates('lerobot', robot, 4)
    check_candidates('lerobot', robot, 1)


@pytest.mark.slow
def test_imagine_says_which_candidate_it_chose(tmp_path, capsys):
    episode = share_path('resource', 'demo_episode')
    out = tmp_path / 'out'
    command = ['imagine', '--policy', 'expert-noise-0.06', '--episodes', str(episode)]
    command += ['--segmenter', 'colour', '--max-chunks', '1', '--no-video', '--out', str(out)]
    assert main([*command, '--candidates', '0']) == 1
    assert '--candidates is 0; it must be at least 1' in capsys.readouterr().err
    assert main([*command, '--candidates', '3']) == 0
    (entry,) = json.loads((out / 'episodes.json').read_text())
    assert entry['choice'].startswith('plan ') and ' of 3' in entry['choice']
    assert entry['choice'] in capsys.readouterr().out


def test_run_policy_takes_a_policy_of_candidates(recording, plan, start, first_joint):
    """The loop of every world asks it as it asks any policy."""

    class World:
        instruction, chunk_s = 'stack', 1.0

        def reset(self, *, seed):
            return start

        def step(self, answer):
            self.answer = answer
            return start

        def is_done(self):
            return None

    robot = Checkpoint.open('bundled').load_robot(None)
    good = round(first_joint + 0.05, 3)
    told = Told(robot, {first_joint: NONE, good: ALL})
    world = World()
    policy = CandidatePolicy([Fixed(plan(first_joint)), Fixed(plan(good))], told)
    run = run_policy(policy, world, max_chunks=2)
    assert run.num_chunks == 2 and round(world.answer.positions[-1, 0], 3) == good
