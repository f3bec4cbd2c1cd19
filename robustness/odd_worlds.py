"""Worlds that are odd around a node that is well: each plan still gets exactly one stated end.

Clocks that jump in mid-chunk under `use_sim_time`, cameras of one image a second, plans of a
minute, cameras that swap their views, two nodes in namespaces, and with two players. The model is
a fake that takes its time. Prints a table; the exit status is 1 if a plan got no end or several,
an end that is a defect of the node (`internal_error`), or if a node died or wrote a traceback.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
import json
from pathlib import Path
import shutil
import signal
import sys
import time
from typing import Any

import numpy as np

from robustness.children import make_episode
from robustness.node_messages import commit, ROOT, ros

#: this seed's chunks take 0.3 s
SLOW = 1400
HOUR_NS = 3600 * 10**9
PATIENCE_S = 120.0


class World:
    """A node, a client, and the ends of plans by their stamps."""

    def __init__(self, out: Path, *parameters: str, space: str = '', sim_time: bool = False):
        self.space = space
        values = ('pace:=burst', *parameters, f'use_sim_time:={str(sim_time).lower()}')
        remaps = (f'__ns:=/{space}',) if space else ()
        out.mkdir(parents=True, exist_ok=True)
        self.process = ros().start_node_process(out, *values, remaps=remaps)
        self.client = ros().Client()
        report = f'/{space}/world_model/report' if space else '/world_model/report'
        if space:
            self.client.subscribe(ros().REPORT, report, 1000)
        self.report = report
        self.plans: dict[int, float] = {}
        self.ends: Counter[int] = Counter()
        self.states: Counter[str] = Counter()
        self.worst_s = 0.0
        topics = {f'/{space}{t}' if space else t: kind for t, kind in ros().INPUTS.items()}
        if sim_time:
            from rosgraph_msgs.msg import Clock

            self.clock = self.client.node.create_publisher(Clock, '/clock', 10)
            self.now_ns = time.time_ns()
            self.tick(0)
        for topic, kind in topics.items():
            self.client.publishers[topic] = self.client.node.create_publisher(kind, topic, 100)
        self.client.wait(
            lambda: all(p.get_subscription_count() for p in self.client.publishers.values()),
            'the node',
            PATIENCE_S,
        )
        self.spin(1.0)

    def tick(self, ns: int) -> None:
        """Move the simulated clock and says so."""
        from rosgraph_msgs.msg import Clock

        self.now_ns += ns
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(self.now_ns, 10**9)
        self.clock.publish(message)

    def send(self, topic: str, message: Any) -> None:
        """Publish in the node's namespace."""
        self.client.publishers[f'/{self.space}{topic}' if self.space else topic].publish(message)

    def scene(self, stamp_ns: int, *, swapped: bool = False) -> None:
        """What cameras and arms say; `swapped`: each camera is the other."""
        for view, other in zip(ros().VIEWS, reversed(ros().VIEWS), strict=True):
            shown = other if swapped else view
            self.send(f'/{view}/camera_info', ros().make_info(shown, stamp_ns))
            self.send(f'/{view}/image_raw', ros().make_image(shown, stamp_ns))
        self.send('/joint_states', ros().make_joint_state(stamp_ns))

    def plan(self, stamp_ns: int, **fields: Any) -> None:
        """Send a plan, which is told apart by its stamp."""
        while stamp_ns in self.plans:
            stamp_ns += 1000
        self.plans[stamp_ns] = time.monotonic()
        self.send('/joint_trajectory', ros().make_trajectory(stamp_ns=stamp_ns, **fields))

    def follow(self) -> None:
        """Count plans that others send in the namespace."""

        def take(message: Any) -> None:
            stamp = message.header.stamp
            self.plans[stamp.sec * 10**9 + stamp.nanosec] = time.monotonic()

        topic = f'/{self.space}/joint_trajectory'
        self.client.node.create_subscription(ros().PLAN, topic, take, 1000)

    def spin(self, seconds: float) -> None:
        """Take what is said for so long."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            self.client.executor.spin_once(timeout_sec=0.02)
            self.count()

    def count(self) -> None:
        """Count the ends that came."""
        from mtv_world_ros.ros.messages.conversions import values_of

        for status in self.client.statuses(self.report):
            values = values_of(status)
            if values['state'] in ros().ENDS:
                stamp_ns = int(values['trajectory_stamp_ns'])
                self.ends[stamp_ns] += 1
                self.states[values.get('reason') or values['state']] += 1
                late_s = time.monotonic() - self.plans.get(stamp_ns, time.monotonic())
                self.worst_s = max(self.worst_s, late_s)
        self.client.received[self.report].clear()

    def settle(self) -> None:
        """Wait for the ends that are missing."""
        end_s = time.monotonic() + PATIENCE_S
        while len(self.ends) < len(self.plans) and time.monotonic() < end_s:
            self.spin(0.1)
        self.spin(0.5)

    def close(self) -> dict[str, Any]:
        """End all; what became of the plans."""
        self.settle()
        died = self.process.process.poll() is not None
        code = self.process.stop()
        self.client.close()
        return {
            'plans': len(self.plans),
            'without_end': len(set(self.plans) - set(self.ends)),
            'several_ends': sum(count > 1 for count in self.ends.values()),
            'unknown_ends': len(set(self.ends) - set(self.plans)),
            'tracebacks': self.process.output().count('Traceback'),
            'died': bool(died or code),
            'worst_s': self.worst_s,
            'ends': dict(self.states),
        }


def clock_jumps(out: Path, count: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """The clock jumps by seconds or hours, either way, while a chunk is computed."""
    world = World(out, f'seed:={SLOW}', sim_time=True)
    for _ in range(count):
        world.tick(10**7)
        world.scene(world.now_ns)
        world.spin(0.1)
        world.plan(world.now_ns)
        world.spin(float(rng.uniform(0, 0.5)))
        jump = int(rng.choice([-1, 1])) * int(rng.choice([10**8, 10**9, 10**10, HOUR_NS]))
        world.tick(max(jump, 10**9 - world.now_ns))
        if rng.random() < 0.5:  # a plan of the time before the jump
            world.plan(world.now_ns - jump)
        world.spin(0.2)
    return [world.close()]


def slow_cameras(out: Path, count: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """One image a second, plans three times as often."""
    world = World(out, 'max_image_age_s:=0.5', 'max_joint_state_age_s:=0.5')
    for number in range(count):
        if number % 3 == 0:
            world.scene(world.client.now_ns())
        world.spin(0.02)
        world.plan(world.client.now_ns())
        world.spin(0.3)
    return [world.close()]


def long_plans(out: Path, count: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Plans of a minute, and of a little more."""
    world = World(out)
    for number in range(count):
        world.scene(world.client.now_ns())
        world.spin(0.1)
        seconds = float(rng.choice([59.5, 60.0, 61.0, 120.0]))
        times = np.linspace(0, seconds, int(rng.choice([3, 600])))[1:]
        world.plan(world.client.now_ns(), times=times)
        # every other one has the time to end
        waited_s = time.monotonic() + (20.0 if number % 2 else float(rng.uniform(0, 1)))
        while len(world.ends) < len(world.plans) and time.monotonic() < waited_s:
            world.spin(0.1)
    return [world.close()]


