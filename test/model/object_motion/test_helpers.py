import logging
from math import factorial, isqrt
import os

import pytest

from mtv_world_ros.model.object_motion.helpers import Helpers

#: what a process says of itself after a while, with `eval`
WHO = '__import__("time").sleep(0.2) or __import__("os").getpid()'


def done(helpers, function, values):
    return helpers.begin(function, [(value,) for value in values]).finish()


def test_two_processes_answer_in_the_order_of_the_jobs(helpers):
    assert done(helpers, factorial, range(7)) == [factorial(number) for number in range(7)]
    assert done(helpers, factorial, [3]) == [6] and done(helpers, factorial, []) == []
    who = done(helpers, eval, [WHO] * 6)
    assert len(set(who)) == 2 and os.getpid() in who


def test_a_helper_does_jobs_while_this_process_goes_on(helpers):
    (helper,) = helpers._ready
    work = helpers.begin(eval, [(WHO,)] * 2)
    for feeder in work._feeders:
        feeder.join()
    assert work.finish() == [helper.process.pid] * 2


def test_without_helpers_this_process_does_all():
    assert done(Helpers(0), eval, [WHO, '3']) == [os.getpid(), 3]


@pytest.mark.parametrize('jobs', [(-1, 4), (4, -1)])
def test_an_error_of_either_process_is_raised_and_the_next_call_is_answered(helpers, jobs):
    with pytest.raises(ValueError, match='nonnegative'):
        done(helpers, isqrt, jobs)
    assert done(helpers, isqrt, [4, 9]) == [2, 3]


def test_what_a_job_prints_is_no_answer(helpers):
    said = 'print("hello", flush=True) or 2'
    assert done(helpers, eval, ['1', said, '3', said]) == [1, 2, 3, 2]


def test_this_process_goes_on_alone_when_the_other_dies(helpers, caplog):
    caplog.set_level(logging.WARNING)
    (helper,) = helpers._ready
    os.kill(helper.process.pid, 9)
    assert done(helpers, eval, [WHO] * 3) == [os.getpid()] * 3
    assert 'the others go on' in caplog.text
    assert done(helpers, factorial, [3, 4]) == [6, 24]
    assert not helpers._ready


def test_what_a_helper_dies_of_is_done_here(helpers):
    (helper,) = helpers._ready
    dies = f'os.getpid() == {os.getpid()} or os.kill(os.getpid(), 9)'
    work = helpers.begin(eval, [(dies.replace('os.', '__import__("os").'),), ('2',)])
    helper.process.wait(10)
    assert work.finish() == [True, 2]


def test_a_helper_ends_with_its_line(helpers):
    (helper,) = helpers._ready
    helper.line.close()
    assert helper.process.wait(10) == 0
