"""`mtv-world collect`."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
import sys
from typing import TYPE_CHECKING

from mtv_world_ros.cli.bundled_help import robots
from mtv_world_ros.cli.physics_option import add_physics
from mtv_world_ros.cli.shared_options import add_options, names, workers_of

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands


def add(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'collect',
        help='make episodes of the simulated benchmark',
        description='Make the episodes of a data set that are not there yet, its card '
        '(dataset.json, README.md) and a contact sheet.',
    )
    parser.add_argument(
        '--task',
        default='all',
        help="names of tasks, or YAML files with a scene, comma-separated; or 'all'",
    )
    parser.add_argument(
        '--robot',
        default='yam_bimanual',
        help=f'a robot with a workcell: {robots(in_simulator=True)}',
    )
    parser.add_argument(
        '--episodes',
        type=int,
        required=True,
        help='number of episodes per task; with --zero-shot in all',
    )
    parser.add_argument(
        '--zero-shot',
        default='',
        metavar='KINDS',
        help='make a set for testing alone: any of view, task, object, comma-separated '
        '(new cameras, a task that is not of the 15, half of the objects unseen)',
    )
    parser.add_argument(
        '--moved-cameras',
        type=float,
        default=0.0,
        metavar='SHARE',
        help='share of the episodes with moved cameras; zero-shot views stay unseen',
    )
    parser.add_argument(
        '--failures-of-ten',
        type=int,
        default=2,
        metavar='N',
        help='how many of ten episodes of a task miss their grasp; 5 for mtv-world fit success',
    )
    parser.add_argument(
        '--policies',
        type=names,
        default=(),
        metavar='NAMES',
        help='scripted policies that take turns in place of the expert; keeps successes and '
        'failures alike, e.g. expert,expert-late-0.6,expert-shift-0.03',
    )
    parser.add_argument(
        '--faults',
        metavar='KINDS',
        help='random faulty policies: the fault kinds of a split (train, calibrate, test), '
        'drawn:SEED, or a comma-separated list of kinds; keeps successes and failures alike',
    )
    parser.add_argument(
        '--pictures',
        choices=('all', 'first'),
        default='all',
        help='first: render the first frame only, for foresight alone; fit contact needs all',
    )
    add_physics(parser)
    parser.add_argument('--seed', type=int, default=0, help='seed of the scenes')
    parser.add_argument('--out', type=Path, required=True, help='folder of the data set')
    add_options(parser, 'workers')
    parser.add_argument('--width', type=int, default=384, help='width of the images [px]')
    parser.add_argument('--height', type=int, default=288, help='height of the images [px]')
    parser.add_argument(
        '--fps', type=float, default=10.0, help='frames a second, at most 50; 16 for Wan'
    )
    parser.add_advanced(
        '--sheets', action='store_true', help='also write a larger contact sheet of every task'
    )
    parser.set_defaults(handler=_collect)


def _collect(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.simulation.collect.collect_dataset import collect
    from mtv_world_ros.simulation.collect.episode_maker import CollectConfig
    from mtv_world_ros.simulation.collect.record import RecordConfig
    from mtv_world_ros.simulation.faults.catalogue import kinds_named
    from mtv_world_ros.simulation.scenes.randomize import RandomizationConfig

    size = RandomizationConfig(width=arguments.width, height=arguments.height)
    missing: list[str] = []
    made = collect(
        [name.strip() for name in arguments.task.split(',')],
        arguments.episodes,
        arguments.seed,
        arguments.out,
        zero_shot=arguments.zero_shot,
        workers=workers_of(arguments),
        failures_of_ten=arguments.failures_of_ten,
        config=CollectConfig(
            robot=arguments.robot,
            randomization=size,
            moved_share=arguments.moved_cameras,
            policies=arguments.policies,
            kinds=kinds_named(arguments.faults) if arguments.faults else (),
            physics=arguments.physics,
            record=RecordConfig(
                pictures=arguments.pictures, frame_period_s=_period(arguments.fps)
            ),
        ),
        sheets=arguments.sheets,
        on_missing=missing.append,
    )
    outcomes = Counter(entry.outcome for entry in made)
    counted = ', '.join(f'{outcome} {number}' for outcome, number in sorted(outcomes.items()))
    print(f'{len(made)} episodes ({counted}): {arguments.out}')
    if missing:
        print(f'{len(missing)} could not be made:', *missing, sep='\n  ', file=sys.stderr)
    return int(bool(missing))


def _period(fps: float) -> float:
    from mtv_world_ros.core.errors import ConfigError

    if not 0 < fps <= 50:
        raise ConfigError(f'--fps is {fps:g}; it must be above 0 and at most 50')
    return 1 / fps
