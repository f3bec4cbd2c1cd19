"""Processes that stand still are found and ended."""

import os
import signal
import subprocess
import sys
import time

import pytest

from mtv_world_ros.errors import MtvWorldError, TrainingError
from mtv_world_ros.lab.training.clips.batches import ClipWorkers
from mtv_world_ros.processes import run_all, StandStill, STILL_S, stop_process


class StopsItself:
    """A job that stops the process it runs in; travels to workers by its module's name."""

    def __call__(self):
        return stop_on_three


def stop_on_three(number):
    if number == 3:
        os.kill(os.getpid(), signal.SIGSTOP)
    return number


@pytest.fixture
def child():
    with subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)']) as process:
        yield process
        process.kill()


def test_one_that_stands_still_is_named_and_one_at_work_is_not(child):
    still = StandStill()
    child.send_signal(signal.SIGSTOP)
    begin_s = time.monotonic()
    while not (said := still.said({'child': child, 'self': child})):
        assert time.monotonic() - begin_s < 4 * STILL_S
        time.sleep(0.1)
    assert "'child' was stopped" in said and time.monotonic() - begin_s >= STILL_S
    child.send_signal(signal.SIGCONT)
    time.sleep(0.3)
    assert not still.said({'child': child})


def test_one_that_stands_still_hears_that_it_is_to_end(child):
    time.sleep(1.0)
    child.send_signal(signal.SIGSTOP)
    begin_s = time.monotonic()
    stop_process(child)
    assert child.poll() is not None and time.monotonic() - begin_s < 10.0


def test_a_stopped_worker_is_an_error_within_seconds():
    begin_s = time.monotonic()
    with pytest.raises(MtvWorldError, match='2 workers died'):
        list(run_all([1, 2, 3, 4], StopsItself(), 2))
    assert time.monotonic() - begin_s < 60.0


def test_forked_workers_that_note_sigterm_as_training_does_end_with_a_broken_pool():
    before = signal.signal(signal.SIGTERM, lambda *_: None)
    workers = ClipWorkers(lambda step, number: os.getpid(), 2)
    try:
        (pid, _) = workers.clips(0, (0, 1))
        os.kill(pid, signal.SIGKILL)
        with pytest.raises(TrainingError, match='was killed at step 1'):
            for _ in range(100):
                workers.clips(1, (0, 1))
                time.sleep(0.01)
    finally:
        begin_s = time.monotonic()
        workers.close()
        signal.signal(signal.SIGTERM, before)
    assert time.monotonic() - begin_s < 4 * STILL_S


#: the pool of OpenCV's threads has been used before clips are made
AFTER_OPENCV = """
import os, time, cv2, numpy as np
from mtv_world_ros.lab.training.clips.batches import ClipWorkers
cv2.setNumThreads(3)
image, grid = np.zeros((600, 600), np.uint8), np.zeros((600, 600), np.float32)
tasks = len(os.listdir('/proc/self/task'))
cv2.remap(image, grid, grid, cv2.INTER_LINEAR)
assert len(os.listdir('/proc/self/task')) > tasks, 'OpenCV has no pool here'
time.sleep(0.5)  # its threads wait
workers = ClipWorkers(lambda step, number: cv2.remap(image, grid, grid, 1).sum(), 2)
assert workers.clips(0, (0, 1)) == [0, 0]
workers.close()
"""


def test_forked_workers_begin_after_opencv_had_threads():
    """Its pool does not survive the fork: whoever waits for its threads waits for ever."""
    subprocess.run([sys.executable, '-c', AFTER_OPENCV], check=True, timeout=60)
