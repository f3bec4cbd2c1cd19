"""Result pages: what ran, where and when, and a Markdown table."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from datetime import date
import os
from pathlib import Path
import platform
import time

import numpy as np


def parse_arguments(
    text: str | None,
    repeats: int,
    more: Callable[[argparse.ArgumentParser], None] = lambda parser: None,
) -> argparse.Namespace:
    """The options that all benchmarks share, --repeats, --seed, --machine, --out, and `more`."""
    parser = argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--repeats', type=int, default=repeats, help='n of each median')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument(
        '--machine', default=f'cpu{os.cpu_count()}', help='name of the machine on the page'
    )
    parser.add_argument('--out', type=Path, help='folder to write the page into')
    more(parser)
    return parser.parse_args()


def measure(
    candidates: Mapping[str, Callable[[], object]], repeats: int
) -> dict[str, tuple[float, float, float]]:
    """Returns median, 5th and 95th percentile of the CPU time [ms] of each candidate.

    They take turns, so that whatever else the machine does meets all of them; CPU time of this
    process, which other work on the machine lengthens less than wall time.
    """
    for candidate in candidates.values():
        candidate()
    spent = {name: [] for name in candidates}
    for _ in range(repeats):
        for name, candidate in candidates.items():
            begun = time.process_time()
            candidate()
            spent[name].append(1e3 * (time.process_time() - begun))
    return {
        name: (float(np.median(t)), float(np.percentile(t, 5)), float(np.percentile(t, 95)))
        for name, t in spent.items()
    }


def machine_line() -> str:
    """Processor, cores and versions."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path('/proc/cpuinfo')
    if cpuinfo.is_file():
        names = [row for row in cpuinfo.read_text().splitlines() if row.startswith('model name')]
        model = names[0].split(':', 1)[1].strip() if names else model
    load = f', load {os.getloadavg()[0]:.1f}' if hasattr(os, 'getloadavg') else ''
    return f'{model}, {os.cpu_count()} cores{load}; Python {platform.python_version()}'


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Returns a Markdown table."""
    lines = [header, ['---'] * len(header), *rows]
    return '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines)


def publish(
    what: str, title: str, command: str, body: str, options: argparse.Namespace, versions: str
) -> None:
    """Prints the page, and writes `<what>_<machine>_<date>.md` where --out is given."""
    today = date.today().isoformat()
    page = (
        f'# {title}\n\n`{command}`, machine `{options.machine}` ({machine_line()}, {versions}), '
        f'{today}, seed {options.seed}, n = {options.repeats}.\n\n{body}\n'
    )
    print(page)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        path = options.out / f'{what}_{options.machine}_{today}.md'
        beside = path.with_suffix('.part')
        beside.write_text(page, encoding='utf-8')
        beside.replace(path)
        print(f'written: {path}')
