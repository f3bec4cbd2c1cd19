"""What became of damaged input, kills and rollouts with faults: a page of what the harness wrote.

    make fuzz kills soak attacks
    python experiments/robustness_page.py out/fuzz.json out/kills/kills.json --out DIR
        --soak out/soak --rate out/rate --cycles out/cycles --worlds out/odd_worlds
        --servers out/servers.json --interrupts out/interrupts/interrupts.json

Rows of one kind in several files are added up. Beside the page stand the plots of soak and cycles.
`--before` and the like take the same of an earlier commit, for a table beside.
"""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path
import shutil
from typing import Any

import numpy as np
from page import parse_arguments, publish, table

#: an end that comes later than this after its plan is late [s], as in `rate.py`
LATE_S = 2.0
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


def plans_table(folders: list[Path]) -> str:
    """What became of plans at a rate, a row a run."""
    keys = ('model', 'commit', 'plans', 'without_end', 'several_ends', 'late', 'median_s', 'p95_s',
            'p99_s', 'worst_s', 'stopped_answers', 'stopped_worst_s', 'worst_by_end_s',
            'worst_on_quiet_cores_s', 'load', 'tracebacks',
            'memory_growth_mb_per_1000')  # fmt: skip
    rows = [json.loads((folder / 'rate.json').read_text()) for folder in folders]
    return table(
        ('model', 'commit', 'plans', 'no end', 'several ends', 'late', 'median [s]', '95 % [s]',
         '99 % [s]', 'worst [s]', 'through a stop', 'worst of these, net [s]', 'worst by end [s]',
         'worst without waiting for a processor [s]', 'load', 'tracebacks',
         'memory [MB for 1,000]'),
        [[_cell(row.get(key, '–')) for key in keys] for row in rows],
    )  # fmt: skip


def ends_table(folder: Path) -> str:
    """How long plans of a run waited for each kind of end, net of stops of the node."""
    with (folder / 'ends.csv').open() as file:
        ends = list(csv.DictReader(file))
    kinds: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for end in ends:
        stopped_s, starved_s = float(end['stopped_s']), float(end['starved_s'])
        net_s = float(end['waited_s']) - stopped_s
        kind = (end['state'], 'yes' if stopped_s else 'no')
        kinds.setdefault(kind, []).append((net_s, max(net_s - starved_s, 0.0)))
    rows = []
    for kind, times in sorted(kinds.items()):
        net, quiet = np.array(times).T
        worst = (*np.quantile(net, (0.5, 0.95, 0.99, 1.0)), np.median(quiet), quiet.max())
        rows.append([*kind, str(len(net)), str((net > LATE_S).sum()), *map(_cell, worst)])
    head = ('end', 'through a stop', 'plans', 'late', 'median [s]', '95 % [s]', '99 % [s]',
            'worst [s]', 'median without waiting for a processor [s]',
            'worst of these [s]')  # fmt: skip
    return table(head, rows)


def cycles_table(folders: list[Path]) -> str:
    """What grew over lifecycle cycles, a row a run."""
    rows = []
    for folder in folders:
        found = json.loads((folder / 'cycles.json').read_text())
        ends = [found[end] for end in ('first', 'last')]
        spans = [f'{ends[0][key]:.0f} → {ends[1][key]:.0f}'
                 for key in ('memory_mb', 'descriptors', 'threads')]  # fmt: skip
        grown = found['growth_a_cycle']['memory_mb']
        most, failed = found['most_processes'], len(found['problems'])
        half = _cell(_growth_of_last_half(folder / 'cycles.csv'))
        rows.append([found['commit'], found['cycles'], *spans, f'{grown:.2f}', half, most, failed])
    head = ('commit', 'cycles', 'memory [MB]', 'descriptors', 'threads',
            'growth, warm [MB a cycle]', 'of the last half', 'most processes',
            'problems')  # fmt: skip
    return table(head, [[str(cell) for cell in row] for row in rows])


