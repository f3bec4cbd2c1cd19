"""Logs of a recorder that is killed, runs out of disk, or is interrupted, and what its bags hold.

A process of its own publishes joint states and images all the time, and writes down what it sent.
Every bag is read with rosbags. The full disk is a tmpfs, which only root can mount.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from typing import NamedTuple

from page import parse_arguments, publish, table
from rosbags.highlevel import AnyReader

from mtv_world_ros.ros.bags.raw_headers import read_stamp

DISK_BYTES = 8 * 2**20
RECORDS_S = 3.0
STOPS_S = 2.0
#: what is missing in a bag may be on its way if it is younger than this
OLD_NS = 10**9
#: a busy machine takes long to fill the disk
FULL_S = 300.0
TOPICS = ('/joints', '/camera')
PUBLISHER = """
import sys, time
import rclpy
from sensor_msgs.msg import CompressedImage, JointState
rclpy.init()
node = rclpy.create_node('robot')
joints = node.create_publisher(JointState, '/joints', 1000)
camera = node.create_publisher(CompressedImage, '/camera', 100)
state = JointState(name=[f'j{k}' for k in range(14)], position=[0.5] * 14)
import os
image = CompressedImage(format='jpeg', data=os.urandom(30_000))
with open(sys.argv[1], 'w', buffering=1) as sent:
    def send(publisher, message):
        stamp = time.time_ns()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        sent.write(f'{publisher.topic_name} {stamp}\\n')
        publisher.publish(message)
    node.create_timer(0.01, lambda: send(joints, state))
    node.create_timer(0.02, lambda: send(camera, image))
    rclpy.spin(node)
"""


class Run(NamedTuple):
    """One recording: what was said, and what of it is in the bag."""

    log: str
    closed_s: float
    stopped_s: float
    due: int
    missing: int
    missing_old: int
    never_came: int
    in_bag: int
    age_s: float


class Lab:
    """Publisher and folders.

    Args:
        folder: of bags and logs.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._sent = folder / 'sent.txt'
        words = [sys.executable, '-c', PUBLISHER, str(self._sent)]
        self._publisher = subprocess.Popen(words, env=environment())

    def close(self) -> None:
        """Ends the publisher."""
        self._publisher.kill()
        self._publisher.wait()

    def record(self, place: Path, end: signal.Signals | None) -> Run:
        """Records into a folder until a signal, or (None) until the disk is full."""
        log, bag = self._folder / 'recorder.log', place / 'bag'
        module = 'mtv_world_ros.ros.bags.recorder'
        with log.open('w') as file:
            process = subprocess.Popen(
                [sys.executable, '-m', module, str(bag), *TOPICS],
                stdout=file, stderr=subprocess.STDOUT, env=environment(),
            )  # fmt: skip
            try:
                _wait(lambda: ': recording' in log.read_text())
                if end is None:
                    process.wait(FULL_S)
                else:
                    time.sleep(RECORDS_S)
                    process.send_signal(end)
                asked_ns = time.time_ns()
                process.wait(60)
            finally:
                process.kill()
        stopped_s = (time.time_ns() - asked_ns) / 1e9
        said = log.read_text() + f'(exit status {process.returncode})\n'
        if not bag.is_dir():
            said += self._recovered(bag)
        return self._judged(said, bag, asked_ns, stopped_s)

    def _recovered(self, bag: Path) -> str:
        hidden = ' '.join(path.name for path in bag.parent.glob('.bag.*'))
        words = [sys.executable, '-m', 'mtv_world_ros.cli', 'recover', str(bag)]
        done = subprocess.run(words, capture_output=True, text=True, env=environment())
        said = f'$ ls -A\n{hidden}\n$ mtv-world recover bag\n{done.stdout}{done.stderr}'
        return said

    def _judged(self, said: str, bag: Path, asked_ns: int, stopped_s: float) -> Run:
        began = re.search(r'\[(\d+)\.(\d{9})\] \[recorder\]: recording', said)
        assert began is not None, said
        begin_ns = int(began[1]) * 10**9 + int(began[2])
        with AnyReader([bag]) as reader:
            got = [(c.topic, read_stamp(data), at) for c, at, data in reader.messages()]
            counted = ', '.join(f'{c.topic} {c.msgcount}' for c in reader.connections)
        said += f'rosbags reads: {counted}\n'
        last_ns = max(at for *_, at in got)
        until = min(asked_ns, last_ns)
        rows = [line.split() for line in self._sent.read_text().splitlines()]
        due = {(r[0], int(r[1])) for r in rows if len(r) == 2 and begin_ns < int(r[1]) < until}
        missing = due - {(topic, stamp) for topic, stamp, _ in got}
        old = {(topic, stamp) for topic, stamp in missing if stamp < until - OLD_NS}
        first = {
            topic: min((stamp for name, stamp, _ in got if name == topic), default=until)
            for topic in TOPICS
        }
        early = sum(stamp < first[topic] for topic, stamp in old)
        age_s = max(asked_ns - last_ns, 0) / 1e9
        closed = re.search(r'\[(\d+)\.(\d{9})\] \[recorder\]: recorded', said)
        closed_ns = int(closed[1]) * 10**9 + int(closed[2]) if closed else 0
        closed_s = max(closed_ns - asked_ns, 0) / 1e9
        counts = (len(due), len(missing), len(old), early, len(got))
        return Run(said, closed_s, stopped_s, *counts, age_s)


