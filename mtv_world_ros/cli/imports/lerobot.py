"""`mtv-world import lerobot`: a LeRobot data set becomes episodes."""

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
from mtv_world_ros.core.errors import ConfigError

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands
    from mtv_world_ros.data.episode import Episode
    from mtv_world_ros.importing.convert import ImportSummary
    from mtv_world_ros.importing.lerobot_metadata import EpisodeEntry


def add(commands: Commands) -> None:
    """Add the command."""
    parser = import_parser(
        commands,
        'lerobot',
        'convert a LeRobot dataset (v2.0, v2.1, v3.0) into episodes',
        'config/datasets/example.yaml describes the mapping file.',
        'an episode',
    )
    parser.add_argument('dataset', type=Path, help='folder with meta/, data/ and videos/')
    parser.add_argument(
        '--mapping',
        type=Path,
        help='which feature is what; default: made of --robot, for columns that are named like '
        "the robot's joints [rad or m]",
    )
    parser.add_argument('--robot', help=f'{robots()}; without --mapping')
    parser.add_argument('--episodes', help="numbers, comma-separated, e.g. '0,4,7'; default: all")
    add_common_options(
        parser,
        _import_dataset,
        calibration='calibration of the cameras by view, without --mapping; default: not known',
    )


def _import_dataset(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.importing.convert import episode_name
    from mtv_world_ros.importing.lerobot import LeRobotDataset
    from mtv_world_ros.importing.lerobot_episodes import import_dataset, read_frames
    from mtv_world_ros.importing.mapping import load_mapping

    file = arguments.mapping or _guessed_mapping(arguments)
    source, mapping = LeRobotDataset(arguments.dataset), load_mapping(file)

    def read(entry: EpisodeEntry) -> Episode:
        return read_frames(source, entry, mapping)

    def convert(stage: MakeStage, progress: Progress) -> ImportSummary:
        return import_dataset(
            arguments.dataset,
            file,
            arguments.out,
            episodes=_numbers(arguments.episodes),
            stage=stage(),
            progress=progress,
        )

    job = ImportJob(
        found={episode_name(number): entry for number, entry in sorted(source.episodes.items())},
        read=read,
        objects=mapping.objects,
        convert=convert,
        episode=episode_name,
        label='episode {}'.format,
    )
    return run_import(arguments, job)


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
    values = guess_mapping(
        LeRobotDataset(arguments.dataset), arguments.robot, arguments.calibration
    )
    file = arguments.out / 'mapping.yaml'
    write_whole(file, yaml.safe_dump(values, sort_keys=False))
    print(f'mapping: {file}')
    return file


def _numbers(text: str | None) -> list[int] | None:
    if text is None:
        return None
    try:
        return [int(part) for part in text.split(',')]
    except ValueError as error:
        raise ConfigError(f"--episodes is '{text}', must be numbers such as 0,4,7") from error
