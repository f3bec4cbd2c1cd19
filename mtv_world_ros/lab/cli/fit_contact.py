"""`mtv-world fit-contact`."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from mtv_world_ros.cli.shared_options import add_overwrite, names
from mtv_world_ros.files import check_free


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser(
        'fit-contact',
        help='find friction, weight and grip: a checkpoint then also foresees by rigid bodies',
        description='Finds how fingers grip, what rubs and how heavy objects are: the settings '
        'with which rigid bodies, shaped as the masks show them, end nearest to where objects '
        'ended in recorded episodes. Writes CHECKPOINT/object_motion/contact.json, with which '
        'motions of rigid bodies are foreseen beside those of the networks.',
    )
    parser.add_argument('dataset', type=Path, help='folder with episodes, searched recursively')
    parser.add_argument(
        '--checkpoint',
        type=Path,
        required=True,
        metavar='DIR',
        help='of train-motion, which has found how its arms follow',
    )
    parser.add_argument('--robot', default='yam_bimanual', help='YAML file or bundled name')
    parser.add_argument('--views', type=names, default='low,high', help='comma-separated')
    parser.add_argument('--episodes', type=int, default=200, help='at most, spread evenly')
    parser.add_argument('--motions', type=int, default=4, help='that are foreseen later')
    parser.add_argument('--workers', type=int, default=1, help='processes')
    add_overwrite(parser)
    parser.set_defaults(handler=_fit)


def _fit(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.assembly import robot_path
    from mtv_world_ros.data.recorded_policies import refuse_test_kinds
    from mtv_world_ros.errors import CheckpointError
    from mtv_world_ros.geometry.robot.file import load_robot
    from mtv_world_ros.lab.training.object_motion.contact_fit import (
        first_settings,
        fit_contact,
        read_recordings,
    )
    from mtv_world_ros.lab.training.training_run import find_episodes, spread
    from mtv_world_ros.model.checkpoint import OBJECT_MOTION_FOLDER
    from mtv_world_ros.model.object_motion.contact_motions import check_robot
    from mtv_world_ros.model.object_motion.predictor import (
        CONTACT_FILE,
        load_response,
        save_contact,
    )

    folder = arguments.checkpoint / OBJECT_MOTION_FOLDER
    check_free(folder / CONTACT_FILE, arguments.overwrite)
    file = robot_path(arguments.robot)
    robot = load_robot(file)
    response = load_response(folder, robot)
    if response is None:
        raise CheckpointError(
            f"'{folder}' does not say how arms follow their commands; run "
            "'mtv-world train-motion' first"
        )
    first = first_settings(robot, response).model_copy(update={'num_motions': arguments.motions})
    check_robot(first, robot, response)
    paths = spread(find_episodes(arguments.dataset), arguments.episodes)
    refuse_test_kinds(paths, 'training')
    recordings, skipped = read_recordings(paths, robot, arguments.views)
    for path, reason in list(skipped.items())[:3]:
        print(f'left out: {path}: {reason}')
    settings = fit_contact(
        recordings,
        file,
        response,
        first,
        workers=arguments.workers,
        report=partial(print, flush=True),
    )
    save_contact(settings, folder)
    print(f'{len(recordings)} episodes, {len(skipped)} left out: {folder / CONTACT_FILE}')
    return 0
