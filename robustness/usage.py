"""What processes take: memory, threads, descriptors, waits for a processor; growth and plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
import os
from pathlib import Path

import numpy as np

LABELS = {
    'memory_mb': 'memory [MB]',
    'processes': 'processes',
    'descriptors': 'file descriptors',
    'threads': 'threads',
}


def descendants(pid: int) -> list[int]:
    """Process numbers of all children and theirs."""
    found = []
    for file in Path(f'/proc/{pid}/task').glob('*/children'):
        try:
            own = [int(number) for number in file.read_text().split()]
        except OSError:
            continue
        for child in own:
            found += [child, *descendants(child)]
    return found


def usage(pid: int) -> dict[str, float]:
    """Memory of a process and its descendants; its descriptors and threads."""
    total = 0
    for one in (pid, *descendants(pid)):
        with suppress(OSError):  # it ended
            lines = Path(f'/proc/{one}/status').read_text().splitlines()
            total += sum(int(line.split()[1]) for line in lines if line.startswith('VmRSS'))
    return {
        'memory_mb': total / 1024,
        'processes': 1 + len(descendants(pid)),
        'descriptors': len(os.listdir(f'/proc/{pid}/fd')),
        'threads': len(os.listdir(f'/proc/{pid}/task')),
    }


def starved_s(pid: int) -> dict[str, float]:
    """How long each thread of a process has waited for a processor so far [s]."""
    waits = {}
    for file in Path(f'/proc/{pid}/task').glob('*/schedstat'):
        with suppress(OSError):  # it ended
            waits[file.parent.name] = int(file.read_text().split()[1]) / 1e9
    return waits


def slope(rows: Sequence[Mapping[str, float]], x: str, y: str, least: int) -> float:
    """Growth of one column with another; NaN of fewer than `least` rows."""
    if len(rows) < least:
        return float('nan')
    return float(np.polyfit([row[x] for row in rows], [row[y] for row in rows], 1)[0])


def plot(
    rows: Sequence[Mapping[str, float]],
    x: str,
    x_label: str,
    labels: Mapping[str, str],
    path: Path,
) -> None:
    """Columns over another one, with a red line wherever `kills` grows."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    size = (9, 2 * len(labels))
    figure, grid = pyplot.subplots(len(labels), sharex=True, squeeze=False, figsize=size)
    axes = grid[:, 0]
    for axis, (key, label) in zip(axes, labels.items(), strict=True):
        axis.plot([row[x] for row in rows], [row[key] for row in rows], '.', markersize=2)
        axis.set_ylabel(label)
        axis.set_ylim(0, 1.1 * max(row[key] for row in rows))
        for before, row in pairwise(rows):
            if row.get('kills', 0) > before.get('kills', 0):
                axis.axvline(row[x], color='tab:red', linewidth=0.5)
    axes[-1].set_xlabel(x_label)
    figure.savefig(path, bbox_inches='tight')
    pyplot.close(figure)
