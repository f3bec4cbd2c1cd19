"""Contact parameters that were fitted elsewhere are confirmed task by task, by how plans end."""

from math import ceil, log, nan

import numpy as np
import pytest

from mtv_world_ros.success.confirmation import (
    CONFIRMATION,
    ContactConfirmation,
    seen_end,
    TaskEvidence,
)
from mtv_world_ros.success.doubts import chunk_end, ChunkEnd

TASK, OTHER = 'stack the blocks', 'hang the cup'
NEAR, FAR = 0.01, 0.2


def after(ends, task=TASK):
    """Return the test after one rollout an end."""
    test = ContactConfirmation()
    for rollout, away in enumerate(ends):
        test.take(seen_end(away), rollout, task)
    return test


def missing(test, task=TASK):
    return test.tasks.get(task, TaskEvidence()).num_missing


def test_the_number_of_ends_follows_from_the_stated_rates():
    rates = CONFIRMATION
    assert (rates.other_unforeseen_fraction, rates.false_acceptance) == (0.3, 0.05)
    # evidence .95 / .7 an end; 1 / .05 confirms
    number = ceil(log(20) / log(0.95 / 0.7))
    assert number == 10
    assert not after([NEAR] * (number - 1)).trust(TASK).is_confirmed
    trust = after([NEAR] * number).trust(TASK)
    assert trust.is_confirmed
    # the text names its null hypothesis
    assert trust.text == (
        'contact of this cell is confirmed for this task: 10 of 10 ends as foreseen; if every '
        'single rollout of it ended unforeseen with a probability of 30% or more, this would ever '
        'be said in 5% of such cells at most'
    )


def test_the_text_says_how_many_ends_are_missing():
    assert ContactConfirmation().text.endswith('not confirmed for any task: no end was seen yet')
    assert after([NEAR] * 4).trust(TASK).text == (
        'contact of this cell is not confirmed for this task: 4 of 10 ends as foreseen'
    )
    # an unforeseen end takes as much evidence as six that were foreseen give
    assert after([*[NEAR] * 4, FAR]).trust(TASK).text.endswith('4 of 16 ends as foreseen')
    assert after([NEAR] * 4).text == (
        f'contact of this cell is not confirmed for {TASK} (4 of 10 ends as foreseen)'
    )


def test_an_unforeseen_end_withdraws_a_confirmation_however_old_it_is():
    test = after([*[NEAR] * 200, FAR])
    assert not test.trust(TASK).is_confirmed and missing(test) == 6
    for rollout in range(300, 306):
        test.take(seen_end(NEAR), rollout, TASK)
    assert test.trust(TASK).is_confirmed


def test_each_task_is_confirmed_by_its_own_ends_alone():
    """Cups hang well in a slippery cell, and are foreseen; blocks slip, and are not."""
    test = after([NEAR] * 12, OTHER)
    assert test.trust(OTHER).is_confirmed and test.is_complete
    assert not test.trust(TASK).is_confirmed and '0 of 10' in test.trust(TASK).text
    for rollout in range(100, 110):
        test.take(seen_end(FAR), rollout, TASK)
    # the other task keeps its confirmation, and gives none of it
    assert test.trust(OTHER).is_confirmed and not test.trust(TASK).is_confirmed
    assert not test.is_complete


def test_a_rollout_counts_once_and_not_before_it_has_ended():
    test = ContactConfirmation()
    for _ in range(3):
        test.take(seen_end(NEAR), 1, TASK, is_last=False)
    assert missing(test) == 10
    test.take(seen_end(NEAR), 1, TASK, is_last=True)
    test.take(seen_end(NEAR), 1, TASK, is_last=True)
    assert missing(test) == 9
    # what follows from an unforeseen end is no further evidence
    for _ in range(3):
        test.take(seen_end(FAR), 4, TASK, is_last=False)
    test.take(seen_end(NEAR), 4, TASK, is_last=True)
    assert test.trust(TASK).text.endswith('1 of 16 ends as foreseen')


def test_plans_that_are_given_up_do_not_confirm_however_many():
    """An operator stops the plans that go wrong: eleven of eleven stopped after chunk 1 of 3."""
    test = ContactConfirmation()
    for rollout in range(11):
        test.take(seen_end(NEAR), rollout, TASK, is_last=False)
    test.finish()
    assert missing(test) == 10 and test.tasks[TASK].num_unseen == 11
    # the same plans are not confirmed by ten seen ones, either: too many ends were not seen
    for rollout in range(20, 30):
        test.take(seen_end(NEAR), rollout, TASK)
    assert missing(test) == 0 and not test.trust(TASK).is_confirmed
    assert '11 of 21 ends were not seen and 20% may be' in test.trust(TASK).text
    # until few enough of all were unseen: 11 of 55
    for rollout in range(100, 134):
        assert not test.trust(TASK).is_confirmed
        test.take(seen_end(NEAR), rollout, TASK)
    assert test.trust(TASK).is_confirmed


