"""`mtv-world import lerobot`: a LeRobot data set becomes episodes."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from mtv_world_ros.cli.imports.common import (
    add_object_options,
    import_status,
    object_stage,
    write_boxes_page,
)
from mtv_world_ros.core.errors import ConfigError

if TYPE_CHECKING:
    from mtv_world_ros.data.episode import Episode
    from mtv_world_ros.importing.lerobot import EpisodeEntry


def add(commands: argparse._SubParsersAction) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'lerobot',
        help='convert a LeRobot dataset (v2.0, v2.1, v3.0) into episodes',
        epilog='config/datasets/example.yaml describes the mapping file. Call it again to '
        'continue: finished episodes are kept. Exit status: 1 if an episode failed.',
    )
    parser.add_argument('dataset', type=Path, help='folder with meta/, data/ and videos/')
    parser.add_argument(
        '--mapping',
        type=Path,
        help='which feature is what; default: made of --robot, for columns that are named like '
        "the robot's joints [rad or m]",
    )
    parser.add_argument('--robot', help='robot YAML, or a bundled robot, without --mapping')
    parser.add_argument(
        '--calibration',
        type=Path,
        help='calibration of the cameras by view, without --mapping; default: not known',
    )
    parser.add_argument('--out', type=Path, required=True, help='folder of the episodes')
    parser.add_argument('--episodes', help="numbers, comma-separated, e.g. '0,4,7'; default: all")
    add_object_options(parser)
    parser.set_defaults(handler=_import_dataset)


def _import_dataset(arguments: argparse.Namespace) -> int:
    from tqdm import tqdm

    from mtv_world_ros.core.files import ROBOT_YAML
    from mtv_world_ros.importing.bags import summary_line
    from mtv_world_ros.importing.convert import episode_name, import_dataset, read_frames
    from mtv_world_ros.importing.lerobot import LeRobotDataset
    from mtv_world_ros.importing.mapping import load_mapping

    file = arguments.mapping or _guessed_mapping(arguments)
    source, mapping = LeRobotDataset(arguments.dataset), load_mapping(file)
    found = {episode_name(number): entry for number, entry in sorted(source.episodes.items())}

    def read(entry: EpisodeEntry) -> Episode:
        return read_frames(source, entry, mapping)

    if arguments.click:
        return write_boxes_page(arguments, found, read, mapping.objects)
    summary = import_dataset(
        arguments.dataset,
        file,
        arguments.out,
        episodes=_numbers(arguments.episodes),
        stage=object_stage(arguments, found, read),
        progress=lambda numbers: tqdm(numbers, unit='ep', disable=None),
    )
    for number in summary.made:
        looked = bool(arguments.segmenter or arguments.objects)
        print(summary_line(arguments.out / episode_name(number), objects=looked))
    status = import_status(summary, 'episode {}'.format)
    if summary.made or summary.kept:
        print(f'robot: {arguments.out / "robot" / ROBOT_YAML}')
    return status


def _guessed_mapping(arguments: argparse.Namespace) -> Path:
    """Write OUT/mapping.yaml for columns and views that are named like joints and cameras."""
    import yaml

    from mtv_world_ros.core.files import write_whole
    from mtv_world_ros.importing.lerobot import LeRobotDataset
    from mtv_world_ros.importing.mapping import guess_mapping

    if arguments.robot is None:
        raise ConfigError(
            'give --mapping (config/datasets/example.yaml has all keys), or --robot where the '
            "columns are named like the robot's joints"
        )
    values, left_out = guess_mapping(
        LeRobotDataset(arguments.dataset), arguments.robot, arguments.calibration
    )
    file = arguments.out / 'mapping.yaml'
    write_whole(file, yaml.safe_dump(values, sort_keys=False))
    print(f'mapping: {file}')
    if left_out:
        where = f", not in '{arguments.calibration}'" if arguments.calibration else ', no colours'
        print(f'left out{where}: {", ".join(left_out)}')
    return file


def _numbers(text: str | None) -> list[int] | None:
    if text is None:
        return None
    try:
        return [int(part) for part in text.split(',')]
    except ValueError as error:
        raise ConfigError(f"--episodes is '{text}', must be numbers such as 0,4,7") from error
