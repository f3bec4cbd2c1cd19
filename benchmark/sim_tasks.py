"""Simulated tasks: how often does the expert succeed, what is seen, how much moves?

    mtv-world collect --task all --episodes 10 --seed 0 --out data/sim
    python benchmark/sim_tasks.py data/sim [--out benchmark/results] [--machine NAME]

Reads the written episodes. Expert success is the share of attempts that succeeded before failed
ones were dropped, of the episodes that were to succeed. Visible: share of the frames in which any
pixel of an object is seen, mean over objects and episodes, and the least of any object of any
episode. J: the first frame's true masks held, against the true masks of all later frames; over all
objects, and over those that leave their place (successes alone: a miss moves nothing).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
import json
import os
from pathlib import Path

import numpy as np
from page import publish, table

from mtv_world_ros.data.mcap_reader import read_episode
from mtv_world_ros.sim.dataset_card import CARD_FILE, EpisodeEntry, read_entry
from mtv_world_ros.sim.dataset_readme import commands
from mtv_world_ros.sim.episode_measures import EpisodeMeasures, measure
from mtv_world_ros.success.jaccard import mean_of_known

HEAD = (
    'task', 'episodes', 'expert success', 'length [s]', 'frames', 'objects',
    'visible low', 'visible high', 'J all low', 'J all high', 'J moving low', 'J moving high',
)  # fmt: skip


def _visible(measures: Iterable[EpisodeMeasures], view: int) -> str:
    shares = np.concatenate([item.visible[view] for item in measures])
    return f'{100 * shares.mean():.1f} % (least {100 * shares.min():.0f} %)'


def _mean(values: Iterable[float]) -> str:
    return f'{float(mean_of_known(np.array(list(values)))):.3f}'


def _row(
    name: str, entries: Sequence[EpisodeEntry], measures: Sequence[EpisodeMeasures]
) -> list[str]:
    pairs = list(zip(entries, measures, strict=True))
    successes = [(e, m) for e, m in pairs if e.outcome == 'success']
    attempts = sum(entry.attempt + 1 for entry, _ in successes)
    rate = f'{100 * len(successes) / attempts:.0f} % of {attempts}' if attempts else '-'
    views = range(2)
    return [
        name,
        f'{len(entries)} ({len(successes)} succeed)',
        rate,
        f'{np.mean([entry.duration_s for entry in entries]):.1f}',
        f'{np.mean([entry.num_frames for entry in entries]):.0f}',
        f'{np.mean([len(entry.objects) for entry in entries]):.1f}',
        *(_visible(measures, view) for view in views),
        *(_mean(m.copy_all()[view] for _, m in pairs) for view in views),
        *(_mean(m.copy_moving()[view] for _, m in successes) for view in views),
    ]


def main() -> None:
    """Prints the table of a collected data set, and writes it as a result page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('dataset', type=Path)
    parser.add_argument('--machine', default=f'cpu{os.cpu_count()}')
    parser.add_argument('--out', type=Path, help='folder to write the page into')
    options = parser.parse_args()
    card = json.loads((options.dataset / CARD_FILE).read_text())
    entries = [read_entry(options.dataset / entry['name']) for entry in card['episodes']]
    measures = [
        measure(read_episode(options.dataset / entry.name, with_cameras=False))
        for entry in entries
    ]
    groups: dict[str, list[int]] = {}
    for number, entry in enumerate(entries):
        groups.setdefault(' '.join(filter(None, (entry.zero_shot, entry.task))), []).append(number)
    rows = [
        _row(name, [entries[i] for i in chosen], [measures[i] for i in chosen])
        for name, chosen in groups.items()
    ]
    rows.append(_row('all', entries, measures))
    made = '\n'.join(commands(card, entries))
    explained = (__doc__ or '').split('\n\n')[-1]
    options.seed, options.repeats = card['seed'], len(entries)
    publish(
        'sim_tasks',
        'The simulated tasks',
        'python benchmark/sim_tasks.py DIR',
        f'The episodes were made by\n\n```\n{made}\n```\n\n{explained}\n{table(HEAD, rows)}',
        options,
        f'MuJoCo {_version("mujoco")}',
    )


def _version(package: str) -> str:
    from importlib import metadata

    return metadata.version(package)


if __name__ == '__main__':
    main()
