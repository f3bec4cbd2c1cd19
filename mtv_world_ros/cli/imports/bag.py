"""`mtv-world import bag`: a robot's own rosbag2 recordings become episodes."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from mtv_world_ros.cli.bundled_help import robots
from mtv_world_ros.cli.imports.common import (
    add_common_options,
    import_parser,
    ImportJob,
    MakeStage,
    Progress,
    run_import,
)

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands
    from mtv_world_ros.data.bag_mapping import BagMapping
    from mtv_world_ros.data.episode import Episode
    from mtv_world_ros.importing.convert import ImportSummary


def add(commands: Commands) -> None:
    """Add the command."""
    parser = import_parser(
        commands,
        'bag',
        "convert a robot's own rosbag2 recordings into episodes",
        'config/datasets/bag.yaml describes the mapping file; without one, views are all image '
        'topics. OUT also gets robot/ and mapping.yaml, which --topics takes elsewhere.',
        'a bag',
    )
    parser.add_argument(
        'bags', type=Path, nargs='+', metavar='BAG', help='a bag, or a folder of bags'
    )
    parser.add_argument('--topics', type=Path, metavar='FILE', help='mapping: which topic is what')
    parser.add_argument(
        '--robot',
        help=f"{robots()}; default: the mapping's, or /robot_description",
    )
    parser.add_argument(
        '--action',
        metavar='TOPIC',
        help="topic of the commands, or 'state': the measured positions that follow; default: the "
        "mapping's, or joint_trajectory",
    )
    add_common_options(
        parser,
        _import_bag,
        calibration='calibration of the cameras, also of camera_calibration, OpenCV, kalibr, '
        "easy_handeye or MoveIt, or a folder of such files; default: the bags' TF and CameraInfo",
    )


def _import_bag(arguments: argparse.Namespace) -> int:
    import yaml

    from mtv_world_ros.core.files import write_whole
    from mtv_world_ros.data.bag_mapping import BagMapping, load_bag_mapping
    from mtv_world_ros.data.episode_reader import read_episode
    from mtv_world_ros.importing.bag_folders import find_bags
    from mtv_world_ros.importing.bags import episode_name, import_bags, with_guessed_views

    mapping = BagMapping() if arguments.topics is None else load_bag_mapping(arguments.topics)
    if arguments.action:
        mapping = mapping.replace(action=arguments.action)
    bags = find_bags(arguments.bags)
    mapping = with_guessed_views(mapping, bags[0])

    def frames(bag: Path) -> Episode:
        return read_episode(bag, views=list(mapping.views), mapping=mapping, with_cameras=False)

    def convert(stage: MakeStage, progress: Progress) -> ImportSummary:
        summary = import_bags(
            bags,
            arguments.out,
            mapping,
            _robot_of_bags(arguments, mapping, bags[0]),
            calibration=arguments.calibration,
            stage=stage(),
            progress=progress,
        )
        values = mapping.replace(robot='robot/robot.yaml').model_dump(
            mode='json', exclude_defaults=True
        )
        write_whole(arguments.out / 'mapping.yaml', yaml.safe_dump(values, sort_keys=False))
        for view, row in mapping.views.items():
            print(f'view {view}: {mapping.topic(row.image)}')
        return summary

    job = ImportJob(
        found={episode_name(bag): bag for bag in bags},
        read=frames,
        objects=mapping.objects,
        convert=convert,
        episode=lambda part: part.name,
        recording=lambda part: episode_name(part.bag),
        unit='bag',
    )
    return run_import(arguments, job)


def _robot_of_bags(arguments: argparse.Namespace, mapping: BagMapping, bag: Path) -> Path:
    """Return the robot's YAML.

    That of the first bag's `/robot_description` is written into OUT.
    """
    from mtv_world_ros.importing.bags import described_robot
    from mtv_world_ros.robot.file import robot_path

    name = arguments.robot or mapping.robot
    if name:
        return robot_path(name)
    folder = arguments.out / 'robot'
    if (folder / 'robot.yaml').is_file():  # confirmed or corrected since the last call
        return folder / 'robot.yaml'
    file, notes = described_robot(bag, mapping, folder)
    for note in notes:
        print(f'guessed: {note}')
    print(f'look at it with: mtv-world robot {file}')
    return file
