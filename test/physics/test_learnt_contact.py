"""Contact learnt from how executed plans ended: draws, friction by object, weights, the rule."""

from __future__ import annotations

import numpy as np
import pytest

from mtv_world_ros.physics.arms.arms import Arms
from mtv_world_ros.physics.engine.engine import Engine
from mtv_world_ros.physics.engine.futures import draw_futures
from mtv_world_ros.physics.solids import Solid
from mtv_world_ros.success.estimator import verdict
from test.support import small_scene
from test.support.scripts import imported_scripts


@pytest.fixture(scope='module')
def script():
    with imported_scripts('learnt_contact') as (module,):
        yield module


@pytest.fixture(scope='module')
def draws(script):
    return script.Draws.of(small_scene.SETTINGS, 64)


def test_draws_are_spread_over_what_decides_and_weighed_as_the_prior(draws):
    assert len(draws.settings.draws) == len(draws.weights) == draws.settings.num_motions - 1
    assert draws.weights.sum() == pytest.approx(1.0)
    # more than an eighth of the draws are more slippery than all but 2 % of the prior
    assert (draws.holds < -3.4).mean() > 0.12
    assert draws.weights[draws.holds < -3.4].sum() < 0.05


def test_an_object_has_a_friction_of_its_own_wherever_it_is_named(draws):
    both = draws.own(['red block', 'cup'])
    assert np.array_equal(draws.own(['cup'])[:, 0], both[:, 1])
    assert not np.allclose(both[:, 0], both[:, 1])


def test_what_is_slippery_is_not_lifted_by_the_same_fingers(script, lift):
    solid = Solid(centre=np.array([0.0, 0.0, 0.02]), size=np.array([0.02, 0.03, 0.04]))
    settings = small_scene.SETTINGS.model_copy(update={'num_motions': 2})
    engine = Engine(Arms(lift, None))
    futures = draw_futures(settings, (solid,), engine.arms.drives)
    times = np.arange(0, 2.01, 0.02)
    height = 0.02 + 0.2 * np.clip(1 - times / 0.5, 0, 1) + 0.1 * np.clip((times - 1) / 0.5, 0, 1)
    commands = np.stack([height, np.where(times < 0.6, 0.04, 0.0)], -1)
    batch = script.ByObject(engine, [futures[0]] * 2, np.array([[0.0], [-5.0]]))
    motion, _ = batch.advance(commands, 5)
    assert motion.points[0, -1, 0, 2] > 0.08
    assert motion.points[1, -1, 0, 2] < 0.03


def cell(script, draws, learning, *, carried_mm, num=12, limit=-1.0):
    """Rollouts in which draws that hold better than a limit carry the object by 300 mm."""
    holds = draws.holds >= limit
    ways = np.zeros((1 + len(holds), 1, 1, 3))
    ways[1:, 0, 0, 0] = np.where(holds, 300, 5)
    lines = [
        {
            'job': ['bold', 'stack', number, 'expert', '0'],
            'final': carried_mm == 300,
            'names': ['red block'],
            'real': [[[carried_mm, 0, 0]]],
            'ways': ways.tolist(),
            'done': holds.astype(int).tolist(),
            'counts': [True] * len(holds),
        }
        for number in range(num)
    ]
    return script.Cell(lines, draws, learning)


@pytest.mark.parametrize('name', ['round 1', 'round 2'])
def test_ends_weigh_draws_until_there_is_a_verdict(script, draws, name):
    learning = script.ROUNDS[name]
    for carried_mm, wanted in ((300, 1.0), (5, 0.0)):
        cells = cell(script, draws, learning, carried_mm=carried_mm)
        before = cells.estimate(0, *cells.weights([]))
        after = cells.estimate(0, *cells.weights(range(10)))
        assert np.isnan(verdict(before.probability, before[1:]))
        assert verdict(after.probability, after[1:]) == wanted
        assert after.low <= after.probability <= after.high


@pytest.mark.parametrize('name', ['round 1', 'round 2'])
def test_where_objects_end_as_in_no_draw_none_of_these_grows_and_nothing_is_said(
    script, draws, name
):
    cells = cell(script, draws, script.ROUNDS[name], carried_mm=150)
    _, first = cells.weights([])
    weights, none = cells.weights(range(10))
    assert none > 0.5 > first
    one = cells.estimate(0, weights, none)
    assert np.isnan(verdict(one.probability, one[1:]))


def test_what_was_not_foreseen_weighs_nothing(script, draws):
    cells = cell(script, draws, script.ROUNDS['round 1'], carried_mm=300, num=2)
    refused = {'job': ['bold', 'stack', 9, 'expert', '0'], 'final': True, 'refused': True}
    both = script.Cell([*cells._lines, refused], draws, script.ROUNDS['round 1'])
    assert np.array_equal(both.weights([2])[0], both.weights([])[0])
    assert np.isnan(both.estimate(2, *both.weights([])).probability)


def test_the_rule_is_broken_by_one_truth_alone(script):
    def row(false, told):
        return [*[''] * len(script.HEAD), false, told]

    good = {('nominal', 3): row(0.05, 0.1), ('nominal', 10): row(0.0, 0.5)}
    assert script.ruled(good) == []
    (false,) = script.ruled({**good, ('bold', 30): row(0.06, 0.9)})
    assert 'bold' in false and '30' in false
    (few,) = script.ruled({**good, ('bold', 10): row(0.0, 0.49)})
    assert 'verdicts in 0.49' in few
    # before any plan nothing is promised
    assert script.ruled({('bold', 0): row(1.0, 0.0)}) == []
