"""`mtv-world fit contact`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from mtv_world_ros.cli.bundled_help import robots
from mtv_world_ros.cli.shared_options import add_options, names, number_or_0, workers_of
from mtv_world_ros.core.files import check_free

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands


def add(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'contact',
        help='fit arm response, friction, weight and grip of the physics',
        description='Fit the numbers of the physics to recorded episodes: delay and response of '
        'the arms, height of the table, grip, friction, weight of objects. Simulated objects then '
        'keep nearest to where later masks show them. Masks, commands and joint states are read, '
        'no recorded poses. Each number is printed with its interval and the recordings that it '
        'rests on. The search begins at the numbers that OUT holds, and writes '
        'OUT/object_motion/arm_response.json and contact.json.',
    )
    parser.add_argument('dataset', type=Path, help='folder with episodes, searched recursively')
    parser.add_argument(
        '--checkpoint',
        '--out',
        dest='checkpoint',
        type=Path,
        required=True,
        metavar='OUT',
        help='folder of a checkpoint, or any other folder',
    )
    parser.add_argument('--robot', default='yam_bimanual', help=robots())
    parser.add_argument(
        '--views', type=names, default='low,high', help='names of the views, comma-separated'
    )
    parser.add_argument(
        '--episodes', type=int, default=50, help='largest number of episodes; 20 to 50 will do'
    )
    parser.add_advanced(
        '--motions', type=int, default=16, help='number of futures that the checkpoint simulates'
    )
    parser.add_argument(
        '--place',
        help="name of the robot cell of the recordings; the node's `place` must be the same. "
        'Default: what the recordings state, or none',
    )
    parser.add_advanced(
        '--threads', type=number_or_0, default=0, help='CPU threads; 0 = all but one'
    )
    add_options(parser, 'overwrite workers')
    parser.set_defaults(handler=_fit, default_out=lambda given: given.checkpoint)


def _fit(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.core.progress import Progress
    from mtv_world_ros.data.splits import find_episodes, refuse_test_kinds, spread
    from mtv_world_ros.data.unusable import refuse_unusable
    from mtv_world_ros.model.card import OBJECT_MOTION_FOLDER
    from mtv_world_ros.physics.arms.arms import Arms
    from mtv_world_ros.physics.checkpoint_files import (
        CONTACT_FILE,
        load_contact,
        load_response,
        save_contact,
        save_response,
    )
    from mtv_world_ros.physics.fitting.contact_fit import (
        first_settings,
        fit_contact,
        read_recordings,
    )
    from mtv_world_ros.physics.fitting.response_fit import found_response
    from mtv_world_ros.robot.file import load_robot, robot_path

    folder = arguments.checkpoint / OBJECT_MOTION_FOLDER
    check_free(folder / CONTACT_FILE, arguments.overwrite)
    first = load_contact(folder)
    robot = load_robot(robot_path(arguments.robot))
    unfitted = Arms(robot, None)
    likely = first or first_settings(unfitted)
    likely.replace(num_motions=arguments.motions)  # refused before the work begins
    paths = spread(find_episodes(arguments.dataset), arguments.episodes)
    refuse_unusable(paths, arguments.views, robot)
    refuse_test_kinds(paths, 'training')
    response = load_response(folder, robot)
    if response is None:
        response, report = found_response(paths, unfitted.robot)
        print(report)
    arms = Arms(robot, response)
    for note in arms.notes:
        print(note)
    recordings, skipped = read_recordings(paths, robot, arguments.views)
    for path, reason in list(skipped.items())[:3]:
        print(f'left out: {path}: {reason}')
    settings, _ = fit_contact(
        recordings,
        arms,
        first,
        workers=workers_of(arguments),
        report=Progress.write,
        progress=partial(Progress, desc='foreseeing', unit='episode'),
        place=_place_of(paths) if arguments.place is None else arguments.place,
    )
    settings = settings.replace(num_motions=arguments.motions)
    folder.mkdir(parents=True, exist_ok=True)
    if response is not None:
        save_response(response, folder)
    save_contact(settings, folder)
    print(f'{len(recordings)} episodes, {len(skipped)} left out: {folder / CONTACT_FILE}')
    return 0


def _place_of(paths: Sequence[Path]) -> str:
    """Return the robot cell that recordings state; empty if they state none.

    Raises:
        ConfigError: they are of several robot cells.
    """
    from mtv_world_ros.core.errors import ConfigError
    from mtv_world_ros.data.episode_reader import read_info

    places = sorted({read_info(path).place for path in paths})
    if len(places) > 1:
        raise ConfigError(
            f'the recordings are of {len(places)} robot cells ({"; ".join(places)}), whose '
            'contact parameters may differ; fit those of one, or name the cell (--place)'
        )
    return places[0] if places else ''
