"""Fuzz of everything that is read from outside: `make fuzz` prints what became of it, by kind.

Every case is made from a seed that is printed: `--seed N --kind K --case C` repeats it. A case is
rejected with an error of the package, or survived (read). Anything else (another error, more time
or memory than the budget, a plan that would be imagined from implausible input) is a failure: it
is printed, and the exit status is 1. Each kind runs in a process of its own, whose memory is
limited. With `--json FILE`, what was interrupted goes on where it was.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
import json
import multiprocessing
import os
from pathlib import Path
import queue
import resource
import signal
import tempfile
import time
import traceback
from typing import Any, NamedTuple

import numpy as np

from mtv_world_ros.core.errors import MtvWorldError
from robustness.file_kinds import Kind, KINDS, MOST_S
from robustness.node_messages import commit

#: a process that takes more memory ends
MOST_BYTES = 2 * 2**30
#: one that says nothing for this long hangs [s]: no signal ended it
MOST_SILENT_S = 150 * MOST_S
#: rows are kept this often [s]
SAVE_S = 5.0
#: in place of a case: not even what is whole was read
NOT_STARTED = 'start'
#: how processes are made
START = 'spawn'


class Outcome(NamedTuple):
    """What became of one case: `rejected`, `survived`, or the failure."""

    name: str
    seconds: float
    megabytes: float


@contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    def stop(*_: object) -> None:
        raise TimeoutError(f'more than {seconds:g} s')

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


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
    """Let the reader import what it needs, which is not its time; what is whole must be read."""
    kind.read(samples[0], folder)
    with suppress(Exception):
        kind.read(make_case(kind, samples, 0, 0), folder)


def _run(name: str, seed: int, cases: Iterable[int], results: Any) -> None:
    """Try the cases of a kind; put (case, outcome) into the queue, at last None."""
    kind = KINDS[name]
    silence()
    with tempfile.TemporaryDirectory() as folder:
        try:
            samples = kind.samples()
            warm_up(kind, samples, Path(folder))
        except BaseException:
            results.put((NOT_STARTED, Outcome(traceback.format_exc(), 0.0, 0.0)))
            return
        base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        used = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MOST_BYTES, used + MOST_BYTES))
        for case in cases:
            data = make_case(kind, samples, seed, case)
            results.put((case, None))
            outcome, seconds = attempt(kind, data, Path(folder))
            more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - base) / 1024
            results.put((case, Outcome(outcome, seconds, more)))
    results.put(None)


def silence() -> None:
    """Libraries say of every damaged file what they think of it: thousands of lines."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    os.close(null)


def new_row(name: str, seed: int) -> dict[str, Any]:
    """The row of a kind of which no case was tried."""
    counts: dict[str, Any] = dict.fromkeys(('tried', 'rejected', 'survived'), 0)
    return {'kind': name, 'seed': seed, 'commit': commit(), **counts} | {
        'worst_s': 0.0, 'worst_mb': 0.0, 'wall_s': 0.0, 'failures': {}
    }  # fmt: skip


def fuzz(row: dict[str, Any], cases: range, save: Callable[[], None] = lambda: None) -> None:
    """Try cases of a kind and add what became of them to its row.

    A process that dies or hangs costs its case, and another goes on after it.

    Args:
        row: of `new_row`, or of an earlier call.
        cases: numbers.
        save: called now and then.
    """
    row['failures'].pop(NOT_STARTED, None)
    with tempfile.TemporaryDirectory(prefix='mtv_world_fuzz_') as folder, _temporary(folder):
        _fuzz(row, cases, save)


@contextmanager
def _temporary(folder: str) -> Iterator[None]:
    """Processes that are started write into a folder: they are killed, and remove nothing."""
    before = os.environ.get('TMPDIR')
    os.environ['TMPDIR'] = folder
    try:
        yield
    finally:
        del os.environ['TMPDIR']
        os.environ |= {} if before is None else {'TMPDIR': before}


def _fuzz(row: dict[str, Any], cases: range, save: Callable[[], None]) -> None:
    spawn = multiprocessing.get_context(START)
    while cases:
        results = spawn.Queue()
        words = (row['kind'], row['seed'], cases, results)
        process = spawn.Process(target=_run, args=words, daemon=True)
        process.start()
        last = _collect(row, process, results, save)
        process.kill()
        process.join()
        if last is None:
            break
        row['failures'].setdefault(str(last), 'the process hung or died')
        if last == NOT_STARTED:
            break  # nor would it be for the next case
        row['tried'] += 1
        cases = range(int(last) + 1, cases.stop)


def _collect(
    row: dict[str, Any], process: Any, results: Any, save: Callable[[], None]
) -> int | str | None:
    """Add outcomes to the row; the case with which the process died or hung, or None."""
    current: int | str = NOT_STARTED
    saved = begin = time.monotonic()
    silent_s = 0.0
    while True:
        try:
            item = results.get(timeout=1.0)
        except queue.Empty:
            silent_s += 1.0
            if process.is_alive() and silent_s < MOST_SILENT_S:
                continue
            return current
        silent_s = 0.0
        if item is None:
            row['wall_s'] += time.monotonic() - begin
            return None
        current, outcome = item
        if outcome is not None:
            _add(row, current, outcome)
        if time.monotonic() - saved > SAVE_S:
            row['wall_s'] += time.monotonic() - begin
            saved = begin = time.monotonic()
            save()


def _add(row: dict[str, Any], case: int | str, outcome: Outcome) -> None:
    row['tried'] += case != NOT_STARTED
    row['worst_s'] = max(row['worst_s'], outcome.seconds)
    row['worst_mb'] = max(row['worst_mb'], outcome.megabytes)
    if outcome.name in ('rejected', 'survived'):
        row[outcome.name] += 1
    else:
        row['failures'][str(case)] = outcome.name


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
    """Fuzz the kinds that are asked for; 1 if anything failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seed', type=int, default=int(time.time()))
    parser.add_argument(
        '--count',
        type=int,
        default=500,
        help='cases a kind; a tenth of checkpoints, four times as many messages',
    )
    parser.add_argument('--kind', nargs='+', choices=KINDS, default=list(KINDS))
    parser.add_argument('--case', type=int, help='try this case alone')
    parser.add_argument(
        '--json', type=Path, help='keep the rows here; what is there already is not tried again'
    )
    arguments = parser.parse_args()
    rows = _stored(arguments.json)
    for name in arguments.kind:
        row = rows.setdefault(name, new_row(name, arguments.seed))
        print(f"seed {row['seed']}, kind '{name}'", flush=True)
        count = max(round(arguments.count * KINDS[name].share), 1)
        if arguments.case is not None:
            fuzz(row, range(arguments.case, arguments.case + 1))
        else:
            fuzz(row, range(row['tried'], count), partial(_store, arguments.json, rows))
        _store(arguments.json, rows)
        for case, text in row['failures'].items():
            print(f"--seed {row['seed']} --kind '{name}' --case {case}\n{text}", flush=True)
    print(table(list(rows.values())))
    return int(any(row['failures'] for row in rows.values()))


def _stored(file: Path | None) -> dict[str, dict[str, Any]]:
    rows = json.loads(file.read_text()) if file is not None and file.is_file() else []
    return {row['kind']: row for row in rows}


def _store(file: Path | None, rows: dict[str, dict[str, Any]]) -> None:
    if file is not None:
        part = file.with_suffix('.part')
        part.write_text(json.dumps(list(rows.values()), indent=1))
        part.replace(file)


if __name__ == '__main__':
    raise SystemExit(main())
