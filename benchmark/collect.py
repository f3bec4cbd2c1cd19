"""How many episodes does a core collect in a minute, and where does the time go?

    python benchmark/collect.py [--repeats 2] [--seed 0] [--out benchmark/results]

CPU seconds of one process, `--repeats` episodes of each of the 15 tasks, dropped attempts
included. Physics: planning, simulation, predicates. Rendering: scene building, images and masks of
both views. Writing: JPEG, PNG, MCAP.
"""

from __future__ import annotations

import os
from pathlib import Path
import tempfile
import time

from page import parse_arguments, publish, table

from mtv_world_ros.sim.episode_maker import CollectConfig, EpisodeMaker, Spent
from mtv_world_ros.sim.jobs import jobs_of
from mtv_world_ros.sim.opengl import load_mujoco
from mtv_world_ros.sim.tasks import tasks_named

PARTS = {'planning and physics': 'physics_s', 'rendering': 'rendering_s', 'writing': 'writing_s'}


def main() -> None:
    """Collects into a folder that is removed afterwards, and prints the split."""
    options = parse_arguments(__doc__, repeats=2)
    config = CollectConfig()
    maker = EpisodeMaker(config)
    with tempfile.TemporaryDirectory() as folder:
        jobs = jobs_of(tasks_named('all'), options.repeats, options.seed, Path(folder))
        begun = time.process_time()
        spent = [maker.make(job) for job in jobs]
        total = time.process_time() - begun
    publish(
        'collect',
        'Collecting episodes',
        'python benchmark/collect.py',
        _body(spent, total, config),
        options,
        f'MuJoCo {load_mujoco().__version__}, MUJOCO_GL {os.environ["MUJOCO_GL"]}',
    )


def _body(spent: list[Spent], total: float, config: CollectConfig) -> str:
    num, frames = len(spent), sum(item.num_frames for item in spent)
    size = config.randomization
    seconds = {
        name: float(sum(getattr(item, part) for item in spent)) for name, part in PARTS.items()
    }
    seconds['other'] = total - sum(seconds.values())
    rows = [
        (name, f'{value / num:.2f}', f'{100 * value / total:.0f} %')
        for name, value in {**seconds, 'all': total}.items()
    ]
    images = 4 * frames  # two views, RGB and masks, of the episodes that were kept
    return (
        f'{(__doc__ or "").strip().splitlines()[-3]}\n'
        f'{num} episodes of {frames / num:.0f} frames x 2 views at {size.width} x {size.height} '
        f'px, CPU seconds an episode:\n\n'
        f'{table(("part", "CPU-s an episode", "share"), rows)}\n\n'
        f'**{60 * num / total:.0f} episodes a minute a core** '
        f'({1e3 * seconds["rendering"] / images:.1f} ms of rendering an image or mask).'
    )


if __name__ == '__main__':
    main()
