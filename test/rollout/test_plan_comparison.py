"""Plans of one scene are compared in common futures, without a denoiser."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.core.data_types import Observation
from mtv_world_ros.core.errors import ConfigError, PlanError
from mtv_world_ros.robot.plan import Plan
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.plan_comparison import held_until

#: a robot cell in which nothing was fitted
CELL = 'cell 3'


class _Undenoised:
    """A world model that fails a test that asks for frames."""

    def __init__(self, spec):
        self.spec = spec

    def predict(self, *_, **__):
        raise AssertionError('frames were denoised')


@pytest.fixture(scope='module')
def silent(pipeline):
    return replace(pipeline, world_model=_Undenoised(pipeline.spec))


@pytest.fixture(scope='module')
def start(recording):
    return Observation(
        cameras=recording.cameras,
        frames=recording.frames[:, 0],
        positions=recording.positions[0],
        stamp_ns=1,
        place=CELL,
    )


@pytest.fixture(scope='module')
def options(recording):
    return RolloutOptions(instruction=recording.instruction, num_inference_steps=1)


@pytest.fixture(scope='module')
def good(recording):
    """The recorded commands, which do the task."""
    commands = recording.commands
    kept = commands.times > 1e-6
    return replace(commands, times=commands.times[kept], positions=commands.positions[kept])


@pytest.fixture(scope='module')
def idle(good):
    """Commands of the same length that go nowhere."""
    return replace(good, positions=np.repeat(good.positions[:1], len(good.times), axis=0))


@pytest.mark.slow
def test_the_plan_that_does_the_task_is_better_where_no_verdict_is_given(
    silent, pipeline, start, options, good, idle
):
    found = silent.compare(start, [idle, good, good], options)
    assert not found.is_fitted and found.reason == ''
    (first, second, equal) = (found.pair(0, 1), found.pair(0, 2), found.pair(1, 2))
    assert first.better == 1 and second.better == 2 and first.confidence > 0.95
    # equal plans are not told, and the first of them is the choice
    assert equal.better is None and equal.num_first == equal.num_second == 0
    assert found.best == 1 and 'plan 2 of 3' in found.text
    # these are the futures of the imagined rollout
    rollout = pipeline.begin(start, options)
    *_, last = rollout.extend(good)
    assert last.success.futures.outcomes == found.outcomes[1]
    assert not last.success.futures.is_fitted
    other = pipeline.begin(start, options)
    list(other.extend(idle))
    assert other.objects.futures_key == rollout.objects.futures_key != ''
    elsewhere = pipeline.begin(replace(start, place='simulator/nominal'), options)
    list(elsewhere.extend(idle))
    assert elsewhere.objects.futures_key != rollout.objects.futures_key


@pytest.mark.slow
def test_plans_that_cannot_be_compared_are_named(silent, start, options, good, idle, recording):
    def refused(plans, error=ConfigError, pipeline=silent):
        with pytest.raises(error) as caught:
            pipeline.compare(start, plans, options)
        return str(caught.value)

    assert 'takes two plans or more; 1 given' in refused([good])
    assert '0 given' in refused([])
    short = good.points(np.arange(len(good.times) // 2), good.times)
    said = refused([good, short])
    assert f'plan 1 lasts {good.times[-1]:.2f} s and plan 2 {short.times[-1]:.2f} s' in said
    moved = replace(start, positions=start.positions + 0.01)
    checked = Plan.of(idle, silent.robot, moved)
    assert 'plan 2 starts elsewhere' in refused([good, checked])
    later = Plan.of(good, silent.robot, replace(start, stamp_ns=2))
    assert 'stamped 2 ns, not 1 ns' in refused([later, good])
    renamed = replace(good, joint_names=[f'x_{name}' for name in good.joint_names])
    assert 'joint' in refused([good, renamed], PlanError)
    blind = replace(silent, judge=replace(silent.judge, object_motion=None))
    assert 'foresees none' in refused([good, idle], pipeline=blind)


@pytest.mark.slow
def test_a_plan_of_another_robot_is_named(silent, start, options, good, one_arm):
    other = Plan.of(good, silent.robot, start)
    other = replace(other, robot=one_arm)
    with pytest.raises(ConfigError, match='plan 2 is of the robot'):
        silent.compare(start, [good, other], options)


@pytest.mark.slow
def test_nothing_is_told_of_an_unknown_task(silent, start, options, good, idle):
    found = silent.compare(start, [idle, good], replace(options, instruction='do a dance'))
    assert found.best == 0 and 'not foreseen' in found.reason and found.pairs == ()


def test_a_shorter_plan_holds_its_last_positions(good):
    held = held_until(good, good.times[-1] + 2.0)
    assert held.times[-1] == good.times[-1] + 2.0
    np.testing.assert_array_equal(held.positions[-1], good.positions[-1])
    assert held_until(good, 0.1) is good