def swapped_cameras(out: Path, count: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Each camera is the other from one scene to the next."""
    world = World(out)
    for _ in range(count):
        world.scene(world.client.now_ns(), swapped=bool(rng.random() < 0.5))
        world.spin(0.05)
        world.plan(world.client.now_ns())
        world.spin(0.2)
    return [world.close()]


def namespaces(out: Path, count: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Two nodes, each with its own cameras and plans: no end of the one is said by the other."""
    worlds = [World(out / space, space=space) for space in ('left_cell', 'right_cell')]
    for _ in range(count):
        for world in worlds:
            world.scene(world.client.now_ns())
            world.spin(0.05)
            world.plan(world.client.now_ns())
            world.spin(float(rng.uniform(0, 0.2)))
    return [world.close() for world in worlds]


def players(out: Path, count: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Two nodes, and two players of an episode in a loop: so many plans of each, in lock-step."""
    spaces = ('left_cell', 'right_cell')
    worlds = [World(out / space, space=space) for space in spaces]
    for world in worlds:
        world.follow()
    shutil.rmtree(out / 'episode', ignore_errors=True)
    episode = make_episode(out, compressed=False)
    words = [sys.executable, '-m', 'mtv_world_ros.ros.bags.player', str(episode), '--loop']
    words += ['--lock-step', '--rate', '2', '--wait-timeout', '60', '--ros-args', '-r']
    processes = [
        ros().NodeProcess([*words, f'__ns:=/{space}'], out / space / 'player.log')
        for space in spaces
    ]
    end_s = time.monotonic() + PATIENCE_S + 3 * count
    while min(len(w.plans) for w in worlds) < count and time.monotonic() < end_s:
        for world in worlds:
            world.spin(0.05)
    codes = [process.stop(signal.SIGINT) for process in processes]
    rows = [world.close() for world in worlds]
    for row, code, process in zip(rows, codes, processes, strict=True):
        row['died'] |= code not in (0, 130)
        row['tracebacks'] += process.output().count('Traceback')
    return rows


WORLDS: dict[str, Callable[[Path, int, np.random.Generator], list[dict[str, Any]]]] = {
    'clock jumps in mid-chunk': clock_jumps,
    'one image a second': slow_cameras,
    'plans of a minute': long_plans,
    'cameras that swap': swapped_cameras,
    'two nodes in namespaces': namespaces,
    'two nodes and two players in namespaces': players,
}
#: what must be 0
WRONG = ('without_end', 'several_ends', 'unknown_ends', 'tracebacks', 'died')


def main() -> int:
    """Go through the worlds; 1 if a plan was not answered once."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').splitlines()[0])
    parser.add_argument('--cases', type=int, default=200, help='of each world')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--only', nargs='+', choices=WORLDS, default=list(WORLDS))
    parser.add_argument('--out', type=Path, default=ROOT / 'out' / 'odd_worlds')
    arguments = parser.parse_args()
    rows = []
    for name in arguments.only:
        rng = np.random.default_rng(arguments.seed)
        folder = arguments.out / name.replace(' ', '_')
        for row in WORLDS[name](folder, arguments.cases, rng):
            rows.append({'world': name, 'commit': commit(), **row})
            sys.stdout.write(json.dumps(rows[-1]) + '\n')
            sys.stdout.flush()
    (arguments.out / 'odd_worlds.json').write_text(json.dumps(rows, indent=1))
    bad = any(row[key] for row in rows for key in WRONG)
    return int(bad or any('internal_error' in row['ends'] for row in rows))


if __name__ == '__main__':
    raise SystemExit(main())
