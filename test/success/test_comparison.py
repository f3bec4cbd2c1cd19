"""Plans of one scene are ordered by their outcomes in common futures."""

from itertools import product

import pytest

from mtv_world_ros.success.comparison import ComparedPair, Comparison, RULE


def outcomes(text):
    """Return outcomes: + success, - failure, ? lost."""
    return tuple({'+': True, '-': False, '?': None}[letter] for letter in text)


def compared(*texts, **more):
    return Comparison.of([outcomes(text) for text in texts], **more)


@pytest.mark.parametrize(
    ('own', 'other', 'is_better'),
    [(2, 0, True), (1, 0, False), (2, 1, False), (5, 1, True), (4, 1, False), (10, 2, True),
     (10, 3, False), (0, 0, False), (0, 5, False)],
)  # fmt: skip
def test_the_rule_wants_two_futures_and_at_most_a_fifth_of_the_reverse(own, other, is_better):
    assert RULE.is_better(own, other) == is_better
    pair = ComparedPair(first=0, second=1, num_first=own, num_second=other)
    assert (pair.better == 0) == is_better
    turned = ComparedPair(first=0, second=1, num_first=other, num_second=own)
    assert (turned.better == 1) == is_better


def test_pairs_count_the_futures_in_which_one_plan_alone_succeeds():
    found = compared('++++----', '+++-+---', '--------')
    assert [(p.first, p.second, p.num_first, p.num_second) for p in found.pairs] == [
        (0, 1, 1, 1), (0, 2, 4, 0), (1, 2, 4, 0),
    ]  # fmt: skip
    assert [p.better for p in found.pairs] == [None, 0, 1]
    assert found.num_successes == (4, 4, 0) and found.beaten == {2} and found.best == 0
    # a uniform prior: 1 - 1 / 2^5 after four of four
    assert found.pair(2, 0).confidence == pytest.approx(1 - 0.5**5)
    assert found.pair(0, 1).confidence == pytest.approx(0.5)


def test_equal_plans_are_not_told_and_the_first_is_the_choice():
    found = compared('++--', '++--', '++--')
    assert all(pair.better is None for pair in found.pairs)
    assert found.best == 0 and 'no other plan is better' in found.text


def test_plans_that_end_before_the_task_are_not_told_and_say_so():
    found = compared('----', '----')
    assert found.best == 0 and found.text.endswith(
        'no plan does the task by its end in any future'
    )


def test_the_choice_is_a_later_plan_only_where_it_is_better():
    # one future more is not enough, two are
    assert compared('+---', '++--').best == 0
    found = compared('+---', '++--', '+++-')
    assert found.best == 1, found.pairs  # the third beats the first, the second is not beaten
    assert compared('----', '++++').text == (
        'plan 2 of 2: succeeds in 4 of 4 futures, plan 1 in 0 (better, 0.97)'
    )


def test_the_text_uses_the_numbers_that_plans_have():
    found = compared('----', '++++')
    assert found.told_as([2, 5], 6).startswith('plan 5 of 6: succeeds in 4 of 4 futures, plan 2')
    # the third beats the first; the second is not told from either, and comes before the third
    between = compared('++------', '--++++--', '++----++')
    assert between.beaten == {0} and between.best == 1
    assert 'plan 1 in 2 (not told from it, but a third plan is better)' in between.text


def test_a_future_that_is_lost_under_one_plan_counts_for_none():
    found = compared('++++??', '----++')
    assert (found.num_futures, found.num_successes) == (4, (4, 0))
    assert found.pairs[0].num_first == 4 and found.pairs[0].num_second == 0


@pytest.mark.parametrize(
    ('plans', 'words'),
    [(('++', ''), 'outcome of 1 of 2 plans is not foreseen'), (('++', '++-'), 'different numbers'),
     (('+???', '+--+'), 'most futures were lost')],
)  # fmt: skip
def test_outcomes_that_cannot_be_compared_tell_nothing(plans, words):
    found = compared(*plans)
    assert words in found.reason and words in found.text
    assert found.pairs == () and found.best == 0 and found.pair(0, 1) is None
    assert found.num_futures == 0 and found.num_successes == ()


def test_some_plan_is_never_beaten():
    every = [''.join(letters) for letters in product('+-', repeat=4)]
    for plans in product(every[::3], repeat=3):
        found = compared(*plans)
        assert len(found.beaten) < 3
        best = found.best
        assert all(pair.better in (None, best) for pair in found.pairs
                   if best in (pair.first, pair.second))  # fmt: skip
