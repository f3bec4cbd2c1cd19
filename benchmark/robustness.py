"""What became of damaged input, kills and rollouts with faults: a page of what the harness wrote.

    make fuzz kills soak
    python benchmark/robustness.py out/fuzz.json out/kills/kills.json --soak out/soak --out DIR

Rows of one kind in several files are added up. Beside the page stands the plot of the soak.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
import shutil
from typing import Any

import numpy as np
from page import parse_arguments, publish, table

HEAD = ('kind', 'tried', 'rejected', 'survived', 'failed', 'worst time [s]', 'worst memory [MB]')


def add_up(files: list[Path]) -> dict[str, dict[str, Any]]:
    """The rows of all files by kind."""
    rows: dict[str, dict[str, Any]] = {}
    for file in files:
        for row in json.loads(file.read_text()):
            known = rows.setdefault(row['kind'], dict.fromkeys(HEAD[1:5], 0))
            failed, tried = len(row['failures']), row['tried']
            known['tried'] += tried
            known['rejected'] += row.get('rejected', 0)
            known['survived'] += row.get('survived', tried - failed)
            known['failed'] += failed
            for key in ('worst_s', 'worst_mb'):
                if key in row:
                    known[key] = max(known.get(key, 0.0), row[key])
    return rows


def line(kind: str, row: dict[str, Any]) -> list[str]:
    """Cells of a kind."""
    worst = [f'{row[key]:.{digits}f}' if key in row else '–'
             for key, digits in (('worst_s', 2), ('worst_mb', 0))]  # fmt: skip
    return [kind, *(str(row[key]) for key in HEAD[1:5]), *worst]


def commits_text(files: list[Path]) -> str:
    """At which commits the rows were made."""
    kinds: dict[str, set[str]] = {}
    for file in files:
        for row in json.loads(file.read_text()):
            kinds.setdefault(row['commit'], set()).add(row['kind'])
    counted = (f'`{commit}` ({len(names)} kinds)' for commit, names in kinds.items())
    return f'Rows are of the commits {", ".join(counted)}.'


def soak_text(folder: Path) -> str:
    """What the soak found, in a sentence or two."""
    summary = json.loads((folder / 'summary.json').read_text())
    problems = '; '.join(summary['problems']) or 'none'
    growth = summary['memory_growth_mb_per_1000']
    grown = 'too few rollouts to say' if not np.isfinite(growth) else f'{growth:.2f} MB'
    return (
        f'Soak: {summary["rollouts"]} rollouts over the wire with faults injected, '
        f'{summary["kills"]} kills, seed {summary["seed"]}, commit `{summary["commit"]}`. '
        f'Growth of memory for 1,000 rollouts: {grown}. Problems: {problems}.'
    )


def main() -> None:
    """Makes the page."""

    def more(parser: argparse.ArgumentParser) -> None:
        parser.add_argument('rows', type=Path, nargs='+', help='what --json and kills wrote')
        parser.add_argument('--soak', type=Path, nargs='+', default=[], help='folders of soaks')

    options = parse_arguments(__doc__, 1, more)
    rows = add_up(options.rows)
    total = {key: sum(row[key] for row in rows.values()) for key in HEAD[1:5]}
    cells = [line(kind, row) for kind, row in rows.items()]
    body = [table(HEAD, [*cells, line('all', total)])]
    body.append(
        'Fuzz: in process, each kind in a process of its own; time is of the processor, memory '
        'what the process grew by. ROS messages go through the checks of the node in process. '
        'Rejected = refused with an error of the package; survived = read, and for messages: '
        'plausible by numbers of the harness. Kills: time is that until a node that was started '
        'after the killed one had answered a plan, or a bag was recovered and read by rosbags.'
    )
    body.append(commits_text(options.rows))
    for index, folder in enumerate(options.soak):
        body.append(soak_text(folder))
        if options.out:
            name = f'robustness_soak{index or ""}_{options.machine}.png'
            shutil.copy(folder / 'soak.png', options.out / name)
            body.append(f'![Memory, threads, descriptors and latency over rollouts]({name})')
    publish(
        'robustness', 'Damaged input, kills and rollouts with faults',
        'python benchmark/robustness.py', '\n\n'.join(body), options, 'rclpy over Fast DDS',
    )  # fmt: skip


if __name__ == '__main__':
    main()
