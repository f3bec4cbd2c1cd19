"""What is in a collected set: per task expert success, length, visibility, and how much moves.

    mtv-world collect --task all --episodes 4 --seed 9000 --out DATASET
    python benchmark/sim_tasks.py DATASET [--machine NAME] [--out benchmark/results]

Read from the episodes: true masks of both views at the recorded size, MCAP metadata.

- expert: successes per attempt at a success, seeds that were dropped included;
- visible: share of the frames, first one included, in which an object shows at least one pixel;
- J held: Jaccard index of the first frame's masks with those of all later frames, over all
  objects, and over those that moved (J of first and last mask below a half).
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np
from page import machine_line, table
from tqdm import tqdm

from mtv_world_ros.data.mcap_reader import list_episodes, read_episode
from mtv_world_ros.success.jaccard import jaccard

VIEWS = ('low', 'high')


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeFigures:
    """One episode: outcome, attempts, frames, and per view and object what its masks say."""

    outcome: str
    attempts: int
    num_frames: int
    seconds: float
    visible: np.ndarray  # (V, O) share of frames
    held: np.ndarray  # (V, O) mean J of the first mask with the later ones
    moved: np.ndarray  # (V, O) bool


def figures_of(path: Path) -> EpisodeFigures:
    """Reads one episode."""
    episode = read_episode(path)
    visible, held, moved = [], [], []
    num = len(episode.images[VIEWS[0]].stamps_ns)
    for view in VIEWS:
        ids = np.stack([np.asarray(frame) for frame in episode.masks[view].frames])
        row: list[tuple[float, float, bool]] = []
        for index in range(1, len(episode.info.objects) + 1):
            masks = ids == index
            scores = jaccard(masks[:1], masks[1:])
            row.append((float(masks.any((1, 2)).mean()), float(scores.mean()), scores[-1] < 0.5))
        shares, scores, changes = zip(*row, strict=True)
        visible.append(shares)
        held.append(scores)
        moved.append(changes)
    stamps = episode.images[VIEWS[0]].stamps_ns
    return EpisodeFigures(
        outcome=episode.info.outcome,
        attempts=int(episode.info.metadata['attempt']) + 1,
        num_frames=num,
        seconds=(stamps[-1] - stamps[0]) * 1e-9,
        visible=np.array(visible),
        held=np.array(held),
        moved=np.array(moved, bool),
    )


def row_of(task: str, found: list[EpisodeFigures]) -> list[str]:
    """One line of the table."""
    wins = [item for item in found if item.outcome == 'success']
    attempts = sum(item.attempts for item in wins)
    line = [
        task,
        f'{len(wins)} + {len(found) - len(wins)}',
        f'{len(wins)}/{attempts}' if wins else '-',
        f'{np.mean([item.num_frames for item in found]):.0f}',
        f'{np.mean([item.seconds for item in found]):.1f}',
    ]
    for v in range(len(VIEWS)):
        shares = np.concatenate([item.visible[v] for item in found])
        moving = np.concatenate([item.held[v][item.moved[v]] for item in found])
        line += [
            f'{shares.mean():.3f} ({shares.min():.2f})',
            f'{np.mean(np.concatenate([item.held[v] for item in found])):.3f}',
            f'{moving.mean():.3f} ({len(moving)})' if len(moving) else '-',
        ]
    return line


def main() -> None:
    """Prints the table, and writes it where --out is given."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('dataset', type=Path)
    parser.add_argument('--machine', default='cpu2', help='name of the machine on the page')
    parser.add_argument('--out', type=Path, help='folder to write the page into')
    options = parser.parse_args()
    tasks: dict[str, list[EpisodeFigures]] = defaultdict(list)
    paths = list_episodes(options.dataset)
    for path in tqdm(paths, unit='ep'):
        tasks[path.name.rsplit('_', 1)[0]].append(figures_of(path))
    everything = [item for found in tasks.values() for item in found]
    header = ['task', 'success + failure', 'expert', 'frames', 'seconds']
    for view in VIEWS:
        header += [
            f'{view}: visible (least)',
            f'{view}: J held, all',
            f'{view}: J held, moved (n)',
        ]
    rows = [row_of(task, found) for task, found in sorted(tasks.items())]
    rows.append(row_of('**all**', everything))
    today = date.today().isoformat()
    page = (
        f'# The simulated tasks\n\n`python benchmark/sim_tasks.py DATASET`, machine '
        f'`{options.machine}` ({machine_line()}), {today}, n = {len(paths)} episodes.\n\n'
        f'{table(header, rows)}\n\n'
        'expert: successes per attempt, dropped seeds included. visible: share of frames in which '
        'an object shows (mean, and of the object seen least). J held: the first mask against all '
        'later ones.\n'
    )
    print(page)
    if options.out is not None:
        path = options.out / f'sim_tasks_{options.machine}_{today}.md'
        path.write_text(page, encoding='utf-8')
        print(f'written: {path}')


if __name__ == '__main__':
    main()
