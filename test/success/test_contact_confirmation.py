"""Contact parameters that were fitted elsewhere are confirmed by how executed plans end."""

from math import ceil, log, nan

import numpy as np
import pytest

from mtv_world_ros.success.doubts import CONFIRMATION, ContactConfirmation

TASK, OTHER = 'stack the blocks', 'hang the cup'
NEAR, FAR = 0.01, 0.2


def after(ends, task=TASK):
    """Return the test after one rollout an end."""
    test = ContactConfirmation()
    for rollout, away in enumerate(ends):
        test.take(away, rollout, task)
    return test


def test_the_number_of_ends_follows_from_the_stated_rates():
    rates = CONFIRMATION
    assert (rates.other_unforeseen_fraction, rates.false_acceptance) == (0.3, 0.05)
    # evidence .95 / .7 an end; 1 / .05 confirms
    number = ceil(log(20) / log(0.95 / 0.7))
    assert number == 10
    assert not after([NEAR] * (number - 1)).trust(TASK).is_confirmed
    trust = after([NEAR] * number).trust(TASK)
    assert trust.is_confirmed
    assert trust.text == (
        'contact of this cell is confirmed: 10 of 10 ends as foreseen (falsely confirmed: 5% at '
        'most)'
    )


def test_the_text_says_how_many_ends_are_missing():
    assert ContactConfirmation().text.endswith('is not confirmed: 0 of 10 ends as foreseen')
    assert after([NEAR] * 4).text == (
        'contact of this cell is not confirmed: 4 of 10 ends as foreseen'
    )
    # an unforeseen end takes as much evidence as six that were foreseen give
    assert after([*[NEAR] * 4, FAR]).text.endswith('4 of 16 ends as foreseen')


def test_an_unforeseen_end_withdraws_a_confirmation_however_old_it_is():
    test = after([*[NEAR] * 200, FAR])
    assert not test.trust(TASK).is_confirmed and test.num_missing == 6
    for rollout in range(300, 306):
        test.take(NEAR, rollout, TASK)
    assert test.trust(TASK).is_confirmed


def test_a_task_counts_as_tried_after_an_end_of_its_own():
    test = after([NEAR] * 10)
    assert test.trust(TASK).is_confirmed
    untried = test.trust(OTHER)
    assert not untried.is_confirmed and 'not confirmed for this task' in untried.text
    test.take(NEAR, 20, OTHER)
    assert test.trust(OTHER).is_confirmed


def test_a_rollout_counts_once_and_not_before_it_has_ended():
    test = ContactConfirmation()
    for _ in range(3):
        test.take(NEAR, 1, TASK, is_last=False)
    assert test.num_missing == 10
    test.take(NEAR, 1, TASK, is_last=True)
    test.take(NEAR, 1, TASK, is_last=True)
    assert test.num_missing == 9
    # a rollout that was given up ends where another one begins
    test.take(NEAR, 2, TASK, is_last=False)
    assert test.num_missing == 9
    test.take(nan, 3, TASK, is_last=False)
    assert test.num_missing == 8
    # what follows from an unforeseen end is no further evidence
    for _ in range(3):
        test.take(FAR, 4, TASK, is_last=False)
    test.take(NEAR, 4, TASK, is_last=True)
    assert test.text.endswith('2 of 16 ends as foreseen')


def test_rollouts_in_which_nothing_moved_tell_nothing():
    test = after([nan] * 50)
    assert test.num_missing == 10 and not test.trust(TASK).is_confirmed


def share_confirmed(rate, num_rollouts, rng, num_trials=400):
    """Return in which share of trials the test is ever confirmed, of ends unforeseen at a rate."""
    hits = 0
    for _ in range(num_trials):
        test = ContactConfirmation()
        for rollout, is_far in enumerate(rng.random(num_rollouts) < rate):
            test.take(FAR if is_far else NEAR, rollout, TASK)
            if test.trust(TASK).is_confirmed:
                hits += 1
                break
    return hits / num_trials


def test_parameters_that_do_not_hold_are_confirmed_as_rarely_as_stated():
    rng = np.random.default_rng(0)
    # three standard errors of 400 trials above the stated rate: .05 + .033
    assert share_confirmed(CONFIRMATION.other_unforeseen_fraction, 150, rng) < 0.083
    assert share_confirmed(0.54, 150, rng) < 0.02
    assert share_confirmed(0.03, 60, rng) > 0.95
    assert share_confirmed(0.0, 10, rng, 1) == 1.0


@pytest.mark.parametrize('number', [0, 3, 9])
def test_what_is_missing_is_what_confirms(number):
    test = after([NEAR] * number)
    for rollout in range(100, 100 + test.num_missing):
        assert not test.trust(TASK).is_confirmed
        test.take(NEAR, rollout, TASK)
    assert test.trust(TASK).is_confirmed
