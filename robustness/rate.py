"""Plans at 10 Hz with bursts, for as long as one likes: each gets exactly one end, and in time.

Plans are told apart by their stamps. Between bursts a plan goes out every `1 / --rate` seconds,
and at times the node is stopped for a second (SIGSTOP), as a busy machine does to it: what
arrives meanwhile waits, and nothing of it may be lost. That time is no answer time of the node: it
is taken off, and plans that waited through a stop are counted apart. How long the node waited for
a processor that others had is counted, too. Prints a row; the exit status is 1 if one got no end,
more than one, or one too late, or if the log has a traceback.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
import csv
import json
import os
from pathlib import Path
import signal
import sys
import time
from typing import Any, NamedTuple

import numpy as np

from mtv_world_ros.ros.messages.conversions import NANO, to_ns, values_of
from robustness.node_messages import commit, ROOT, ros
from robustness.usage import starved_s, usage

#: an end that comes later than this after its plan is late, on a machine that is not busy [s]
LATE_S = 2.0
#: a burst, and how often there is one
BURST, BURST_EVERY = 40, 100
#: how often and how long the node is stopped [plans, s]
STOP_EVERY, STOP_S = 250, 1.5
#: ends that are missing are waited for this long [s]
PATIENCE_S = 180.0
#: by then the node's buffers are full: it keeps 256 frames of a view, of which one comes with
#: every tenth plan, and the bundled model's take 10 MB
BUFFERS_FULL = 3000
#: samples from then on, one with every tenth plan, that a line is fitted to
LEAST_SAMPLES = 100
#: images of `--images`
IMAGE_SIZE = (640, 480)
IMAGES = {
    view: np.full((IMAGE_SIZE[1], IMAGE_SIZE[0], 3), 128, np.uint8) for view in ('low', 'high')
}
PLANS, REPORT = '/joint_trajectory', '/world_model/report'
#: what a plan is given to be answered with the bundled model
NODE = ('-m', 'mtv_world_ros.ros.world_model.node')


class Ended(NamedTuple):
    """The end of a plan.

    Attributes:
        sent_s: when the plan was sent [s], of `time.monotonic`.
        waited_s: from then until the end arrived here [s].
        stopped_s: how long of it the node was stopped [s].
        starved_s: how long of it a thread of the node waited for a processor at most [s].
        node_s: until the node said so, by its stamp [s]; the rest is the way back.
        state: of the report.
    """

    sent_s: float
    waited_s: float
    stopped_s: float
    starved_s: float
    node_s: float
    state: str

    @property
    def net_s(self) -> float:
        """How long the node, if it was not stopped, and the way there and back took [s]."""
        return self.waited_s - self.stopped_s

    @property
    def quiet_s(self) -> float:
        """What it would have taken, about, had a processor been free whenever one was needed."""
        return max(self.net_s - self.starved_s, 0.0)


class Rate:
    """A node, a client that sends plans, and the ends of each by its stamp."""

    def __init__(self, out: Path, *, bundled: bool, image_hz: float = 0.0) -> None:
        self.out, self.bundled = out, bundled
        self.image_s = 1 / image_hz if image_hz else 0.0
        self.image_due_s, self.num_images = 0.0, 0
        self.sent: dict[int, tuple[float, dict[str, float]]] = {}
        self.ends: Counter[int] = Counter()
        self.ended: list[Ended] = []
        self.stops: list[tuple[float, float]] = []
        self.memory: list[tuple[int, float]] = []
        self.diagnostics: dict[str, str] = {}
        program = {'program': NODE} if bundled else {}
        values = ('pace:=burst', 'max_horizon_s:=60.0', 'max_trajectory_age_s:=60.0')
        self.process = ros().start_node_process(out, *values, **program)
        self.client = ros().Client()
        self.client.wait(self.client.diagnostic_values, 'the node', PATIENCE_S)
        # a client that is not scheduled for a while would lose ends itself with the usual 100
        self.client.node.create_subscription(ros().REPORT, REPORT, self._take, 10_000)
        topics = {t: kind for t, kind in ros().INPUTS.items() if t != PLANS}
        self.client.connect_inputs(topics)
        # with the usual 10, this side drops the rest of a burst that nobody has taken yet
        self.plans = self.client.node.create_publisher(ros().PLAN, PLANS, 1000)
        self.client.wait(self.plans.get_subscription_count, 'the node')
        self.client.spin_for(1.0)
        if image_hz:
            self._show()
        else:
            self.client.send_scene()

    def send(self) -> None:
        """Send a plan of its own stamp."""
        starved = starved_s(self.process.process.pid)
        stamp_ns = self.client.now_ns()
        self.plans.publish(ros().make_trajectory(stamp_ns=stamp_ns))
        self.sent[stamp_ns] = (time.monotonic(), starved)

    def spin(self, seconds: float) -> None:
        """Take what the node says for so long."""
        end_s = time.monotonic() + seconds
        while True:
            self.client.executor.spin_once(timeout_sec=max(min(end_s - time.monotonic(), 0.02), 0))
            self.diagnostics = self.client.diagnostic_values() or self.diagnostics
            for received in self.client.received.values():
                received.clear()
            if self.image_s and time.monotonic() > self.image_due_s:
                self._show()
            if time.monotonic() > end_s:
                return

    def _show(self) -> None:
        """Publish 640x480 images of both views with what belongs to them."""
        now_s, stamp_ns = time.monotonic(), self.client.now_ns()
        self.image_due_s = max(self.image_due_s + self.image_s, now_s)
        scene = {}
        for view, pixels in IMAGES.items():
            scene[f'image_{view}'] = ros().to_image(pixels, ros().make_header(view, stamp_ns))
            scene[f'info_{view}'] = ros().make_info(view, stamp_ns, size=IMAGE_SIZE)
        self.client.send_scene(stamp_ns, **scene)
        self.num_images += 1

    def _take(self, report: Any) -> None:
        now_s = time.monotonic()
        for values in map(values_of, report.status):
            if values['state'] in ros().ENDS:
                stamp_ns = int(values['trajectory_stamp_ns'])
                self.ends[stamp_ns] += 1
                node_s = (to_ns(report.header.stamp) - stamp_ns) / NANO
                sent_s, before = self.sent.get(stamp_ns, (now_s, {}))
                waits = starved_s(self.process.process.pid)
                starved = max((s - before.get(t, 0.0) for t, s in waits.items()), default=0.0)
                stopped_s = sum(overlap_s((sent_s, now_s), stop) for stop in self.stops)
                self.ended.append(
                    Ended(sent_s, now_s - sent_s, stopped_s, starved, node_s, values['state'])
                )

    def run(self, count: int, rate_hz: float, *, steady: bool = False) -> None:
        """Send so many plans; `steady` = without bursts and stops of the node."""
        burst_every = 0 if steady else BURST_EVERY
        stop_every = 0 if steady else STOP_EVERY
        begin_s, paced = time.monotonic(), 0
        while len(self.sent) < count and self.process.process.poll() is None:
            number = len(self.sent)
            is_burst = burst_every and number % burst_every == 0
            stops = number and stop_every and number % stop_every < (BURST if is_burst else 1)
            stop_s = time.monotonic()
            if stops:
                self.process.process.send_signal(signal.SIGSTOP)
            for _ in range(BURST if is_burst else 1):
                self.send()
            if stops:
                time.sleep(STOP_S)
                self.process.process.send_signal(signal.SIGCONT)
                self.stops.append((stop_s, time.monotonic()))
                begin_s += STOP_S
            if number % 10 == 0:
                if not self.image_s:
                    self.client.send_scene()
                self.memory.append((number, usage(self.process.process.pid)['memory_mb']))
            paced += 1
            self.spin(max(begin_s + paced / rate_hz - time.monotonic(), 0.0))
        end_s = time.monotonic() + PATIENCE_S
        while len(self.ends) < len(self.sent) and time.monotonic() < end_s:
            self.spin(0.2)
        self.spin(1.0)

    @property
    def not_received(self) -> int:
        """Number of plans that the node counts as never received."""
        return int(self.diagnostics.get(f'not_received.{PLANS}', 0))

    def row(self) -> dict[str, Any]:
        """What became of the plans."""
        log = self.process.output()
        waited = [one for one in self.ended if one.stopped_s]
        return {
            'model': 'bundled' if self.bundled else 'small',
            'commit': commit(),
            'plans': len(self.sent),
            'without_end': max(len(set(self.sent) - set(self.ends)) - self.not_received, 0),
            'not_received': self.not_received,
            'memory_mb': usage(self.process.process.pid)['memory_mb'],
            'several_ends': sum(count > 1 for count in self.ends.values()),
            'unknown_ends': len(set(self.ends) - set(self.sent)),
            'late': sum(one.net_s > LATE_S for one in self.ended),
            'late_on_quiet_cores': sum(one.quiet_s > LATE_S for one in self.ended),
            'images_a_view': self.num_images,
            'stops': len(self.stops),
            **answer_times([one for one in self.ended if not one.stopped_s], ''),
            **answer_times(waited, 'stopped_'),
            'worst_by_end_s': {
                state: round(max(one.net_s for one in self.ended if one.state == state), 2)
                for state in sorted({one.state for one in self.ended})
            },
            'worst_on_quiet_cores_s': max((one.quiet_s for one in self.ended), default=None),
            'load': os.getloadavg()[0],
            'memory_growth_mb_per_1000': growth(self.memory),
            'tracebacks': log.count('Traceback'),
            'died': self.process.process.poll() is not None,
        }

    def write(self) -> None:
        """Write when each end came, and the memory over plans."""
        for name, head, rows in (
            ('ends.csv', Ended._fields, self.ended),
            ('memory.csv', ('plan', 'memory_mb'), self.memory),
        ):
            with (self.out / name).open('w', newline='') as file:
                csv.writer(file).writerows([head, *rows])

    def close(self) -> None:
        """End both."""
        self.process.stop()
        self.client.close()


def overlap_s(one: tuple[float, float], other: tuple[float, float]) -> float:
    """How long both last [s], each from a begin to an end."""
    return max(min(one[1], other[1]) - max(one[0], other[0]), 0.0)


def answer_times(ended: Sequence[Ended], name: str) -> dict[str, Any]:
    """How many there are, and how long they waited net of stops of the node [s]."""
    seconds = [one.net_s for one in ended]
    shares = {'median_s': 0.5, 'p95_s': 0.95, 'p99_s': 0.99, 'worst_s': 1.0}
    times = {key: float(np.quantile(seconds, q)) if seconds else None for key, q in shares.items()}
    return {f'{name}{key}': value for key, value in {'answers': len(seconds), **times}.items()}


def growth(memory: Sequence[tuple[int, float]]) -> float | str:
    """Growth for 1,000 plans once buffers are full [MB], or why it was not measured."""
    kept = [row for row in memory if row[0] >= BUFFERS_FULL]
    if len(kept) < LEAST_SAMPLES:
        return f'not measured: {memory[-1][0] if memory else 0} plans'
    number, megabytes = np.array(kept).T
    return float(np.polyfit(number, megabytes, 1)[0]) * 1000


def main() -> int:
    """Send; 1 if a plan was lost, late or answered twice."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').splitlines()[0])
    parser.add_argument('--cases', type=int, default=20_000, help='plans')
    parser.add_argument('--rate', type=float, default=10.0, help='[Hz]')
    parser.add_argument('--images', type=float, default=0.0, help='640x480 of both views [Hz]')
    parser.add_argument('--steady', action='store_true', help='no bursts, and no stops')
    parser.add_argument('--bundled', action='store_true', help='the bundled model, not a fake')
    parser.add_argument('--busy', action='store_true', help='the machine is busy: late is allowed')
    parser.add_argument('--out', type=Path, default=ROOT / 'out' / 'rate')
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    rate = Rate(arguments.out, bundled=arguments.bundled, image_hz=arguments.images)
    try:
        rate.run(arguments.cases, arguments.rate, steady=arguments.steady)
        row = rate.row()
        rate.write()
    finally:
        rate.close()
    sys.stdout.write(json.dumps(row, indent=1) + '\n')
    (arguments.out / 'rate.json').write_text(json.dumps(row, indent=1))
    wrong = ('without_end', 'several_ends', 'unknown_ends', 'tracebacks', 'died')
    return int(any(row[key] for key in wrong) or (row['late'] > 0 and not arguments.busy))


if __name__ == '__main__':
    raise SystemExit(main())
