import logging
from math import factorial, isqrt
import os

import pytest

#: what each process says of itself, with `eval`
WHO = ('__import__("os").getpid()',) * 5


def test_two_processes_answer_in_the_order_of_the_jobs(helpers):
    assert helpers.map(factorial, range(7)) == [factorial(number) for number in range(7)]
    own, other = helpers.map(eval, WHO)[:2]
    assert own == os.getpid() != other
    assert helpers.map(eval, WHO) == [own, other, own, other, own]
    assert helpers.map(factorial, [3]) == [6] and helpers.map(factorial, []) == []


@pytest.mark.parametrize('jobs', [(-1, 4), (4, -1)])
def test_an_error_of_either_process_is_raised_and_the_next_call_is_answered(helpers, jobs):
    with pytest.raises(ValueError, match='nonnegative'):
        helpers.map(isqrt, jobs)
    assert helpers.map(isqrt, [4, 9]) == [2, 3]


def test_what_a_job_prints_is_no_answer(helpers):
    said = 'print("hello", flush=True) or 2'
    assert helpers.map(eval, ['1', said, '3', said]) == [1, 2, 3, 2]


def test_this_process_goes_on_alone_when_the_other_dies(helpers, caplog):
    caplog.set_level(logging.WARNING)
    own, other = helpers.map(eval, WHO)[:2]
    os.kill(other, 9)
    assert helpers.map(eval, WHO) == [own] * 5
    assert 'this one goes on alone' in caplog.text
    assert helpers.map(factorial, [3, 4]) == [6, 24]


def test_a_helper_ends_with_its_line(helpers):
    other = helpers.map(eval, WHO)[1]
    (helper,) = helpers._ready
    helper.line.close()
    assert helper.process.wait(10) == 0 and helper.process.pid == other
