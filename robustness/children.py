"""Stops (SIGSTOP) and kills of every kind of child process, at random moments.

What waits for a child must end in a stated way within seconds: with its work done, or with an
error of the package that says what happened; a policy server must answer the question after. And
no child may be left. Prints a row for each kind; the exit status is 1 if something froze, ended in
another way, or left a process behind.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
import json
import os
from pathlib import Path
import shutil
import signal
import sys
import threading
import time
import traceback
from typing import Any

import numpy as np
import yaml

from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.policies.openpi_client import pack
from robustness.node_messages import commit, ROOT, ros
from robustness.policy_servers import _observation, fine, TIMEOUT_S
from robustness.usage import descendants

#: an end that comes later than this after the signal is late; a case that takes longer froze [s]
LATE_S, FROZEN_S = 20.0, 90
SIGNALS = (signal.SIGSTOP, signal.SIGKILL)


class Signal:
    """Sends a signal to one child of this process, after a while, from a thread of its own.

    Attributes:
        sent_s: when it was sent [s], of `time.monotonic`; infinite = not yet.

    Args:
        victim: part of the command line of the child.
        number: of the signal.
        after_s: time from the start of the child on [s].
    """

    def __init__(self, victim: str, number: int, after_s: float) -> None:
        self._victim, self._number, self._after_s = victim, number, after_s
        self.sent_s = float('inf')
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()

    def late(self) -> bool:
        """Whether what waits for the child should have ended."""
        return time.monotonic() > self.sent_s + LATE_S

    def close(self) -> None:
        """Send nothing any more."""
        self._closed.set()
        self._thread.join()

    def _send(self) -> None:
        while not (found := self._children()):
            if self._closed.wait(0.05):
                return
        if not self._closed.wait(self._after_s):
            with suppress(ProcessLookupError):
                os.kill(found[-1], self._number)
                self.sent_s = time.monotonic()

    def _children(self) -> list[int]:
        return [pid for pid in descendants(os.getpid()) if self._victim in _words(pid)]


def _words(pid: int) -> str:
    try:
        return Path(f'/proc/{pid}/cmdline').read_bytes().replace(b'\0', b' ').decode()
    except OSError:
        return ''


# workers of rank, collect and evaluate


def _make_job() -> Callable[[Any], Any]:
    return _job


def _job(number: int) -> int:
    time.sleep(0.5)
    return number


def worker(folder: Path, one: Signal) -> None:
    """Two workers do eight jobs."""
    from mtv_world_ros.core.executor import run_all
    from mtv_world_ros.core.workers import Workers

    assert len(list(run_all(list(range(8)), _make_job, Workers(count=2, threads=1)))) == 8


# processes that prepare clips for train


def clip_worker(folder: Path, one: Signal) -> None:
    """Two processes make clips of eight steps."""
    from mtv_world_ros.training.clips.step_loader import StepLoader

    workers = StepLoader(
        lambda step, item: _job(item), lambda step, items: items, numbers=(0, 1), workers=2
    )
    try:
        for step in range(8):
            assert workers.batch(step) == [0, 1]
    finally:
        workers.close()


# servers of policies


def serve(port: int) -> None:
    """A server of openpi's protocol that answers."""
    from websockets.sync.server import serve as listen

    def answer(socket: Any) -> None:
        socket.send(pack({'model': 'fine'}))
        with suppress(Exception):
            while True:
                socket.recv()
                fine(socket)

    listen(answer, '127.0.0.1', port, compression=None, max_size=None).serve_forever()


def policy_server(folder: Path, one: Signal) -> None:
    """A policy of a ranking is asked until its server is hit; then it is to answer again."""
    from mtv_world_ros.policies.policy import EpisodeOrigin
    from mtv_world_ros.ranking.policy_list import GuardedPolicy, load_policy_list
    from mtv_world_ros.robot.file import load_robot, robot_path

    module = [sys.executable, '-m', 'robustness.children']
    command = ['env', f'PYTHONPATH={ROOT}', *module, '--serve', '{port}']
    entry = {'name': 'fine', 'policy': 'openpi', 'command': command}
    entry['change'] = {'timeout_s': TIMEOUT_S}
    (folder / 'list.yaml').write_text(yaml.safe_dump({'policies': [entry]}))
    robot = load_robot(robot_path('yam_bimanual'))
    (listed,) = load_policy_list(folder / 'list.yaml', robot)
    policy = GuardedPolicy(listed, folder, EpisodeOrigin(), robot)
    try:
        while not one.late():
            try:
                policy.reset(seed=0)
                policy.act(large_observation(), 'stack')
            except MtvWorldError:
                policy.reset(seed=0)  # starts another
                assert policy.act(large_observation(), 'stack') is not None
                raise
        raise AssertionError('the signal was not noticed')
    finally:
        if policy._server is not None:
            policy._server.stop()


def large_observation() -> Any:
    """Frames that no buffer of the system takes whole for a server that does not read."""
    small = _observation()
    cameras = tuple(replace(one, width=1280, height=960) for one in small.cameras)
    return replace(small, cameras=cameras, frames=np.zeros((2, 960, 1280, 3), np.uint8))


