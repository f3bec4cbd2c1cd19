"""Fuzz of everything that is read from outside: `make fuzz` prints what became of it, by kind.

Every case is made from a seed that is printed: `--seed N --kind K --case C` repeats it. A case is
rejected with an error of the package, or survived (read). Anything else (another error, more time
or memory than the budget, a plan that would be imagined from implausible input) is a failure: it
is printed, and the exit status is 1. Each kind runs in a process of its own, whose memory is
limited. The first cases of a kind are those of the corpus, which once were accidents.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager, suppress
import json
import multiprocessing
from pathlib import Path
import resource
import signal
import tempfile
import time
import traceback
from typing import Any, NamedTuple

from file_kinds import Kind, KINDS, MOST_S
import numpy as np

from mtv_world_ros.errors import MtvWorldError

#: a process that takes more memory ends
MOST_BYTES = 2 * 2**30


class Outcome(NamedTuple):
    """What became of one case: `rejected`, `survived`, or the failure."""

    name: str
    seconds: float
    megabytes: float


@contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    def stop(*_: object) -> None:
        raise TimeoutError(f'more than {seconds:g} s')

    signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def attempt(kind: Kind, data: Any, folder: Path) -> tuple[str, float]:
    """Name of the outcome and the processor's time it took [s]."""
    begin = time.process_time()
    try:
        with _time_limit(30 * MOST_S):  # of the clock: machines may be busy
            kind.read(data, folder)
        name = 'survived'
    except MtvWorldError:
        name = 'rejected'
    except BaseException:
        name = traceback.format_exc()
    seconds = time.process_time() - begin
    return (f'took {seconds:.1f} s' if seconds > kind.most_s else name), seconds


def make_case(kind: Kind, samples: list[Any], seed: int, case: int) -> Any:
    """The damaged input of a number."""
    return kind.damage(samples, np.random.default_rng([seed, case]))


def warm_up(kind: Kind, samples: list[Any], folder: Path) -> None:
    """Lets the reader import what it needs, which is not its time."""
    with suppress(MtvWorldError):
        kind.read(samples[0], folder)
    with suppress(Exception):
        kind.read(make_case(kind, samples, 0, 0), folder)


def _run(name: str, seed: int, count: int, only: int | None, results: Any) -> None:
    """Tries the cases of a kind; puts (case, outcome) into the queue, at last None."""
    kind = KINDS[name]
    samples = kind.samples()
    with tempfile.TemporaryDirectory() as folder:
        warm_up(kind, samples, Path(folder))
        base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        used = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MOST_BYTES, used + MOST_BYTES))
        for case in range(count) if only is None else (only,):
            data = make_case(kind, samples, seed, case)
            results.put((case, None))
            outcome, seconds = attempt(kind, data, Path(folder))
            more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - base) / 1024
            results.put((case, Outcome(outcome, seconds, more)))
    results.put(None)


def fuzz(name: str, seed: int, count: int, only: int | None = None) -> dict[str, Any]:
    """Tries cases of a kind; returns a row of the table and the failures.

    A process that dies costs its case, and another goes on after it.
    """
    spawn = multiprocessing.get_context('spawn')
    results = spawn.Queue()
    row: dict[str, Any] = {'kind': name, 'tried': 0, 'rejected': 0, 'survived': 0}
    row |= {'worst_s': 0.0, 'worst_mb': 0.0, 'failures': {}}
    process = spawn.Process(target=_run, args=(name, seed, count, only, results), daemon=True)
    process.start()
    current = None
    while True:
        try:
            item = results.get(timeout=120 * MOST_S)
        except Exception:  # empty: it hangs so that no signal ends it
            process.kill()
            row['failures'][current] = 'the process hung or died'
            break
        if item is None:
            break
        current, outcome = item
        if outcome is None:
            continue
        row['tried'] += 1
        row['worst_s'] = max(row['worst_s'], outcome.seconds)
        row['worst_mb'] = max(row['worst_mb'], outcome.megabytes)
        if outcome.name in ('rejected', 'survived'):
            row[outcome.name] += 1
        else:
            row['failures'][current] = outcome.name
    process.join(10)
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as a Markdown table."""
    head = '| kind | tried | rejected | survived | failed | worst time [s] | worst memory [MB] |'
    lines = [head, '|---|---|---|---|---|---|---|']
    for row in rows:
        lines.append(
            f'| {row["kind"]} | {row["tried"]} | {row["rejected"]} | {row["survived"]} | '
            f'{len(row["failures"])} | {row["worst_s"]:.2f} | {row["worst_mb"]:.0f} |'
        )
    return '\n'.join(lines)


def main() -> int:
    """Fuzzes the kinds that are asked for; 1 if anything failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seed', type=int, default=int(time.time()))
    parser.add_argument(
        '--count',
        type=int,
        default=500,
        help='cases a kind; fewer of slow kinds, 20 times as many messages',
    )
    parser.add_argument('--kind', nargs='+', choices=KINDS, default=list(KINDS))
    parser.add_argument('--case', type=int, help='try this case alone')
    parser.add_argument('--json', type=Path, help='write the rows here')
    arguments = parser.parse_args()
    print(f'seed {arguments.seed}', flush=True)
    rows = []
    for name in arguments.kind:
        count = max(round(arguments.count * KINDS[name].share), 1)
        rows.append(fuzz(name, arguments.seed, count, arguments.case))
        for case, text in rows[-1]['failures'].items():
            print(f"--seed {arguments.seed} --kind '{name}' --case {case}\n{text}", flush=True)
    print(table(rows))
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))
    return int(any(row['failures'] for row in rows))


if __name__ == '__main__':
    raise SystemExit(main())
