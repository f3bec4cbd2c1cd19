"""Success estimates in words."""

from math import nan

from mtv_world_ros.core.estimate_words import estimate_lines, estimate_words


def test_an_estimate_has_its_first_reason():
    assert estimate_words(0.051, ('0 of 16 foreseen motions succeed', 'more')) == (
        '0.05: 0 of 16 foreseen motions succeed'
    )
    assert estimate_words(0.5, 'one; two') == '0.50: one'


def test_no_estimate_says_why():
    reasons = ("abstains: 'move the red cube' is no known task",)
    assert estimate_words(nan, reasons) == "no estimate: 'move the red cube' is no known task"
    assert estimate_words(None, reasons[0]) == estimate_words(nan, reasons)


def test_a_long_reason_is_cut_at_a_word():
    words = estimate_words(nan, 'word ' * 60)
    assert len(words) < 140 and words.endswith('word ...')


def test_estimates_that_are_alike_are_one_line():
    why = ('abstains: no task',)
    assert estimate_lines('success', [nan] * 3, [why] * 3) == [
        'success: 3 times no estimate: no task'
    ]
    assert estimate_lines('success', [0.1], ['r']) == ['success: 0.10: r']
    assert estimate_lines('success', [0.1, 0.9], ['r', 's']) == [
        'success:', '  1. 0.10: r', '  2. 0.90: s',
    ]  # fmt: skip
