"""Do a task's relations, evaluated on recorded true poses, say what the simulator recorded?

    mtv-world collect --task all --episodes 100 --faults train --pictures first --out data/poses
    python benchmark/task_agreement.py data/poses [--out benchmark/results] [--machine NAME]

For every episode: the relations of `config/tasks/<task>.yaml` on the poses in `/object_poses`,
sizes from the episode's seed, gripper openings from `/joint_states`; against the outcome, `ever`
and `final` that were recorded with it. `ever`: done in any frame. `final`: done in each of the
last five frames.
"""

from __future__ import annotations

import argparse
from collections import Counter
import os
from pathlib import Path

from page import publish, table

from mtv_world_ros.bench.collect.episode_maker import CollectConfig
from mtv_world_ros.bench.collect.record import true_poses
from mtv_world_ros.bench.tasks.tasks import task_named
from mtv_world_ros.data.episode_reader import list_episodes, read_episode
from mtv_world_ros.files import bundled
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.success.task import ever_and_final

HEAD = ('task', 'episodes', 'frames', 'ever', 'final', 'disagree')


def main() -> None:
    """Prints a row for every task, and writes them as a result page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('datasets', type=Path, nargs='+')
    parser.add_argument('--machine', default=f'cpu{os.cpu_count()}')
    parser.add_argument('--out', type=Path, help='folder to write the page into')
    options = parser.parse_args()
    robot = load_robot(bundled('robots', CollectConfig().robot, '--robot'))
    counts: dict[str, Counter[str]] = {}
    for path in (path for folder in options.datasets for path in list_episodes(folder)):
        episode = read_episode(path, with_cameras=False)
        poses, metadata = true_poses(episode, robot), episode.info.metadata
        success = task_named(episode.info.task).succeeds(poses)
        ever, final = ever_and_final(success)
        recorded = (metadata['ever'] == 'true', metadata['final'] == 'true')
        is_success = episode.info.outcome == 'success'
        found = Counter(
            episodes=1,
            frames=len(success),
            ever=recorded[0],
            final=recorded[1],
            disagree=(ever, final) != recorded or (ever and final) != is_success,
        )
        if found['disagree']:
            print(f'{path}: recorded {recorded}, found {(ever, final)}')
        for name in (episode.info.task, 'all'):
            counts.setdefault(name, Counter()).update(found)
    total = counts.pop('all')
    rows = [
        [name, *(str(count[key]) for key in HEAD[1:])]
        for name, count in [*sorted(counts.items()), ('all', total)]
    ]
    options.seed, options.repeats = '-', total['episodes']
    publish(
        'task_agreement',
        "The simulator's outcome and the tasks' relations on recorded true poses",
        'python benchmark/task_agreement.py DIR...',
        f'{(__doc__ or "").split(chr(10) * 2)[-1]}\n{table(HEAD, rows)}',
        options,
        '1 process',
    )


if __name__ == '__main__':
    main()
