"""`mtv-world export lerobot`: episodes become a LeRobot data set."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from mtv_world_ros.cli.bundled_help import robots
from mtv_world_ros.core.errors import ConfigError

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands

    pass


def add(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'lerobot',
        help='write episodes as a LeRobot dataset (v3.0)',
        epilog='OUT/meta/mapping.yaml is the mapping with which import lerobot reads it back.',
    )
    parser.add_argument(
        'episodes', type=Path, nargs='+', help='folder of episodes, or one episode'
    )
    parser.add_argument('--out', type=Path, required=True, help='folder of the data set')
    parser.add_argument('--fps', type=int, default=10, help='rows a second')
    parser.add_argument(
        '--size', default='', metavar='WxH', help='size of the images [px]; default: as recorded'
    )
    parser.add_argument(
        '--images',
        action='store_true',
        help='PNG images in the tables in place of MP4: lossless, no video decoder is needed',
    )
    parser.add_argument('--robot', default='yam_bimanual', help=robots())
    parser.set_defaults(handler=_export)


def _export(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.core.files import bundled
    from mtv_world_ros.core.progress import Progress
    from mtv_world_ros.data.episode_reader import list_episodes
    from mtv_world_ros.importing.lerobot_writer import export_dataset, MAPPING
    from mtv_world_ros.robot.file import load_robot

    if arguments.fps < 1:
        raise ConfigError(f'--fps is {arguments.fps}; it must be at least 1')
    path = bundled('robots', arguments.robot, '--robot')
    named = arguments.robot if path.parent.name == arguments.robot else str(path.resolve())
    count = export_dataset(
        [path for folder in arguments.episodes for path in list_episodes(folder)],
        arguments.out,
        load_robot(path),
        named,
        arguments.fps,
        progress=lambda paths: Progress(paths, unit='episode'),
        size=_size(arguments.size),
        as_videos=not arguments.images,
    )
    print(f'{count} episodes; mapping: {arguments.out / MAPPING}')
    return 0


def _size(text: str) -> tuple[int, int] | None:
    if not text:
        return None
    width, _, height = text.partition('x')
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise ConfigError(f"--size is '{text}'; it must be WIDTHxHEIGHT in pixels, e.g. 96x72")
    return int(width), int(height)
