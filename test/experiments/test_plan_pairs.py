"""Tables of pairs of plans, and of the best of N, from lines of a log."""

from __future__ import annotations

import pytest

from mtv_world_ros.success.share_fit import ShareEstimate
from test.support.scripts import imported_scripts


@pytest.fixture(scope='module')
def script():
    with imported_scripts('plan_pairs') as (module,):
        yield module


def log(*scenes):
    """Return lines of scenes, each a list of true outcomes."""
    return [
        {'job': ['bold', 'stack', 0, seed, f'policy {k}'], 'final': final}
        for seed, scene in enumerate(scenes)
        for k, final in enumerate(scene)
    ]


ALL, SOME, NONE = (True,) * 4, (True, True, False, False), (False,) * 4
OPEN = ShareEstimate(0.6, 0.1, 0.9)


def test_pairs_of_one_scene_are_counted_and_no_pairs_between_scenes(script):
    lines = log([True, False, True], [False, True])
    # right, wrong (the one that fails here succeeds in more futures), equal outcomes are ordered
    outcomes = [ALL, SOME, NONE, NONE, ALL]
    cells = script.pair_cells(lines, outcomes, [OPEN] * 5)
    assert cells == ['2', '3', '3 of 3', '2 of 3', '0 of 3', '1 of 1']
    sure = [ShareEstimate(0.99, 0.9, 1.0), ShareEstimate(0.01, 0.0, 0.1), *[OPEN] * 3]
    assert script.pair_cells(lines, outcomes, sure)[4] == '1 of 3'
    # plans of which nothing is foreseen are not ordered
    assert script.pair_cells(lines, [()] * 5, [OPEN] * 5)[2:4] == ['0 of 3', '–']


def test_a_future_without_weight_has_no_outcome(script):
    said = {'done': [True, False, True], 'weights': [1.0, 1.0, 0.0]}
    assert script.outcomes_of(said) == (True, False, None)
    assert script.outcomes_of({'refused': True}) == ()


def test_the_best_of_all_plans_is_chosen_where_futures_tell(script):
    lines = log([True, False], [True, False], [False, True])
    told = script.best_cells(lines, [ALL, NONE, ALL, NONE, NONE, ALL], 2)
    assert told[2] == '1.00' and told[4:] == ['1.00', '1.00']
    # without outcomes the first is taken, which is either in half of the orders
    blind = script.best_cells(lines, [()] * 6, 2)
    assert abs(float(blind[1]) - 0.5) < 0.1 and blind[2] == blind[1] and blind[5] == '0.00'
    assert script.best_cells(lines, [ALL] * 6, 4) is None
