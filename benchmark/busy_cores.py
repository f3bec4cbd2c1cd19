"""How fast is imagination where other processes take cores?

    python benchmark/busy_cores.py [--busy 1] [--out benchmark/results]

`mtv-world replay resource/demo_episode --offline` runs in a process of its own: alone, and beside
`--busy` processes that compute all the time, as a policy or a driver may; with threads of torch
that sleep while they wait for one another, which is what this package asks for, and with threads
that spin, which is what torch does if `OMP_WAIT_POLICY` is `ACTIVE`. All four take turns.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
import os
from pathlib import Path
import re
import subprocess
import sys
from tempfile import TemporaryDirectory

import numpy as np
from page import parse_arguments, publish, table
import torch

from mtv_world_ros.files import share_path

POLICIES = {'sleep': 'PASSIVE', 'spin': 'ACTIVE'}
HEAD = ('other processes', 'threads that wait', 'real-time factor, median', 'least', 'most')


def more(parser: argparse.ArgumentParser) -> None:
    """Adds options."""
    parser.add_argument('--busy', type=int, default=1, help='processes beside it')


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Processes that compute all the time, each in a session of its own."""
    loop = [sys.executable, '-c', 'while True: pass']
    started = [subprocess.Popen(loop, start_new_session=True) for _ in range(count)]
    try:
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()


def real_time_factor(wait_policy: str) -> float:
    """Returns that of one replay."""
    with TemporaryDirectory() as folder:
        command = [sys.executable, '-m', 'mtv_world_ros.cli', 'replay', '--offline']
        done = subprocess.run(
            [*command, str(share_path('resource', 'demo_episode')), '--out', f'{folder}/out'],
            env={**os.environ, 'OMP_WAIT_POLICY': wait_policy},
            capture_output=True,
            text=True,
            check=True,
            cwd=Path(__file__).parents[1],
        )
    found = re.search(r'real-time factor ([\d.]+)', done.stdout)
    assert found is not None
    return float(found[1])


def main() -> None:
    """Prints a row for each number of processes and each way to wait, and writes a page."""
    options = parse_arguments(__doc__, 5, more)
    turns = list(product((0, options.busy), POLICIES))
    found: dict[tuple[int, str], list[float]] = {turn: [] for turn in turns}
    for number in range(options.repeats):
        for count, way in turns if number % 2 == 0 else reversed(turns):
            with busy(count):
                found[count, way].append(real_time_factor(POLICIES[way]))
    rows = [
        [str(count), way, *(f'{at:.2f}' for at in np.percentile(factors, (50, 0, 100)))]
        for (count, way), factors in found.items()
    ]
    publish(
        'busy_cores',
        'Imagination beside other processes',
        f'python benchmark/busy_cores.py --busy {options.busy}',
        table(HEAD, rows),
        options,
        f'torch {torch.__version__}',
    )


if __name__ == '__main__':
    main()
