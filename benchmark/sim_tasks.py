"""Simulated tasks: how often does the expert succeed, what is seen, how much moves?

    mtv-world collect --task all --episodes 10 --seed 0 --out data/sim
    python benchmark/sim_tasks.py data/sim --attempts 40 [--out benchmark/results] [--machine NAME]

Reads the written episodes. Expert success: share of the attempts that succeeded before failed ones
were dropped, of the written episodes that were to succeed; with --attempts also of so many other
seeds a task, without rendering. A seed whose scene or plan is impossible counts as failed.
Visible: share of the frames in which any pixel of an object is seen, mean over objects and
episodes, and the least of any object of any episode. J: the first frame's true masks held, against
the true masks of all later frames; over all objects, and over those that leave their place
(successes alone: a miss moves little).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from contextlib import suppress
import json
import os
from pathlib import Path

import numpy as np
from page import publish, table

from mtv_world_ros.bench.collect.dataset_card import CARD_FILE, CardEntry, read_entry, TASKS_SET
from mtv_world_ros.bench.collect.dataset_readme import commands
from mtv_world_ros.bench.collect.episode_jobs import episode_seed
from mtv_world_ros.bench.collect.episode_maker import CollectConfig
from mtv_world_ros.bench.collect.record import simulate
from mtv_world_ros.bench.episode_measures import EpisodeMeasures, measure
from mtv_world_ros.bench.expert.expert import Expert
from mtv_world_ros.bench.tasks.tasks import task_named
from mtv_world_ros.bench.world.simulator import SimEpisode
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.errors import SimulatorError
from mtv_world_ros.files import bundled
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.vision.jaccard import mean_of_known

#: indices that no data set reaches
OTHER_SEEDS = 1_000_000
HEAD = (
    'task', 'episodes', 'expert success, written', 'other seeds', 'length [s]', 'frames',
    'objects', 'visible low', 'visible high', 'J all low', 'J all high', 'J moving low',
    'J moving high',
)  # fmt: skip


def _visible(measures: Iterable[EpisodeMeasures], view: int) -> str:
    shares = np.concatenate([item.visible[view] for item in measures])
    return f'{100 * shares.mean():.1f} % (least {100 * shares.min():.0f} %)'


def _mean(values: Iterable[float]) -> str:
    mean = float(mean_of_known(np.array(list(values))))
    return '-' if np.isnan(mean) else f'{mean:.3f}'


def _successes(task: str, seed: int, attempts: int) -> int:
    """How many of other seeds than those of the data set the expert brings to success."""
    config = CollectConfig()
    robot = load_robot(bundled('robots', CollectConfig().robot, '--robot'))
    expert = Expert(robot, config.expert)
    sim = SimEpisode(robot, expert.home, config.randomization, rendering=False)
    done = 0
    for number in range(attempts):
        chosen = episode_seed(seed, task, OTHER_SEEDS + number, 0)
        with suppress(SimulatorError):
            take = simulate(sim, expert, task_named(task), chosen, config.record, miss=False)
            done += take.is_as_wanted()
    return done


def _row(
    name: str,
    entries: Sequence[CardEntry],
    measures: Sequence[EpisodeMeasures],
    others: str,
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
        others,
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
    parser.add_argument('--attempts', type=int, default=0, help='other seeds, per task')
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
        groups.setdefault(entry.zero_shot or entry.task, []).append(number)
    attempts = options.attempts if card['kind'] == TASKS_SET else 0
    rows, total = [], 0
    for name, chosen in groups.items():
        others = '-'
        if attempts:
            done = _successes(name, card['seed'], attempts)
            total, others = total + done, f'{100 * done / attempts:.0f} % of {attempts}'
        group = [entries[i] for i in chosen], [measures[i] for i in chosen]
        rows.append(_row(name, *group, others))
    tried = attempts * len(groups)
    others = f'{100 * total / tried:.1f} % of {tried}' if tried else '-'
    rows.append(_row('all', entries, measures, others))
    made = '\n'.join(commands(card, entries))
    explained = (__doc__ or '').split('\n\n')[-1]
    options.seed, options.repeats = card['seed'], len(entries)
    publish(
        'sim_tasks',
        'The simulated tasks',
        f'python benchmark/sim_tasks.py DIR --attempts {attempts}',
        f'The episodes were made by\n\n```\n{made}\n```\n\n{explained}\n{table(HEAD, rows)}',
        options,
        f'MuJoCo {_version("mujoco")}',
    )


def _version(package: str) -> str:
    from importlib import metadata

    return metadata.version(package)


if __name__ == '__main__':
    main()
