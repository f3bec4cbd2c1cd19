"""Processes that stand still are found and ended."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import threading
import time

import pytest

from mtv_world_ros.core.errors import MtvWorldError, TrainingError
from mtv_world_ros.core.executor import run_all
from mtv_world_ros.core.processes import stop_process, STOPPED_S, StoppedProcesses
from mtv_world_ros.core.worker_pool import run_job, WorkerPool
from mtv_world_ros.core.workers import Workers
from mtv_world_ros.training.clips.step_loader import StepLoader
from test.support.worker_jobs import LongJobs, make_held_back, make_stopping


@pytest.fixture
def child():
    """A process that waits, and takes signals by now.

    It sleeps in short pieces: Python sees a signal that arrives just before a sleep after it.
    """
    code = (
        'import signal, time\n'
        'signal.signal(signal.SIGINT, signal.SIG_DFL)\n'  # a shell's background job ignores it
        'print(flush=True)\n'
        'while True: time.sleep(0.05)'
    )
    with subprocess.Popen([sys.executable, '-c', code], stdout=subprocess.PIPE) as process:
        assert process.stdout.readline()
        yield process
        process.kill()


def test_one_that_stands_still_is_named_and_one_at_work_is_not(child):
    stopped = StoppedProcesses()
    child.send_signal(signal.SIGSTOP)
    begin_s = time.monotonic()
    while not (said := stopped.report({'child': child, 'self': child})):
        assert time.monotonic() - begin_s < 12 * STOPPED_S
        time.sleep(0.1)
    assert "'child' was stopped" in said and time.monotonic() - begin_s >= STOPPED_S
    child.send_signal(signal.SIGCONT)
    time.sleep(0.3)
    assert not stopped.report({'child': child})


def test_one_that_stands_still_hears_that_it_is_to_end(child):
    child.send_signal(signal.SIGSTOP)
    stop_process(child)
    assert child.poll() == -signal.SIGINT  # it is killed where it hears nothing


def test_a_stopped_worker_is_an_error_within_seconds():
    begin_s, done = time.monotonic(), []
    with pytest.raises(MtvWorldError, match='2 workers died'):
        for number, result in run_all([1, 2, 3, 4], make_stopping, Workers(count=2, threads=1)):
            assert number == result
            done.append(number)
    assert done and 3 not in done
    assert time.monotonic() - begin_s < 180.0  # without an end otherwise


def test_forked_workers_that_note_sigterm_as_training_does_end_with_a_broken_pool():
    before = signal.signal(signal.SIGTERM, lambda *_: None)
    workers = StepLoader(
        lambda step, number: os.getpid(), lambda step, pids: pids, numbers=(0, 1), workers=2
    )
    try:
        pid, other = workers.batch(0)
        assert pid == other != os.getpid()
        os.kill(pid, signal.SIGKILL)
        with pytest.raises(TrainingError, match=r'was killed at step \d+'):
            for step in range(1, 1000):
                workers.batch(step)
                time.sleep(0.01)
    finally:
        begin_s = time.monotonic()
        workers.close()
        signal.signal(signal.SIGTERM, before)
    assert time.monotonic() - begin_s < 12 * STOPPED_S


#: the pool of OpenCV's threads has been used before clips are made
AFTER_OPENCV = """
import os, time, cv2, numpy as np
from mtv_world_ros.training.clips.step_loader import StepLoader
cv2.setNumThreads(3)
image, grid = np.zeros((600, 600), np.uint8), np.zeros((600, 600), np.float32)
tasks = len(os.listdir('/proc/self/task'))
cv2.remap(image, grid, grid, cv2.INTER_LINEAR)
assert len(os.listdir('/proc/self/task')) > tasks, 'OpenCV has no pool here'
time.sleep(0.5)  # its threads wait
workers = StepLoader(
    lambda step, number: cv2.remap(image, grid, grid, 1).sum(),
    lambda step, sums: sums,
    numbers=(0, 1),
    workers=2,
)
assert workers.batch(0) == [0, 0]
workers.close()
"""


@pytest.mark.slow
def test_forked_workers_begin_after_opencv_had_threads():
    """Its pool does not survive the fork: whoever waits for its threads waits for ever."""
    subprocess.run([sys.executable, '-c', AFTER_OPENCV], check=True, timeout=180)


def test_an_interrupted_command_does_not_wait_for_the_jobs_of_its_workers(tmp_path):
    def interrupt():
        while not list(tmp_path.iterdir()):
            time.sleep(0.05)
        interrupted_s.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGINT)

    interrupted_s = []
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=interrupt, daemon=True).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            list(run_all([1, 2, 3], LongJobs(tmp_path), Workers(count=2, threads=1)))
    finally:
        signal.signal(signal.SIGINT, before)
    assert time.monotonic() - interrupted_s[0] < 45.0  # of a busy machine; a job takes 60
    assert not [pid for pid in tmp_path.iterdir() if is_alive(pid.name)]


def is_alive(pid):
    try:
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] != 'Z'
    except FileNotFoundError:
        return False


@pytest.mark.parametrize('method', ['spawn', 'fork'])
def test_a_worker_neither_gets_nor_holds_back_the_ctrl_c_of_a_terminal(method):
    pool = WorkerPool(make_held_back, 1, method=method)
    try:
        found = pool.submit(run_job).result(180)
    finally:
        pool.shutdown()
    assert found == (False, True)
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