def _growth_of_last_half(file: Path) -> float:
    """Of the memory [MB a cycle]."""
    with file.open() as table_of_cycles:
        rows = [
            (float(r['cycle']), float(r['memory_mb'])) for r in csv.DictReader(table_of_cycles)
        ]
    cycle, megabytes = np.array(rows[len(rows) // 2 :]).T
    return float(np.polyfit(cycle, megabytes, 1)[0])


def worlds_table(folder: Path) -> str:
    """What became of plans in odd worlds."""
    keys = ('world', 'plans', 'without_end', 'several_ends', 'unknown_ends', 'tracebacks',
            'worst_s', 'ends')  # fmt: skip
    rows = json.loads((folder / 'odd_worlds.json').read_text())
    return table(
        ('world', 'plans', 'no end', 'several', 'of others', 'tracebacks', 'worst [s]', 'ends'),
        [[_cell(row[key]) for key in keys] for row in rows],
    )


def servers_table(file: Path) -> str:
    """What became of questions to policy servers that misbehave."""
    keys = ('server', 'tried', 'answered', 'refused', 'recovered', 'worst_s', 'failures')
    rows = json.loads(file.read_text())
    return table(
        ('server', 'tried', 'answered', 'refused', 'answered next', 'worst [s]', 'failed'),
        [[_cell(row[key]) for key in keys] for row in rows],
    )


def children_table(folders: list[Path]) -> str:
    """How what waits for a child that is stopped or killed ended, a row a kind."""
    keys = ('kind', 'commit', 'tried', 'done', 'said', 'worst_s', 'failures')
    rows = [row for at in folders for row in json.loads((at / 'children.json').read_text())]
    return table(
        ('child', 'commit', 'tried', 'done', 'said', 'worst [s]', 'failed'),
        [[_cell(row[key]) for key in keys] for row in rows],
    )


def interrupts_table(file: Path) -> str:
    """How commands that were interrupted ended, a row a command."""
    keys = ('kind', 'commit', 'tried', 'stopped', 'done', 'worst_s', 'failures')
    return table(
        ('command', 'commit', 'tried', 'stopped, whole when run again', 'done before',
         'worst [s]', 'failed'),
        [[_cell(row[key]) for key in keys] for row in json.loads(file.read_text())],
    )  # fmt: skip


def _cell(value: Any) -> str:
    if isinstance(value, dict):
        return ', '.join(f'{key} {count}' for key, count in value.items())
    if isinstance(value, list):
        return str(len(value))
    return f'{value:.2f}' if isinstance(value, float) else str(value)


def attacks_text(options: argparse.Namespace) -> list[str]:
    """The tables of what was run beside the fuzz."""
    body = []
    if options.before:
        cells = [line(kind, row) for kind, row in add_up(options.before).items()]
        body += ['## The same attacks before', table(HEAD, cells), commits_text(options.before)]
    if options.rate:
        body += ['## Plans at 10 Hz, with bursts and a node that is stopped now and then',
                 plans_table(options.rate), ends_table(options.rate[-1])]  # fmt: skip
    if options.cycles:
        body += ['## Lifecycle cycles with the bundled model', cycles_table(options.cycles)]
        if options.out:
            name = f'robustness_cycles_{options.machine}.png'
            shutil.copy(options.cycles[-1] / 'cycles.png', options.out / name)
            body.append(f'![Memory, processes and descriptors over cycles]({name})')
    for title, given, make in (
        ('Odd worlds', options.worlds, worlds_table),
        ('Children that are stopped or killed', options.children, children_table),
        ('Commands that are interrupted', options.interrupts, interrupts_table),
        ('Policy servers that misbehave', options.servers, servers_table),
    ):
        if given:
            body += [f'## {title}', make(given)]
    return body


def main() -> None:
    """Make the page."""

    def more(parser: argparse.ArgumentParser) -> None:
        parser.add_argument('rows', type=Path, nargs='+', help='what --json and kills wrote')
        parser.add_argument('--soak', type=Path, nargs='+', default=[], help='folders of soaks')

        several: dict[str, Any] = {'type': Path, 'nargs': '+', 'default': []}
        parser.add_argument('--before', **several, help='rows of an earlier commit')
        parser.add_argument('--rate', **several, help='folders of rate.py, the earliest first')
        parser.add_argument('--cycles', **several, help='folders of cycles.py, likewise')
        parser.add_argument('--worlds', type=Path, help='folder of odd_worlds.py')
        parser.add_argument('--children', **several, help='folders of children.py')
        parser.add_argument('--interrupts', type=Path, help='what interrupts.py wrote')
        parser.add_argument('--servers', type=Path, help='what policy_servers.py wrote')

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
    body += attacks_text(options)
    publish(
        'robustness', 'Damaged input, kills and rollouts with faults',
        'python experiments/robustness_page.py', '\n\n'.join(body), options, 'rclpy over Fast DDS',
    )  # fmt: skip


if __name__ == '__main__':
    main()
