r"""How much of an outcome can be known at all from what a world model is given?

    mtv-world collect --task all --episodes 20 --faults calibrate \
        --pictures first --out data/faults
    python benchmark/outcome_sensitivity.py data/faults [--repeats 1] [--noise-mm 0.7]

The commands of recorded episodes are carried out once more by the simulator: in the same scene;
in scenes whose objects lie a little elsewhere and are turned a little (`noise`: normal, in the
plane); in the same scene from the published trajectories alone, ten points a second with cubics
between them (`points`); and with both. `agrees`: the share that end as the undisturbed episode
does. `within 2 cm`: the share of the objects that moved whose way ends within 2 cm of where it
did. `flips`: of the episodes whose outcome is not that of the expert in the same scene, the share
whose disturbed objects end nearer to where the undisturbed ones do than to where they do under the
expert. No world model that is given just this can do better on average.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import dataclass, field, replace
import os
from pathlib import Path

import numpy as np
from page import publish, table

from mtv_world_ros.bench.collect.episode_maker import CollectConfig
from mtv_world_ros.bench.collect.record import carry_out, RecordConfig, Take
from mtv_world_ros.bench.expert.expert import Expert
from mtv_world_ros.bench.expert.faults.catalogue import EXPERT
from mtv_world_ros.bench.expert.scripted_policy import scripted_policy
from mtv_world_ros.bench.tasks.tasks import task_named
from mtv_world_ros.bench.world.scene import Scene
from mtv_world_ros.bench.world.simulator import CONTROL_PERIOD_S, SimEpisode
from mtv_world_ros.data.episode_reader import list_episodes, read_episode
from mtv_world_ros.data_types import FloatArray, JointTrajectory
from mtv_world_ros.errors import SimulatorError
from mtv_world_ros.files import bundled
from mtv_world_ros.geometry.resample import resample
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.lab.evaluation.metrics.statistics import wilson

#: turn of an object, for every metre of noise [rad]
_TURN_PER_M = 0.02 / 0.0007
#: an object has moved if it went further than this [m]
_MOVED_M = 0.015
_CONFIG = RecordConfig(pictures='first')
HEAD = (
    'kind',
    'given',
    'episodes',
    'succeed',
    'agrees',
    'failures that succeed now',
    'median shift [mm]',
    'within 2 cm',
    'flips',
)


@dataclass(slots=True, kw_only=True)
class Counts:
    """Of a kind of fault, under one disturbance: one entry of each repetition, or object.

    Attributes:
        succeeded: the undisturbed episode did.
        agrees: the disturbed one ended likewise.
        shifts: how far from where they did the ways of objects that moved ended [m].
        flips: of episodes that do not end as the expert's: is it told from that.
    """

    succeeded: list[bool] = field(default_factory=list)
    agrees: list[bool] = field(default_factory=list)
    shifts: list[float] = field(default_factory=list)
    flips: list[bool] = field(default_factory=list)

    def row(self) -> list[str]:
        """Returns the cells of the table."""
        agrees = np.array(self.agrees)
        failed = ~np.array(self.succeeded, bool)
        shifts = np.array(self.shifts)
        return [
            str(len(agrees)),
            str(sum(self.succeeded)),
            _share(agrees),
            _share(~agrees[failed]),
            f'{1e3 * np.median(shifts):.1f}' if len(shifts) else '-',
            _share(shifts < 0.02),
            _share(np.array(self.flips)),
        ]


def main() -> None:
    """Prints a row for every kind of fault, and writes them as a result page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('datasets', type=Path, nargs='+')
    parser.add_argument('--episodes', type=int, default=0, help='at most so many; 0 = all')
    parser.add_argument('--repeats', type=int, default=1, help='disturbed scenes of an episode')
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
    counts: defaultdict[tuple[str, str], Counts] = defaultdict(Counts)
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
        scene, plan = sim.scene, policy.plan
        undisturbed = _take(sim, scene, info.task, plan)
        right = scripted_policy(EXPERT, info.task, seed, expert)
        right.reset(seed=seed)
        expected = _take(sim, scene, info.task, right.plan)
        for _ in range(options.repeats):
            other = _disturbed(scene, options.noise_mm / 1e3, rng)
            for given, there, commands in (
                ('noise', other, plan),
                ('points', scene, _published(plan)),
                ('both', other, _published(plan)),
            ):
                take = _take(sim, there, info.task, commands)
                for kind in {*name.split('-')[1::2], 'all'}:
                    _add(counts[kind, given], undisturbed, take, expected)
        sim.close()
    kinds = sorted({kind for kind, _ in counts}, key=lambda kind: (kind == 'all', kind))
    rows = [
        [kind, given, *counts[kind, given].row()]
        for kind in kinds
        for given in (('noise', 'points', 'both') if kind == 'all' else ('both',))
    ]
    options.repeats = len(counts['all', 'both'].agrees)
    publish(
        'outcome_sensitivity',
        f'Outcomes when objects lie {options.noise_mm:g} mm elsewhere, and from published points',
        'python benchmark/outcome_sensitivity.py DIR...',
        f'{(__doc__ or "").split(chr(10) * 2)[-1]}\n{table(HEAD, rows)}',
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


def _published(plan: JointTrajectory) -> JointTrajectory:
    """The plan as a subscriber of its trajectories knows it."""
    points = np.arange(0.0, plan.times[-1] + _CONFIG.point_period_s, _CONFIG.point_period_s)
    rows = np.minimum(np.rint(points / CONTROL_PERIOD_S).astype(int), len(plan.times) - 1)
    slopes = None if plan.velocities is None else plan.velocities[rows]
    known = replace(plan, times=points, positions=plan.positions[rows], velocities=slopes)
    positions = resample(known, plan.positions[0], plan.times)
    return replace(known, times=plan.times, positions=positions, velocities=plan.velocities)


def _take(sim: SimEpisode, scene: Scene, name: str, commands: JointTrajectory) -> Take:
    task = task_named(name)
    return carry_out(sim, task, commands, sim.load(scene, task), _CONFIG)


def _add(counts: Counts, undisturbed: Take, take: Take, expected: Take) -> None:
    succeeded, other_succeeded, expert_succeeded = (
        each.ever and each.final for each in (undisturbed, take, expected)
    )
    counts.succeeded.append(succeeded)
    counts.agrees.append(other_succeeded == succeeded)
    way, other, right = (_ways(each) for each in (undisturbed, take, expected))
    if succeeded != expert_succeeded:
        off, to_expert = (np.linalg.norm(other - each) for each in (way, right))
        counts.flips.append(bool(off < to_expert))
    shifts = np.linalg.norm(other - way, axis=-1)
    counts.shifts += shifts[np.linalg.norm(way, axis=-1) > _MOVED_M].tolist()


def _ways(take: Take) -> FloatArray:
    """(O, 3) from where each object was to where it ended [m]."""
    return take.object_poses[-1, :, :3, 3] - take.object_poses[0, :, :3, 3]


def _share(values: np.ndarray) -> str:
    if not len(values):
        return '-'
    low, high = wilson(int(values.sum()), len(values))
    return f'{values.mean():.3f} [{low:.3f}, {high:.3f}] {len(values)}'


if __name__ == '__main__':
    main()
