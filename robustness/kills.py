"""Kills of recorder, player, policy node and world model at random moments: `make kills`.

Nothing that was received more than a second ago may be lost, whoever is left goes on, and whoever
starts again works: a killed recording is recovered and read by rosbags, and the node that is
started after a killed one answers a plan with one end. The processes are forked from one that has
imported everything (so that starting hundreds is cheap), and are killed up to `--longest` seconds
after their start, or after they are at work.
The recorder notes what it receives before it does anything with it, so that a message that the
middleware had not delivered yet is told from one that the recorder lost.
Prints a table; the exit status is 1 if anything was lost, hung or ended with a traceback. What was
interrupted goes on where it was, if it is called with the same `--out`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
import json
import multiprocessing
import os
from pathlib import Path
import re
import shutil
import sys
import time
from typing import Any, NamedTuple

import numpy as np
from rosbags.highlevel import AnyReader

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.importing.recover import find_damaged, recover
from mtv_world_ros.ros.messages.conversions import read_stamp
from robustness.children import make_episode
from robustness.node_messages import commit, ROOT, ros
from robustness.usage import starved_s

#: a busy machine takes long to start a node
START_S = 180.0
PERIOD_S = 0.01
#: ending of the file of stamps and times of what a recorder received, beside its log
RECEIVED = '.received'
#: share of the kills that come while the process starts
STARTING = 0.3


def imported() -> dict[str, Callable[[], int]]:
    """What is run, by name; importing it takes seconds, which the fork server spends once."""
    from mtv_world_ros.ros.bags import player, recorder
    from mtv_world_ros.ros.policy import node as policy
    from mtv_world_ros.ros.world_model import node
    from test.support import (
        fake_policy,  # type: ignore[import-not-found]
        fake_world_model,  # type: ignore[import-not-found]
    )

    def policy_main() -> int:
        return policy.main(load=fake_policy.load)

    def node_main() -> int:
        return node.main(load=fake_world_model.load)

    return {
        'recorder': recorder.main,
        'player': player.main,
        'policy': policy_main,
        'world_model': node_main,
    }


def run_forked(name: str, words: list[str], log: str) -> None:
    """Run one in this process, which was forked for it."""
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    sys.argv = [name, *words]
    main: Any = imported()[name]
    if name == 'recorder':
        note_received(f'{log}{RECEIVED}')
    sys.exit(main(words) if name in ('recorder', 'player') else main())


def note_received(path: str) -> None:
    """Let the recorder of this process note stamp and time [ns] of messages as they come."""
    from mtv_world_ros.ros.bags.recorder import Recorder

    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    handler = Recorder._handler

    def noting(recorder: Recorder, *words: Any) -> Callable[[bytes], None]:
        write = handler(recorder, *words)

        def take(data: bytes) -> None:
            os.write(descriptor, np.array([read_stamp(data), time.time_ns()]).tobytes())
            write(data)

        return take

    Recorder._handler = noting  # type: ignore[method-assign]


class Killed(NamedTuple):
    """One kill.

    Attributes:
        after_s: when [s after the start, or after it was at work].
        problem: what was wrong; empty = nothing.
        seconds: until all was well.
        undelivered: messages sent to a recorder more than a second before, which never reached it.
    """

    after_s: float
    problem: str
    seconds: float
    undelivered: int


class Kills:
    """Starts, kills, and looks at what is left.

    Args:
        out: folder of logs and bags.
        seed: of the moments.
        longest_s: latest moment [s].
    """

    def __init__(self, out: Path, seed: int, longest_s: float) -> None:
        self._out, self._longest_s = out, longest_s
        self._seed = seed
        os.environ['PYTHONPATH'] = str(ROOT)  # the fork server looks for its modules there
        self._context = multiprocessing.get_context('forkserver')
        self._context.set_forkserver_preload(['robustness.kills_preload'])
        self._sent: list[int] = []
        self._heard = 0
        #: longest that a thread of the process waited for a processor, while it was at work
        self._starved_s = 0.0
        self._undelivered = 0
        self._client: Any = None
        self.renew_client()
        shutil.rmtree(out / 'episode', ignore_errors=True)
        self._episode = make_episode(out, compressed=False)
        if not (out / 'checkpoint').exists():
            ros().make_checkpoint(out / 'checkpoint')

    def kill(self, name: str, number: int) -> Killed:
        """Start and kill one of `VICTIMS`, at the moment that belongs to the number."""
        rng = np.random.default_rng([self._seed, number])
        after_s = float(rng.uniform(0, self._longest_s))
        is_starting = rng.random() < STARTING
        prepare, words, is_ready, check = VICTIMS[name]
        self._heard = 0
        prepare(self)
        log = self._out / f'{name}.log'
        process = self._start(name, words(self), log)
        self._sent.clear()
        problem, self._undelivered = '', 0
        if not is_starting:
            end = time.monotonic() + START_S
            while not is_ready(self, log) and process.exitcode is None:
                self._client.spin_for(0.02)
                if time.monotonic() > end:
                    problem = f'it was not at work after {START_S:g} s'
                    break
        before_s = max(starved_s(process.pid).values(), default=0.0)
        self._client.spin_for(after_s)
        if process.exitcode is not None:
            problem = f'it had ended with {process.exitcode}'
        self._starved_s = max(starved_s(process.pid).values(), default=0.0) - before_s
        process.kill()
        killed_ns = time.time_ns()
        process.join(10)
        begin = time.monotonic()
        try:
            check(self, log, killed_ns)
        except (AssertionError, EpisodeError) as error:
            problem = f'{type(error).__name__}: {error}'
        if 'Traceback' in log.read_text(errors='replace'):
            problem = log.read_text(errors='replace')[-2000:]
        return Killed(after_s, problem, time.monotonic() - begin, self._undelivered)

    def renew_client(self) -> None:
        """One that never knew who was killed: others take 20 s to forget a node."""
        if self._client is not None:
            self._client.close()
        self._client = ros().Client()
        node = self._client.node
        self._joints = node.create_publisher(ros().JOINT_STATE, '/joints', 1000)
        node.create_timer(PERIOD_S, self._publish)
        node.create_subscription(ros().JOINT_STATE, '/joint_states', lambda _: self._hear(), 10)

    def close(self) -> None:
        """End the client."""
        self._client.close()

    def _publish(self) -> None:
        stamp_ns = time.time_ns()
        self._sent.append(stamp_ns)
        self._joints.publish(ros().make_joint_state(stamp_ns))

    def _hear(self) -> None:
        self._heard += 1

    def _start(self, name: str, words: list[str], log: Path) -> Any:
        log.unlink(missing_ok=True)  # what the one before said says nothing of this one
        process = self._context.Process(target=run_forked, args=(name, words, str(log)))
        process.start()
        end = time.monotonic() + START_S
        while not log.exists() and time.monotonic() < end:
            time.sleep(0.01)
        return process

    # recorder

    def clear_bags(self) -> None:
        """Remove the bags of the kill before."""
        for path in [self._out / 'bag', *self._out.glob('.bag.*')]:
            shutil.rmtree(path, ignore_errors=True)

    def recorder_words(self) -> list[str]:
        """Record what the client publishes."""
        return [str(self._out / 'bag'), '/joints']

    def check_recorder(self, log: Path, killed_ns: int) -> None:
        """Every message that was received until a second before the kill is in the bag."""
        if ': recording' not in log.read_text(errors='replace'):
            return  # killed while starting
        announced = re.search(r'\[(\d+)\.(\d{9})\] \[recorder\]: recording', log.read_text())
        assert announced is not None
        begin_ns = int(announced[1]) * 10**9 + int(announced[2])
        until = killed_ns - round((1.0 + self._starved_s) * 1e9)
        notes = np.fromfile(f'{log}{RECEIVED}', np.int64)
        received = {
            int(stamp): int(at) for stamp, at in zip(notes[::2], notes[1::2], strict=False)
        }
        self._undelivered = sum(begin_ns < at < until and at not in received for at in self._sent)
        bags = [recover(source) for source in find_damaged(self._out / 'bag')]
        with AnyReader([bags[0].path]) as bag:
            got = {read_stamp(data) for _, _, data in bag.messages()}
        due = [stamp for stamp, at in received.items() if at < until]
        lost = [index for index, stamp in enumerate(due) if stamp not in got]
        assert not lost, (
            f'{len(lost)} of {len(due)} messages received more than a second ago are lost: '
            f'{lost[:20]}; {len(got)} are there; a thread of it waited {self._starved_s:.2f} s '
            'for a processor'
        )

    def says(self, text: str, log: Path) -> bool:
        """Whether the log has the text."""
        return text in log.read_text(errors='replace')

    # player

    def is_playing(self, log: Path) -> bool:
        """Whether something was heard of it."""
        return self._heard > 0

    def player_words(self) -> list[str]:
        """Play to anybody, faster than it was recorded."""
        return [str(self._episode), '--no-wait', '--loop', '--rate', '4']

    def check_player(self, log: Path, killed_ns: int) -> None:
        """Who listened goes on; what was played is whole (it could be deserialised)."""
        self._client.spin_for(0.02)

    # policy node

    def policy_words(self) -> list[str]:
        """The fake policy, of the fake model's sizes."""
        values = (f'checkpoint:={self._out / "checkpoint"}',
                  f'calibration_file:={self._out / "calibration.yaml"}',
                  'diagnostics_period_s:=0.2')  # fmt: skip
        return ['--ros-args', *(part for value in values for part in ('-p', value))]

    # world model

    def begin_plan(self, log: Path) -> bool:
        """Once the node is ready, sends a plan: the kill comes while it is imagined, or after."""
        if not self.says('ready: ', log):
            return False
        self._client.connect_inputs(ros().INPUTS)
        self._client.send_scene()
        self._client.send_trajectory()
        return True

    def node_words(self) -> list[str]:
        """The fake model."""
        values = (f'calibration_file:={self._out / "calibration.yaml"}', 'pace:=burst',
                  'diagnostics_period_s:=0.2', 'max_image_age_s:=10.0',
                  'max_joint_state_age_s:=10.0')  # fmt: skip
        return ['--ros-args', *(part for value in values for part in ('-p', value))]

    def check_node(self, log: Path, killed_ns: int) -> None:
        """Another one answers a plan, with one end."""
        self.renew_client()
        process = self._start('world_model', self.node_words(), log)
        try:
            self._client.connect_inputs(ros().INPUTS)
            since = len(self._client.report_values())
            self._client.send_scene()
            self._client.send_trajectory()
            ended = self._client.next_end(since)
            assert ended['state'] == 'done', ended
        finally:
            process.kill()
            process.join(10)


