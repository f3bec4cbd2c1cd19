"""`mtv-world foresee`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from mtv_world_ros.cli.bundled_help import robots
from mtv_world_ros.cli.shared_options import add_options, names
from mtv_world_ros.core.files import check_free

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands
    from mtv_world_ros.core.data_types import FloatArray
    from mtv_world_ros.physics.solid_foresight import SolidForesight, TrackedSolids


#: suffixes of scenes without an episode
_FILES = ('.yaml', '.yml')


def add(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'foresee',
        help='simulate where objects go under commands, by physics without a model',
        description='Simulate what the commands of an episode, or of a YAML file with objects and '
        'joint positions, do to objects, in several futures. No checkpoint is needed: any robot '
        'with a URDF will do. Numbers of contact are those of fit contact, or a guess, which is '
        'said.',
    )
    parser.add_argument('scene', type=Path, help='folder of an episode, or a YAML file')
    parser.add_argument('--robot', default='yam_bimanual', help=robots())
    parser.add_argument(
        '--contact', metavar='DIR', help="folder that fit contact wrote, or 'bundled'"
    )
    parser.add_argument(
        '--views', type=names, default='low,high', help='names of the views, comma-separated'
    )
    parser.add_argument('--futures', type=int, default=16, help='number of futures')
    parser.add_argument('--picture', type=Path, metavar='PNG', help='draw the first future')
    add_options(parser, 'overwrite')
    parser.set_defaults(handler=_foresee)


def _foresee(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.inspection.foreseen_scene import draw_foreseen, in_words

    if arguments.picture is not None:
        check_free(arguments.picture, arguments.overwrite)
    foresight = _foresight(arguments)
    for note in foresight.notes:
        print(note)
    tracked, commands = _scene(arguments, foresight)
    motions, after = tracked.advance(commands)
    for line in (*in_words(tracked.names, motions), *after.reasons):
        print(line)
    if arguments.picture is not None:
        draw_foreseen(tracked, commands, arguments.picture)
        print(arguments.picture)
    return 0


def _foresight(arguments: argparse.Namespace) -> SolidForesight:
    from mtv_world_ros.core.errors import CheckpointError
    from mtv_world_ros.core.processes import threads_each
    from mtv_world_ros.model.card import OBJECT_MOTION_FOLDER
    from mtv_world_ros.model.checkpoint import checkpoint_folder
    from mtv_world_ros.physics.arms.arms import Arms
    from mtv_world_ros.physics.checkpoint_files import load_foresight
    from mtv_world_ros.physics.fitting.contact_fit import (
        first_settings,
        read_contact,
        settings_of_place,
    )
    from mtv_world_ros.physics.solid_foresight import SolidForesight
    from mtv_world_ros.robot.file import load_robot, robot_path

    robot = load_robot(robot_path(arguments.robot))
    threads, count = threads_each(1), {'num_motions': arguments.futures}
    if arguments.contact is None:
        print("numbers of contact are guessed: 'fit contact' finds them, '--contact' takes them")
        settings = first_settings(Arms(robot, None)).replace(**count)
        if arguments.scene.suffix not in _FILES:  # nothing is known of its table
            recording = read_contact(arguments.scene, robot, arguments.views)
            settings = settings_of_place(settings.replace(table_varies=True), [recording], print)
        return SolidForesight(robot, None, settings, threads)
    found = load_foresight(
        checkpoint_folder(arguments.contact) / OBJECT_MOTION_FOLDER, robot, threads
    )
    if found is None:
        raise CheckpointError(
            f"'{arguments.contact}' holds no '{OBJECT_MOTION_FOLDER}/contact.json'; run "
            "'mtv-world fit contact' with '--out' of this folder"
        )
    settings = found.settings.replace(**count)
    return SolidForesight(robot, found.response, settings, threads)


def _scene(
    arguments: argparse.Namespace, foresight: SolidForesight
) -> tuple[TrackedSolids, FloatArray]:
    from mtv_world_ros.core.errors import EpisodeError
    from mtv_world_ros.data.episode_reader import read_episode
    from mtv_world_ros.inspection.foreseen_scene import load_scene
    from mtv_world_ros.physics.fitting.tracks import fine_commands, first_frame
    from mtv_world_ros.physics.solid_foresight import TrackedSolids

    if arguments.scene.suffix in _FILES:
        named, solids, commands = load_scene(arguments.scene, foresight.robot)
        return TrackedSolids(foresight=foresight, names=named, solids=solids), commands
    episode = read_episode(arguments.scene, views=tuple(arguments.views))
    if episode.masks is None or episode.joint_states is None or not episode.trajectories:
        raise EpisodeError(f"'{arguments.scene}' has no object masks, joint states or commands")
    frame = first_frame(episode, foresight.robot, arguments.views)
    commands = fine_commands(episode, foresight.robot, arguments.views)[1]
    found = foresight.find(episode.info.objects, frame.masks, frame.cameras, frame.poses)
    return found, commands
