"""Lifecycle cycles of the node: processes, memory and descriptors must be flat.

A cycle is deactivate, cleanup, configure, activate; in every few of them a plan is imagined, so
that all that is made for one is made. Prints a row, writes `cycles.csv` and `cycles.png`; the exit
status is 1 if a child process is left, memory or descriptors grow, or the log has a traceback.
"""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path
import sys
import time
from typing import Any

from robustness.node_messages import commit, ROOT, ros
from robustness.usage import LABELS, plot, slope, usage

#: growth that is allowed, once caches are filled [MB a cycle, descriptors a cycle]
MOST_MB, MOST_DESCRIPTORS = 0.3, 0.02
#: the first share of the cycles fills caches and pools
WARM = 0.3
#: cycles in which a plan is imagined
PLAN_EVERY = 3
#: cycles between two writings of the table, so that a run that is cut off shows what it did
WRITE_EVERY = 10
#: a busy machine takes long to load a model [s]
PATIENCE_S = 180.0
NODE = ('-m', 'mtv_world_ros.ros.world_model.node')
PLOTTED = {**LABELS, 'memory_mb': 'memory of all [MB]', 'seconds': 'a cycle [s]'}


class Cycles:
    """A node that is taken through its states."""

    def __init__(self, out: Path, *, bundled: bool) -> None:
        program = {'program': NODE} if bundled else {}
        self.out, self.rows = out, [dict[str, float]()][:0]
        self.process = ros().start_node_process(out, 'pace:=burst', **program)
        self.client = ros().Client()
        self.client.wait(self.client.diagnostic_values, 'the node', PATIENCE_S)
        self.client.connect_inputs(ros().INPUTS)
        self.problems: list[str] = []

    def run(self, count: int, most_s: float = float('inf')) -> None:
        """Go through so many cycles, or as many as the time allows."""
        from lifecycle_msgs.msg import Transition

        kinds = ('DEACTIVATE', 'CLEANUP', 'CONFIGURE', 'ACTIVATE')
        end_s = time.monotonic() + most_s
        for number in range(count):
            begin_s = time.monotonic()
            if begin_s > end_s:
                break
            for kind in kinds:
                if not self._change(getattr(Transition, f'TRANSITION_{kind}')):
                    self.problems.append(f'cycle {number}: {kind.lower()} failed')
            seconds = time.monotonic() - begin_s
            if number % PLAN_EVERY == 0:
                self._imagine(number)
            row = {'cycle': number, **usage(self.process.process.pid), 'seconds': seconds}
            self.rows.append(row)
            if number % WRITE_EVERY == 0:
                self.write()

    def _change(self, transition: int) -> bool:
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState

        client = self.client.services.setdefault(
            'change', self.client.node.create_client(ChangeState, '/world_model/change_state')
        )
        request = ChangeState.Request(transition=Transition(id=transition))
        future = client.call_async(request)
        self.client.wait(future.done, 'a transition', PATIENCE_S)
        return bool(future.result().success)

    def _imagine(self, number: int) -> None:
        since = len(self.client.report_values())
        self.client.wait(
            lambda: all(p.get_subscription_count() for p in self.client.publishers.values()),
            'the topics',
        )
        self.client.spin_for(0.1)
        self.client.send_scene()
        self.client.spin_for(0.1)
        self.client.send_trajectory()
        self.client.wait(
            lambda: any(v['state'] in ros().ENDS for v in self.client.report_values()[since:]),
            'the end of a plan',
            PATIENCE_S,
        )
        end = self.client.report_values()[-1]
        if end['state'] == 'failed':
            self.problems.append(f'cycle {number}: {end}')
        for received in self.client.received.values():
            received.clear()

    def summary(self) -> dict[str, Any]:
        """How much grew with a cycle once caches were filled."""
        kept = self.rows[int(WARM * len(self.rows)) :]
        keys = ('memory_mb', 'descriptors', 'threads', 'processes')
        grown = {key: slope(kept, 'cycle', key, 4) for key in keys}
        first, last = self.rows[0], self.rows[-1]
        return {
            'commit': commit(),
            'cycles': len(self.rows),
            'first': first,
            'last': last,
            'growth_a_cycle': grown,
            'most_processes': max(row['processes'] for row in self.rows),
            'worst_cycle_s': max(row['seconds'] for row in self.rows),
            'tracebacks': self.process.output().count('Traceback'),
            'problems': self.problems,
        }

    def write(self) -> None:
        """Write the table."""
        with (self.out / 'cycles.csv').open('w', newline='') as file:
            writer = csv.DictWriter(file, self.rows[0])
            writer.writeheader()
            writer.writerows(self.rows)

    def close(self) -> None:
        """End both."""
        self.process.stop()
        self.client.close()


def main() -> int:
    """Cycles; 1 if something grew, was left or failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').splitlines()[0])
    parser.add_argument('--cases', type=int, default=500, help='cycles')
    parser.add_argument('--seconds', type=float, default=float('inf'), help='stop then')
    parser.add_argument('--bundled', action='store_true', help='the bundled model, not a fake')
    parser.add_argument('--out', type=Path, default=ROOT / 'out' / 'cycles')
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    cycles = Cycles(arguments.out, bundled=arguments.bundled)
    try:
        cycles.run(arguments.cases, arguments.seconds)
        cycles.write()
        plot(
            cycles.rows,
            'cycle',
            'cycle of deactivate, cleanup, configure and activate',
            PLOTTED,
            arguments.out / 'cycles.png',
        )
        found = cycles.summary()
    finally:
        cycles.close()
    sys.stdout.write(json.dumps(found, indent=1) + '\n')
    (arguments.out / 'cycles.json').write_text(json.dumps(found, indent=1))
    grown = found['growth_a_cycle']
    grows = grown['memory_mb'] > MOST_MB or grown['descriptors'] > MOST_DESCRIPTORS
    return int(grows or grown['processes'] > 0 or bool(found['tracebacks'] or found['problems']))


if __name__ == '__main__':
    raise SystemExit(main())