def _nothing(*_: object) -> None:
    pass


#: name -> what is done before, its command line, whether it is at work, what is looked at after
VICTIMS: dict[str, tuple[Callable[..., Any], ...]] = {
    'recorder': (
        Kills.clear_bags,
        Kills.recorder_words,
        lambda kills, log: kills.says(': recording', log),
        Kills.check_recorder,
    ),
    'player': (_nothing, Kills.player_words, Kills.is_playing, Kills.check_player),
    'policy': (
        _nothing,
        Kills.policy_words,
        lambda kills, log: kills.says('ready: ', log),
        _nothing,
    ),
    'world_model': (Kills.renew_client, Kills.node_words, Kills.begin_plan, Kills.check_node),
}


def main() -> int:
    """Kill; 1 if something was wrong afterwards."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').splitlines()[0])
    parser.add_argument('--kills', type=int, default=500, help='of all together')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--longest', type=float, default=2.0, help='latest moment [s]')
    parser.add_argument('--only', nargs='+', choices=VICTIMS, default=list(VICTIMS))
    parser.add_argument('--out', type=Path, default=ROOT / 'out' / 'kills')
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    file = arguments.out / 'kills.json'
    rows = {row['kind']: row for row in json.loads(file.read_text())} if file.is_file() else {}
    print(f'seed {arguments.seed}', flush=True)
    kills = Kills(arguments.out, arguments.seed, arguments.longest)
    for number in range(sum(row['tried'] for row in rows.values()), arguments.kills):
        name = arguments.only[number % len(arguments.only)]
        row = rows.setdefault(f'kill of {name}', new_row(name, arguments.seed))
        done = kills.kill(name, number)
        row['tried'] += 1
        row['worst_s'] = max(row['worst_s'], done.seconds)
        row['undelivered'] += bool(done.undelivered)
        if done.problem:
            row['failures'][str(number)] = done.problem
            print(f'kill {number}, {name}: {done.problem}', flush=True)
        file.write_text(json.dumps(list(rows.values()), indent=1))
    kills.close()
    for row in rows.values():
        print(
            f'{row["kind"]}: {row["tried"]} tried, {len(row["failures"])} failed; in '
            f'{row["undelivered"]}, messages older than a second had not been delivered',
            flush=True,
        )
    return int(any(row['failures'] for row in rows.values()))


def new_row(name: str, seed: int) -> dict[str, Any]:
    """The row of what was not killed yet."""
    return {'kind': f'kill of {name}', 'seed': seed, 'commit': commit(), 'tried': 0,
            'worst_s': 0.0, 'undelivered': 0, 'failures': {}}  # fmt: skip


if __name__ == '__main__':
    raise SystemExit(main())
