"""Soak of the node: rollouts with faults injected, while memory, threads and latency are watched.

`make soak` runs 10,000 rollouts (an hour); `--rollouts N` fewer. Between plans, images are
damaged, joints jump, names repeat, the model crashes, runs out of memory or is pre-empted,
subscribers come and go, and every now and then the node is killed and started again. Every plan
must get exactly one end. Writes `soak.csv`, `soak.png` and a summary; the exit status is 1 if an
end is missing or doubled, the node died by itself, or memory grows.
"""

from __future__ import annotations

import argparse
from contextlib import suppress
import csv
import json
from pathlib import Path
import time
from typing import Any

import numpy as np

from robustness.node_messages import commit, ROOT, ros
from robustness.usage import LABELS, plot, slope, usage

ENDS = ('done', 'preempted', 'rejected', 'failed', 'reset')
OUT_OF_MEMORY, CRASHES = 1100, 1300
#: growth that is allowed [MB for 1,000 rollouts]
MOST_GROWTH_MB = 1.0
#: column of the CSV -> label in the plot
PLOTTED = {**LABELS, 'latency_s': 'plan to last end [s]'}
#: rollouts after which all is written again
WRITE_EVERY = 500
#: rollouts before memory counts: caches and pools fill
WARM = 200


class Soak:
    """One node after the other, a client that sends plans, and what was measured.

    Args:
        ros: module of the client.
        out: folder of logs and results.
        seed: of the faults.
    """

    def __init__(self, ros: Any, out: Path, seed: int) -> None:
        self._ros, self._out = ros, out
        self.latency_s = 0.0
        self._seed, self._rng = seed, np.random.default_rng(seed)
        self._client = ros.Client()
        self._node: Any = None
        self._extra: list[Any] = []
        self.rows: list[dict[str, float]] = []
        self.kills = self.num_rollouts = 0
        self.problems: list[str] = []

    def run(self, count: int, kill_every: int) -> None:
        """Send `count` plans; what was measured is written now and then."""
        self._start()
        for index in range(count):
            if kill_every and index and index % kill_every == 0:
                self._kill()
            self._one(index)
            self.num_rollouts += 1
            if index % 10 == 0:
                self.rows.append({'rollout': index, **self._usage()})
            if self.num_rollouts % WRITE_EVERY == 0:
                self.write()
        code = self._node.stop()
        if code:
            self.problems.append(f'the node ended with {code}')
        self._client.close()

    def write(self) -> dict[str, Any]:
        """Write rows, plot and summary; return the summary."""
        with (self._out / 'soak.csv').open('w', newline='') as file:
            writer = csv.DictWriter(file, self.rows[0])
            writer.writeheader()
            writer.writerows(self.rows)
        words = 'rollout; red = the node is killed and started again'
        plot(self.rows, 'rollout', words, PLOTTED, self._out / 'soak.png')
        summary = {
            'seed': self._seed,
            'commit': commit(),
            'rollouts': self.num_rollouts,
            'kills': self.kills,
            'memory_growth_mb_per_1000': growth(self.rows),
            'problems': self.problems,
        }
        (self._out / 'summary.json').write_text(json.dumps(summary, indent=1))
        return summary

    def _start(self) -> None:
        self._node = self._ros.start_node_process(self._out, 'pace:=burst')
        self._client.connect_inputs(self._ros.INPUTS)
        self._client.send_scene()

    def _kill(self) -> None:
        """At a random moment of a rollout; nobody waits for the end of that one."""
        self._client.send_trajectory()
        self._client.spin_for(float(self._rng.uniform(0, 0.3)))
        self._node.process.kill()
        self._node.process.wait()
        self._client.forget_node()
        self.kills += 1
        self._start()

    def _one(self, index: int) -> None:
        """A plan with or without a fault, and its one end."""
        since = len(self._client.report_values())
        fault = FAULTS[self._rng.integers(len(FAULTS))]
        begin = time.monotonic()
        sent = fault(self, self._ros, self._client)
        try:
            self._client.wait(lambda: self._num_ends(since) >= sent, 'the end of a plan', 60)
        except AssertionError as error:
            self.problems.append(f'rollout {index}, {fault.__name__}: {error}')
        self._client.spin_for(0.05)
        ends = self._num_ends(since)
        if ends != sent:
            self.problems.append(f'rollout {index}, {fault.__name__}: {ends} ends of {sent}')
        if self._node.process.poll() is not None:
            self.problems.append(f'rollout {index}, {fault.__name__}: the node died')
            self._start()
        self.latency_s = time.monotonic() - begin
        for received in self._client.received.values():
            del received[:-20]

    def _num_ends(self, since: int) -> int:
        return sum(v['state'] in ENDS for v in self._client.report_values()[since:])

    def _usage(self) -> dict[str, float]:
        own = {'latency_s': self.latency_s, 'kills': self.kills}
        return {**usage(self._node.process.pid), **own}

    def come_and_go(self) -> None:
        """A subscriber of images comes, or the oldest goes."""
        if len(self._extra) > 2:
            self._client.node.destroy_subscription(self._extra.pop(0))
        topic = '/world_model/low/predicted/image_raw'
        self._extra.append(
            self._client.node.create_subscription(self._ros.IMAGE, topic, lambda _: None, 4)
        )


