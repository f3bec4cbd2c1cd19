"""`mtv-world export-dataset`."""

from __future__ import annotations

import argparse
from pathlib import Path


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser(
        'export-dataset',
        help='write episodes as a LeRobot dataset (v3.0)',
        epilog='OUT/meta/mapping.yaml is the mapping with which import-dataset reads it back.',
    )
    parser.add_argument('episodes', type=Path, help='folder of episodes, or one episode')
    parser.add_argument('--out', type=Path, required=True)
    parser.add_argument('--fps', type=int, default=10, help='rows a second')
    parser.add_argument(
        '--robot', default='yam_bimanual', help="a bundled robot's name, or a robot's YAML"
    )
    parser.set_defaults(handler=_export)


def _export(arguments: argparse.Namespace) -> int:
    from tqdm import tqdm

    from mtv_world_ros.data.episode_reader import list_episodes
    from mtv_world_ros.errors import ConfigError
    from mtv_world_ros.files import bundled
    from mtv_world_ros.geometry.robot_file import load_robot
    from mtv_world_ros.importing.lerobot_writer import export_dataset, MAPPING

    if arguments.fps < 1:
        raise ConfigError(f'--fps is {arguments.fps}; it must be at least 1')
    path = bundled('robots', arguments.robot, '--robot')
    named = arguments.robot if path.stem == arguments.robot else str(path.resolve())
    count = export_dataset(
        list_episodes(arguments.episodes),
        arguments.out,
        load_robot(path),
        named,
        arguments.fps,
        progress=lambda paths: tqdm(paths, unit='ep'),
    )
    print(f'{count} episodes; mapping: {arguments.out / MAPPING}')
    return 0
