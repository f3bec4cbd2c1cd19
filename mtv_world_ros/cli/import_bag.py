"""`mtv-world import-bag`."""

from __future__ import annotations

import argparse
from pathlib import Path
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mtv_world_ros.data.bag_mapping import BagMapping


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser(
        'import-bag',
        help="convert a robot's own rosbag2 recordings into episodes",
        epilog='config/datasets/bag.yaml describes the mapping file; without one, views are all '
        'image topics. OUT also gets robot/ and mapping.yaml, which --topics takes elsewhere. '
        'Call it again to continue: finished episodes are kept. Exit status: 1 if a bag failed.',
    )
    parser.add_argument('bags', type=Path, nargs='+', metavar='BAG', help='or folder of bags')
    parser.add_argument('--topics', type=Path, metavar='FILE', help='mapping: which topic is what')
    parser.add_argument(
        '--robot', help="YAML, or a bundled robot; default: the mapping's, or /robot_description"
    )
    parser.add_argument('--calibration', type=Path, help="default: the bags' TF and CameraInfo")
    parser.add_argument('--out', type=Path, required=True)
    parser.set_defaults(handler=_import)


def _import(arguments: argparse.Namespace) -> int:
    from tqdm import tqdm
    import yaml

    from mtv_world_ros.data.bag_mapping import BagMapping, load_bag_mapping
    from mtv_world_ros.files import write_whole
    from mtv_world_ros.importing.bags import find_bags, import_bags, with_guessed_views

    mapping = BagMapping() if arguments.topics is None else load_bag_mapping(arguments.topics)
    bags = find_bags(arguments.bags)
    mapping = with_guessed_views(mapping, bags[0])
    robot = _robot(arguments, mapping, bags[0])
    summary = import_bags(
        bags,
        arguments.out,
        mapping,
        robot,
        calibration=arguments.calibration,
        progress=lambda paths: tqdm(paths, unit='bag'),
    )
    values = mapping.replace(robot='robot/robot.yaml').model_dump(
        mode='json', exclude_defaults=True
    )
    write_whole(arguments.out / 'mapping.yaml', yaml.safe_dump(values, sort_keys=False))
    for view, row in mapping.views.items():
        print(f'view {view}: {mapping.topic(row.image)}')
    for bag, lines in summary.warnings.items():
        for line in lines:
            print(f'{bag}: {line}', file=sys.stderr)
    print(f'{len(summary.made)} made, {len(summary.kept)} kept, {len(summary.failed)} failed')
    for bag, reason in summary.failed.items():
        print(f'{bag}: {reason}', file=sys.stderr)
    print(f'robot: {summary.robot}')
    return 1 if summary.failed else 0


def _robot(arguments: argparse.Namespace, mapping: BagMapping, bag: Path) -> Path:
    """The robot's YAML; that of the first bag's `/robot_description` is written into OUT."""
    from mtv_world_ros.assembly import robot_path
    from mtv_world_ros.importing.bags import described_robot

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