def plain(soak: Soak, ros: Any, client: Any) -> int:
    """Nothing is wrong."""
    client.send_scene()
    client.send_trajectory()
    return 1


def damaged_image(soak: Soak, ros: Any, client: Any) -> int:
    """Too little data; the image before is used."""
    now_ns = client.now_ns()
    client.send_scene(image_low=ros.make_image('low', now_ns, data=b'\0' * 10))
    client.send_trajectory()
    return 1


def wild_joints(soak: Soak, ros: Any, client: Any) -> int:
    """Measured joints that cannot be."""
    wild = ros.HOME * 1e300
    client.send_scene(joints=ros.make_joint_state(client.now_ns(), positions=wild))
    client.send_trajectory()
    return 1


def wild_plan(soak: Soak, ros: Any, client: Any) -> int:
    """A plan of positions that are no numbers."""
    client.send_scene()
    client.send_trajectory(positions=np.full((4, 14), np.nan))
    return 1


def crash(soak: Soak, ros: Any, client: Any) -> int:
    """The model raises."""
    return _with_seed(CRASHES, client)


def out_of_memory(soak: Soak, ros: Any, client: Any) -> int:
    """The model runs out of memory."""
    return _with_seed(OUT_OF_MEMORY, client)


def _with_seed(seed: int, client: Any) -> int:
    client.set(seed=seed)
    client.send_scene()
    client.send_trajectory()
    client.spin_for(0.3)
    client.set(seed=0)
    return 1


def burst(soak: Soak, ros: Any, client: Any) -> int:
    """Three plans at once: each gets an end."""
    client.send_scene()
    for _ in range(3):
        client.send_trajectory()
    return 3


def subscriber(soak: Soak, ros: Any, client: Any) -> int:
    """Subscribers come and go in a rollout."""
    soak.come_and_go()
    return plain(soak, ros, client)


def reset(soak: Soak, ros: Any, client: Any) -> int:
    """`~/reset` in a rollout."""
    sent = plain(soak, ros, client)
    client.reset()
    return sent


def clock_jump(soak: Soak, ros: Any, client: Any) -> int:
    """Images and joints of an hour ago: stale."""
    client.send_scene(client.now_ns() - 3600 * 10**9)
    client.send_trajectory()
    return 1


FAULTS = (
    plain, plain, plain, plain, damaged_image, wild_joints, wild_plan, crash, out_of_memory, burst,
    subscriber, reset, clock_jump,
)  # fmt: skip


def growth(rows: list[dict[str, float]]) -> float:
    """Growth of memory [MB for 1,000 rollouts] of the node that ran longest, once it is warm."""
    best: list[dict[str, float]] = []
    for kills in {row['kills'] for row in rows}:
        own = [row for row in rows if row['kills'] == kills]
        own = [row for row in own if row['rollout'] - own[0]['rollout'] >= WARM]
        best = max(best, own, key=len)
    return slope(best, 'rollout', 'memory_mb', 5) * 1000


def main() -> int:
    """Run the soak; 1 if something was lost, died or grew."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').splitlines()[0])
    parser.add_argument('--rollouts', type=int, default=10_000)
    parser.add_argument('--kill-every', type=int, default=1_000, help='0 = never')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--out', type=Path, default=ROOT / 'out' / 'soak')
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    soak = Soak(ros(), arguments.out, arguments.seed)
    with suppress(KeyboardInterrupt):  # what was measured until then is written
        soak.run(arguments.rollouts, arguments.kill_every)
    summary = soak.write()
    print(json.dumps(summary, indent=1))
    grown = summary['memory_growth_mb_per_1000']
    return int(bool(soak.problems) or grown > MOST_GROWTH_MB)


if __name__ == '__main__':
    raise SystemExit(main())
