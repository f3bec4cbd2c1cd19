"""Success estimates in words."""

from math import nan

import pytest

from mtv_world_ros.core.estimate_words import estimate_lines, estimate_words, state_of, trust_of


def test_an_estimate_has_its_first_reason():
    assert estimate_words(0.051, ('0 of 16 foreseen motions succeed', 'more')) == (
        '0.05: 0 of 16 foreseen motions succeed'
    )
    assert estimate_words(0.5, 'one; two') == '0.50: one'


@pytest.mark.parametrize(
    'sentence',
    ['fitted here: on 40 episodes', 'not fitted here: the place is not stated; it may be another'],
)
def test_a_number_has_its_state_of_trust(sentence):
    reasons = ('0 of 16 succeed', sentence)
    state = sentence.split(':')[0]
    for given in (reasons, '; '.join(reasons)):
        assert trust_of(given) == sentence and state_of(given) == state
        assert estimate_words(0.05, given) == f'0.05: 0 of 16 succeed ({state})'
    assert trust_of(('calibrated: in a file of before',)) == ''


def test_what_cannot_be_told_is_said_with_its_reason():
    reasons = ('cannot tell, because it is dark', 'more')
    for given in (reasons, '; '.join(reasons)):
        assert trust_of(given) == reasons[0] and state_of(given) == 'cannot tell'
        assert estimate_words(nan, given) == reasons[0]


def test_no_estimate_says_why():
    reasons = ("abstains: 'move the red cube' is no known task",)
    assert (
        estimate_words(nan, reasons) == "cannot tell, because 'move the red cube' is no known task"
    )
    assert estimate_words(None, reasons[0]) == estimate_words(nan, reasons)


def test_a_long_reason_is_cut_at_a_word():
    words = estimate_words(nan, 'word ' * 60)
    assert len(words) < 140 and words.endswith('word ...')


def test_estimates_that_are_alike_are_one_line():
    why = ('abstains: no task',)
    assert estimate_lines('success', [nan] * 3, [why] * 3) == [
        'success: 3 times cannot tell, because no task'
    ]
    assert estimate_lines('success', [0.1], ['r']) == ['success: 0.10: r']
    assert estimate_lines('success', [0.1, 0.9], ['r', 's']) == [
        'success:', '  1. 0.10: r', '  2. 0.90: s',
    ]  # fmt: skip
