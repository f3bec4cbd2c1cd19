"""Tests of the progress: lines with the time left where no terminal is, a bar in one."""

import io
import re
import sys
import threading
import time

import pytest

from mtv_world_ros.core.progress import duration, Progress, THREAD


class Terminal(io.StringIO):
    """A stream that says that it is a terminal."""

    def isatty(self) -> bool:
        return True


def test_lines_say_what_is_done_and_the_time_left(monkeypatch):
    monkeypatch.setattr(sys, 'stderr', said := io.StringIO())
    bar = Progress(total=8, unit='rollout', line_s=0.05)
    assert bar.line().startswith('0 of 8 rollouts after 0 s, the time left is known after')
    bar.update(2)
    bar.set_postfix_str('1 success')
    _wait_for(lambda: said.getvalue().count('\n') >= 2)
    bar.close()
    line = said.getvalue().splitlines()[-1]
    assert re.fullmatch(r'2 of 8 rollouts after \d+ s, \d+ s left; 1 success', line)


def test_time_left_is_that_of_the_items_of_this_run(monkeypatch):
    monkeypatch.setattr(sys, 'stderr', io.StringIO())
    now = [100.0]
    monkeypatch.setattr(time, 'monotonic', lambda: now[0])
    with Progress(total=100, initial=90, unit='step', desc='training') as bar:
        now[0] += 600
        bar.update(2)
        # 2 steps in 10 minutes: 8 steps take 40
        assert bar.line() == 'training: 92 of 100 steps after 10 min, 40 min left'


def test_short_work_prints_nothing_where_no_terminal_is(monkeypatch):
    monkeypatch.setattr(sys, 'stderr', said := io.StringIO())
    assert [*Progress(range(3), unit='episode')] == [0, 1, 2]
    assert said.getvalue() == ''


def test_clock_of_a_bar_goes_on_while_nothing_ends(monkeypatch):
    monkeypatch.setattr(sys, 'stderr', said := Terminal())
    monkeypatch.setattr('mtv_world_ros.core.progress._CLOCK_S', 0.02)
    with Progress(total=2, unit='episode'):
        _wait_for(lambda: said.getvalue().count('0/2') > 3)
    assert '0 episodes' not in said.getvalue()


def test_work_that_is_not_shown_starts_no_thread(monkeypatch):
    monkeypatch.setattr(sys, 'stderr', said := Terminal())
    _wait_for(lambda: not _threads())
    with Progress(total=2, is_shown=False):
        assert not _threads()
    assert said.getvalue() == ''


def test_progress_that_is_given_up_ends_with_its_owner(monkeypatch):
    monkeypatch.setattr(sys, 'stderr', io.StringIO())
    _wait_for(lambda: not _threads())
    bar = Progress(total=2, line_s=0.02)
    assert _threads()
    del bar
    _wait_for(lambda: not _threads())


@pytest.mark.parametrize(
    ('seconds', 'words'),
    [(0, '0 s'), (99.4, '99 s'), (99.6, '2 min'), (719, '12 min'), (12000, '3 h 20 min')],
)
def test_durations_are_rounded_in_words(seconds, words):
    assert duration(seconds) == words


def _threads():
    return [thread for thread in threading.enumerate() if thread.name == THREAD]


def _wait_for(is_met):
    until = time.monotonic() + 60
    while not is_met():
        assert time.monotonic() < until
        time.sleep(0.01)
