"""How many episodes does a core collect in a minute, and where does the time go?

    python benchmark/collect.py [--episodes 12] [--seed 0]

CPU seconds of one process, all tasks in turn: planning and physics, rendering (images and
masks of both views), writing (JPEG, PNG, MCAP).
"""

from __future__ import annotations

import argparse
from pathlib import Path
import tempfile
import time

from mtv_world_ros.sim.episode_maker import CollectConfig, EpisodeMaker
from mtv_world_ros.sim.jobs import jobs_of
from mtv_world_ros.sim.tasks import TASKS


def main() -> None:
    """Collects into a folder that is removed afterwards, and prints the split."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--episodes', type=int, default=12, help='per task')
    parser.add_argument('--seed', type=int, default=0)
    options = parser.parse_args()
    maker = EpisodeMaker(CollectConfig())
    with tempfile.TemporaryDirectory() as folder:
        jobs = jobs_of(list(TASKS.values()), options.episodes, options.seed, Path(folder))
        begun = time.process_time()
        spent = [maker.make(job) for job in jobs]
        total = (time.process_time() - begun) / len(jobs)
    print(f'{len(jobs)} episodes of 71 frames x 2 views, {total:.2f} CPU-s each: ', end='')
    print(f'{60 / total:.0f} episodes a minute a core')
    for part in ('physics_s', 'rendering_s', 'writing_s'):
        mean = sum(getattr(item, part) for item in spent) / len(spent)
        print(f'  {part[:-2]:10} {mean:5.2f} s  {100 * mean / total:3.0f} %')


if __name__ == '__main__':
    main()
