"""Traces that tests leave in their process are found, and what ends by itself is none."""

from __future__ import annotations

import logging
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading

import pytest

from test.support.left_behind import left, state

SLEEP = 'import time; time.sleep({})'


def test_a_module_that_tidies_up_leaves_nothing() -> None:
    before = state()
    process = subprocess.Popen([sys.executable, '-c', SLEEP.format(60)])
    process.kill()
    process.wait()
    thread = threading.Timer(0.5, lambda: None)  # ends while it is waited for
    thread.start()
    assert left(before) == []


def test_every_trace_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('test.support.left_behind._PATIENCE_S', 0.0)
    before, handler = state(), logging.NullHandler()
    old = signal.signal(signal.SIGALRM, lambda *_: None)
    logging.getLogger().addHandler(handler)
    process = subprocess.Popen([sys.executable, '-c', SLEEP.format(60)])
    ended = threading.Event()
    thread = threading.Thread(target=ended.wait, name='forgotten')
    thread.start()
    try:
        with monkeypatch.context() as changed:
            changed.chdir(tmp_path)
            changed.setenv('MTV_WORLD_FORGOTTEN', '1')
            found = left(before)
    finally:
        signal.signal(signal.SIGALRM, old)
        logging.getLogger().removeHandler(handler)
        process.kill()
        process.wait()
        ended.set()
        thread.join()
    names = ['working folder', 'environment', 'signal handlers', 'log handlers',
             'threads that keep the process alive', 'child processes']  # fmt: skip
    assert [text.partition(':')[0] for text in found] == names
    assert "MTV_WORLD_FORGOTTEN None, now '1'" in found[1]
    assert str(tmp_path) in found[0] and str(process.pid) in found[5] and 'forgotten' in found[4]
    assert os.getcwd() == before['working folder'] and left(before) == []