def test_an_object_that_is_lost_while_it_moves_is_no_end_as_foreseen():
    moved, no = np.array([True, False]), np.zeros(2, np.bool_)
    seen = ChunkEnd(away_m=NEAR, moved=moved, lost=no, hidden=no)
    rest = ChunkEnd(away_m=nan, moved=no, lost=no, hidden=no)
    hidden = ChunkEnd(away_m=nan, moved=no, lost=no, hidden=np.array([True, False]))
    other = ChunkEnd(away_m=nan, moved=no, lost=no, hidden=np.array([False, True]))
    lost = ChunkEnd(away_m=nan, moved=moved, lost=moved, hidden=np.array([True, False]))
    for chunks, number in (
        ((seen, seen), (1, 0)),
        ((seen, rest), (1, 0)),  # it was set down, and the arm leaves
        ((seen, hidden), (0, 1)),
        ((seen, other), (1, 0)),  # of what never moved nothing is expected
        ((seen, lost), (0, 1)),
        ((lost, rest), (0, 1)),  # where it went in between was not compared
        ((rest, rest), (0, 0)),  # nothing moved
    ):
        test = ContactConfirmation()
        for k, end in enumerate(chunks):
            test.take(end, 1, TASK, is_last=k + 1 == len(chunks))
        found = test.tasks.get(TASK, TaskEvidence())
        assert (found.num_foreseen, found.num_unseen) == number, chunks


def test_a_chunk_whose_frames_are_missing_makes_the_end_unseen():
    test = ContactConfirmation()
    test.miss(1, TASK)
    test.take(seen_end(NEAR), 1, TASK)
    assert test.tasks[TASK].num_unseen == 1 and missing(test) == 10
    # an unforeseen end is one all the same
    test.miss(2, TASK)
    test.take(seen_end(FAR), 2, TASK)
    assert test.tasks[TASK].num_unforeseen == 1
    test.miss(3, TASK)
    test.finish()
    assert test.tasks[TASK].num_unseen == 2


def test_the_end_of_a_chunk_says_what_moved_and_what_is_lost():
    still = np.zeros((2, 3, 3, 3))
    ahead = still.copy()
    ahead[:, -1, 0, 0] = 0.1  # the first moves in every future, the others nowhere
    real = np.zeros((3, 3, 3))
    real[-1, 0, 0], real[-1, 1] = 0.12, nan
    end = chunk_end(ahead, real)
    assert end.away_m == pytest.approx(0.02)
    assert end.moved.tolist() == [True, False, False] and not end.lost.any()
    assert end.hidden.tolist() == [False, True, False]
    real[-1, 0] = nan
    end = chunk_end(ahead, real)
    assert np.isnan(end.away_m) and end.lost.tolist() == [True, False, False]


def test_rollouts_in_which_nothing_moved_tell_nothing():
    test = after([nan] * 50)
    assert missing(test) == 10 and not test.trust(TASK).is_confirmed and test.tasks == {}


def share_confirmed(rate, num_rollouts, rng, num_trials=400):
    """Return in which share of trials the test is ever confirmed, of ends unforeseen at a rate."""
    hits, ends = 0, {True: seen_end(FAR), False: seen_end(NEAR)}
    for _ in range(num_trials):
        test = ContactConfirmation()
        for rollout, is_far in enumerate(rng.random(num_rollouts) < rate):
            test.take(ends[is_far], rollout, TASK)
            if test.tasks[TASK].is_confirmed:
                hits += 1
                break
    return hits / num_trials


def test_parameters_that_do_not_hold_are_confirmed_as_rarely_as_stated():
    rng = np.random.default_rng(0)
    # three standard errors of 400 trials above the stated rate: .05 + .033
    assert share_confirmed(CONFIRMATION.other_unforeseen_fraction, 150, rng) < 0.083
    assert share_confirmed(0.54, 150, rng, 100) < 0.02
    assert share_confirmed(0.03, 60, rng, 100) > 0.95
    assert share_confirmed(0.0, 10, rng, 1) == 1.0


@pytest.mark.parametrize('number', [0, 3, 9])
def test_what_is_missing_is_what_confirms(number):
    test = after([NEAR] * number)
    for rollout in range(100, 100 + missing(test)):
        assert not test.trust(TASK).is_confirmed
        test.take(seen_end(NEAR), rollout, TASK)
    assert test.trust(TASK).is_confirmed