def environment() -> dict[str, str]:
    """A ROS domain of this process' own."""
    domain = {'ROS_DOMAIN_ID': str(1 + os.getpid() % 100)}
    return {**os.environ, **domain, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}


def _wait(condition) -> None:  # type: ignore[no-untyped-def]
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end, 'waited for 60 s'
        time.sleep(0.02)


@contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    """A disk of `DISK_BYTES`."""
    folder.mkdir()
    words = ['mount', '-t', 'tmpfs', '-o', f'size={DISK_BYTES}', 'tmpfs', str(folder)]
    subprocess.run(words, check=True)
    try:
        yield folder
    finally:
        subprocess.run(['umount', '-l', str(folder)], check=True)


def run(lab: Lab, name: str, folder: Path) -> Run:
    """One recording that ends in the way of a name."""
    if name == 'disk full':
        with small_disk(folder):
            return lab.record(folder, None)
    folder.mkdir()
    return lab.record(folder, WAYS[name])


#: fields of `Run` that are added up, and of which the longest is shown
COUNTS = ('due', 'missing', 'missing_old', 'never_came', 'in_bag')
LONGEST = ('age_s', 'closed_s', 'stopped_s')
WAYS = {
    'killed': signal.SIGKILL,
    'disk full': None,
    'interrupted (SIGINT)': signal.SIGINT,
    'ended (SIGTERM)': signal.SIGTERM,
}


def main() -> int:
    """Records, and makes the page; 1 if a message was lost or a stop took too long."""

    def more(parser: argparse.ArgumentParser) -> None:
        parser.add_argument('--busy', type=int, default=0, help='processes that only compute')

    options = parse_arguments(__doc__, 5, more)
    busy = [
        subprocess.Popen([sys.executable, '-c', 'while True: pass']) for _ in range(options.busy)
    ]
    folder = Path(tempfile.mkdtemp(prefix='mtv_world_recorder_'))
    lab = Lab(folder)
    runs: dict[str, list[Run]] = {}
    try:
        for number in range(options.repeats):
            for name in WAYS:
                runs.setdefault(name, []).append(run(lab, name, folder / f'{name} {number}'))
    finally:
        lab.close()
        for process in busy:
            process.kill()
        shutil.rmtree(folder)
    head = ('recorder', 'n', 'due', 'missing', 'older than 1 s', 'of these before the first',
            'in the bags', 'age of the last [s]', 'bag closed after [s]',
            'ended after [s]')  # fmt: skip
    rows = [
        [name, str(len(own)), *(str(sum(getattr(r, key) for r in own)) for key in COUNTS),
         *(f'{max(getattr(r, key) for r in own):.2f}' for key in LONGEST)]
        for name, own in runs.items()
    ]  # fmt: skip
    logs = [f'## {name}\n\n```\n{own[0].log}```' for name, own in runs.items()]
    body = (
        f'{table(head, rows)}\n\nSums over n, and the longest of n. Published all the time: joint '
        f'states at 100 Hz and images of 30 kB at 50 Hz; {options.busy} processes that only '
        'compute beside it. Due = sent after '
        '`recording` was said, up to the last message in the bag, which is at most so old when '
        'the recorder is killed, told to stop, or finds the disk full. Missing = due and not in '
        'the bag; older = sent more than a second before; of these before the first = before '
        'anything of their topic arrived: a publisher may match a reader after it is said to '
        'record. Closed, ended = after the signal. Every '
        'bag was read with rosbags.\n\nThe first log of each, folder left out.\n\n'
        f'{chr(10).join(logs)}'
    )
    body = body.replace(f'{folder}/', '')
    publish(
        'recorder_faults', 'A recorder killed, on a full disk, and interrupted',
        'python benchmark/recorder_faults.py', body, options, 'rclpy over Fast DDS',
    )  # fmt: skip
    every = [one for own in runs.values() for one in own]
    return int(any(one.missing_old > one.never_came or one.stopped_s > STOPS_S for one in every))


if __name__ == '__main__':
    raise SystemExit(main())