# processes of a recording through the node


def make_episode(folder: Path, *, compressed: bool = True) -> Path:
    """Five seconds of an arm that turns."""
    from mtv_world_ros.cameras.calibration_file import load_calibration
    from mtv_world_ros.data.episode_writer import EpisodeWriter

    cameras = load_calibration(ros().make_calibration(folder / 'calibration.yaml'))
    begin_ns, path = 1_700_000_000_000_000_000, folder / 'episode'
    rows = np.repeat(ros().HOME[None], 4, axis=0)
    plan = JointTrajectory(
        joint_names=ros().JOINTS, times=np.array([0.8, 1.6, 2.4, 3.2]), positions=rows
    )
    with EpisodeWriter(
        path, task='', instruction='', robot='yam_bimanual', cameras=list(cameras.values())
    ) as writer:
        for step in range(100):
            stamp_ns = begin_ns + step * 50_000_000
            writer.write_joint_states(stamp_ns, ros().JOINTS, ros().HOME)
            for view, camera in cameras.items():
                writer.write_camera_info(view, stamp_ns, camera)
                writer.write_image(view, stamp_ns, ros().make_pixels(view), compressed=compressed)
            if step % 40 == 20:
                writer.write_trajectory(stamp_ns, plan)
    return path


def through_node(folder: Path, one: Signal) -> None:
    """An episode is played into a node and recorded while one of the three is hit."""
    from mtv_world_ros.cli.demo.node_processes import DemoOptions, record_through_node

    path = make_episode(folder)
    options = DemoOptions(
        checkpoint='bundled', calibration=folder / 'calibration.yaml', device='cpu', num_threads=1,
        num_inference_steps=1,
    )  # fmt: skip
    record_through_node(path, ros().VIEWS, folder / 'out', options)


#: name -> part of the command line of the child, latest moment of a signal [s], what runs it
KINDS: dict[str, tuple[str, float, Callable[[Path, Signal], None]]] = {
    'worker of rank, collect, evaluate': ('spawn_main', 3.0, worker),
    'worker of train': ('children.py', 3.0, clip_worker),
    'policy server': ('--serve', 3.0, policy_server),
    'recorder of a demo': ('bags.recorder', 6.0, through_node),
    'player of a demo': ('bags.player', 6.0, through_node),
    'node of a demo': ('world_model.node', 6.0, through_node),
}


def attempt(kind: str, number: int, after_s: float, folder: Path) -> tuple[str, float]:
    """How it ended, and how long after the signal [s]."""
    victim, _, run = KINDS[kind]
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    one = Signal(victim, number, after_s)
    signal.alarm(FROZEN_S)
    try:
        run(folder, one)
        end = 'done'
    except MtvWorldError as error:
        end = f'said: {error}'
    except Exception:
        end = traceback.format_exc()
    seconds = max(time.monotonic() - one.sent_s, 0.0)
    signal.alarm(0)
    one.close()
    if left := [_words(pid) for pid in descendants(os.getpid()) if victim in _words(pid)]:
        end = f'left {left}; {end}'
    return end, seconds


def attack(kind: str, count: int, seed: int, folder: Path) -> dict[str, Any]:
    """Try so often, stop and kill in turn; the row of a kind."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    row: dict[str, Any] = {'kind': kind, 'commit': commit(), 'seed': seed, 'tried': 0}
    row |= {'done': 0, 'said': 0, 'worst_s': 0.0, 'examples': {}, 'failures': []}
    for number in range(count):
        sent = SIGNALS[number % len(SIGNALS)]
        after_s = float(rng.uniform(0, KINDS[kind][1]))
        end, seconds = attempt(kind, sent, after_s, folder)
        row['tried'] += 1
        row['worst_s'] = max(row['worst_s'], seconds)
        name = end.split(':')[0]
        if name in ('done', 'said') and seconds < LATE_S:
            row[name] += 1
            row['examples'].setdefault(f'{sent.name} {name}', end)
        else:
            row['failures'].append(f'{sent.name} after {after_s:.2f} s, {seconds:.1f} s: {end}')
    return row


def _freeze(*_: object) -> None:
    raise TimeoutError(f'frozen for {FROZEN_S} s')


def main() -> int:
    """Stop and kills; 1 if something froze."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').splitlines()[0])
    parser.add_argument('--cases', type=int, default=30, help='signals to each kind')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--kind', nargs='+', choices=KINDS, default=list(KINDS))
    parser.add_argument('--out', type=Path, default=ROOT / 'out' / 'children')
    parser.add_argument('--serve', type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve is not None:
        serve(arguments.serve)
    import rclpy

    rclpy.init()
    signal.signal(signal.SIGALRM, _freeze)
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for kind in arguments.kind:
        rows.append(attack(kind, arguments.cases, arguments.seed, arguments.out / 'case'))
        sys.stdout.write(json.dumps(rows[-1], indent=1) + '\n')
        sys.stdout.flush()
        (arguments.out / 'children.json').write_text(json.dumps(rows, indent=1))
    return int(any(row['failures'] for row in rows))


if __name__ == '__main__':
    raise SystemExit(main())
