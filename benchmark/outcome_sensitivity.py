r"""How much of an outcome can be known at all from where the objects seem to be?

    mtv-world collect --task all --episodes 20 --faults calibrate \
        --pictures first --out data/faults
    python benchmark/outcome_sensitivity.py data/faults [--repeats 2] [--noise-mm 0.7]

The commands of recorded episodes are carried out once more by the simulator, in the same scene
and in scenes whose objects lie a little elsewhere and are turned a little (normal noise, in the
plane). `agrees`: the share of repetitions that end as the undisturbed one does. No world model
that locates objects with this error can agree with the truth more often on average.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
import os
from pathlib import Path

import numpy as np
from page import publish, table

from mtv_world_ros.data.episode_reader import list_episodes, read_episode
from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import SimulatorError
from mtv_world_ros.evaluation.metrics.statistics import wilson
from mtv_world_ros.files import bundled
from mtv_world_ros.geometry.robot_file import load_robot
from mtv_world_ros.sim.collect.episode_maker import CollectConfig
from mtv_world_ros.sim.collect.record import RecordConfig
from mtv_world_ros.sim.expert.expert import Expert
from mtv_world_ros.sim.expert.scripted_policy import scripted_policy
from mtv_world_ros.sim.tasks.tasks import task_named
from mtv_world_ros.sim.world.scene import Scene
from mtv_world_ros.sim.world.simulator import CONTROL_PERIOD_S, SimEpisode
from mtv_world_ros.success.task import ever_and_final

#: turn of an object, for every metre of noise [rad]
_TURN_PER_M = 0.02 / 0.0007


def main() -> None:
    """Prints a row for every kind of fault, and writes them as a result page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('datasets', type=Path, nargs='+')
    parser.add_argument('--episodes', type=int, default=0, help='at most so many; 0 = all')
    parser.add_argument('--repeats', type=int, default=2, help='disturbed scenes of an episode')
    parser.add_argument(
        '--noise-mm', type=float, default=0.7, help='standard deviation, in x and y'
    )
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--machine', default=f'cpu{os.cpu_count()}')
    parser.add_argument('--out', type=Path, help='folder to write the page into')
    options = parser.parse_args()
    config = CollectConfig()
    robot = load_robot(bundled('robots', config.robot, '--robot'))
    expert = Expert(robot, config.expert)
    rng = np.random.default_rng(options.seed)
    paths = [path for folder in options.datasets for path in list_episodes(folder)]
    if options.episodes:
        paths = [paths[k] for k in np.linspace(0, len(paths) - 1, options.episodes).astype(int)]
    counts: dict[str, Counter[str]] = {}
    for path in paths:
        info = read_episode(path, with_cameras=False).info
        seed = info.seed
        assert seed is not None, f'{path} is of no simulated scene'
        name = info.metadata.get('policy') or 'expert'
        sim = SimEpisode(robot, expert.home, rendering=False)
        try:
            policy = scripted_policy(name, info.task, seed, expert)
            policy.reset(seed=seed)
            sim.reset(seed, info.task)
        except SimulatorError as error:  # drawn for other cameras
            print(f'left out: {path}: {error}')
            continue
        scene, recorded = sim.scene, info.outcome == 'success'
        undisturbed = _succeeds(sim, scene, info.task, policy.plan.positions)
        found = Counter(
            episodes=1, succeed=int(undisturbed), not_as_recorded=int(undisturbed != recorded)
        )
        for _ in range(options.repeats):
            other = _disturbed(scene, options.noise_mm / 1e3, rng)
            ending = _succeeds(sim, other, info.task, policy.plan.positions)
            found['tried'] += 1
            found['agrees'] += ending == undisturbed
            found['failures'] += not undisturbed
            found['now_success'] += ending and not undisturbed
        sim.close()
        for kind in {*name.split('-')[1::2], 'all'}:
            counts.setdefault(kind, Counter()).update(found)
    rows = [_row(kind, counts[kind]) for kind in sorted(counts, key=lambda k: (k == 'all', k))]
    head = (
        'kind',
        'episodes',
        'succeed',
        'agrees',
        'failures that succeed now',
        'not as recorded',
    )
    options.repeats = counts['all']['tried']
    publish(
        'outcome_sensitivity',
        f'Outcomes when objects lie {options.noise_mm:g} mm elsewhere',
        'python benchmark/outcome_sensitivity.py DIR...',
        f'{(__doc__ or "").split(chr(10) * 2)[-1]}\n{table(head, rows)}',
        options,
        '1 process',
    )


def _disturbed(scene: Scene, sigma_m: float, rng: np.random.Generator) -> Scene:
    moved = []
    for item in scene.objects:
        x, y = np.add(item.position[:2], rng.normal(0.0, sigma_m, 2)).tolist()
        yaw = item.yaw + float(rng.normal(0.0, sigma_m * _TURN_PER_M))
        moved.append(replace(item, position=(x, y, item.position[2]), yaw=yaw))
    return replace(scene, objects=tuple(moved))


def _succeeds(sim: SimEpisode, scene: Scene, name: str, commands: FloatArray) -> bool:
    """Whether commands (C, J), one each control period, do the task, judged as when recorded."""
    task, record, last = task_named(name), RecordConfig(), len(commands) - 1
    sim.load(scene, task)
    frame, period = 1, 0
    while record.frame_at(frame - 1) < last + round(record.hold_s / CONTROL_PERIOD_S):
        for _ in range(record.frame_at(frame) - period):
            period += 1
            sim.advance(commands[min(period, last)])
        sim.observe(rendering=False)
        frame += 1
    return all(ever_and_final(task.succeeds(sim.situation())))


def _row(kind: str, count: Counter[str]) -> list[str]:
    def share(part: str, whole: str) -> str:
        if not count[whole]:
            return '-'
        low, high = wilson(count[part], count[whole])
        return f'{count[part] / count[whole]:.3f} [{low:.3f}, {high:.3f}] {count[whole]}'

    return [
        kind,
        str(count['episodes']),
        str(count['succeed']),
        share('agrees', 'tried'),
        share('now_success', 'failures'),
        str(count['not_as_recorded']),
    ]


if __name__ == '__main__':
    main()
