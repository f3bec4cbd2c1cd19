"""`mtv-world check`: do calibration, joints, clocks and images of a recording fit together."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import json
from pathlib import Path
import sys
import tempfile
from typing import TYPE_CHECKING

from mtv_world_ros.cli.bundled_help import robots
from mtv_world_ros.cli.fits.several_cameras import (
    read_for_checks,
    robot_file,
)
from mtv_world_ros.cli.shared_options import add_options, names
from mtv_world_ros.core.errors import ConfigError

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands
    from mtv_world_ros.data.episode import Episode
    from mtv_world_ros.inspection.inspect import Inspector
    from mtv_world_ros.inspection.inspection_report import Inspection


def add(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'check',
        help='check calibration, joints, clocks and pictures of an episode, of all episodes of a '
        'folder, or of running topics',
        epilog='Exit status: 0 where every camera was checked and is ok (an arm that rests is '
        'named), 1 where something is suspicious or broken, 3 where nothing wrong was found but '
        'a camera or the recording could not be checked.',
    )
    parser.add_argument('episode', type=Path, nargs='?', help='an episode, or a folder of them')
    parser.add_argument('--live', action='store_true', help='check the running ROS topics')
    parser.add_argument(
        '--seconds', type=float, default=10.0, help='with --live: how long to record'
    )
    parser.add_argument(
        '--views',
        type=names,
        help='names of the views, comma-separated; default: all; needed with --live',
    )
    add_options(parser, 'source')
    parser.add_argument('--robot', help=f"{robots()}; default: the episode's")
    parser.add_argument(
        '--out', type=Path, help='folder of the report; default: out/check/<episode>'
    )
    parser.set_defaults(handler=_run, default_out=_default_out)


def _default_out(arguments: argparse.Namespace) -> Path:
    name = 'live' if arguments.episode is None else arguments.episode.resolve().name
    return Path('out/check') / name


def _run(arguments: argparse.Namespace) -> int:
    if arguments.live == (arguments.episode is not None):
        raise ConfigError('name an EPISODE, or give --live to check the running topics')
    if not arguments.live:
        paths = _episodes_in(arguments.episode)
        if paths:
            return _check_folder(arguments, paths)
        return _check(arguments, arguments.episode)
    from mtv_world_ros.inspection.live import record_topics

    if not arguments.views:
        raise ConfigError('--live needs the names of the views: --views low,high')
    if arguments.robot is None or arguments.calibration is None:
        raise ConfigError('--live needs --robot and --calibration: topics do not carry them')
    with tempfile.TemporaryDirectory(prefix='mtv_world_check_') as folder:
        print(
            f'recording {", ".join(arguments.views)} for {arguments.seconds:g} s', file=sys.stderr
        )
        bag = record_topics(arguments.views, Path(folder) / 'live', arguments.seconds)
        return _check(arguments, bag)


def _episodes_in(path: Path) -> list[Path]:
    """Return the episodes of a folder that is none itself."""
    from mtv_world_ros.data.episode_reader import list_episodes

    found = list_episodes(path) if path.is_dir() else []
    return [] if path in found else found


def _check_folder(arguments: argparse.Namespace, paths: Sequence[Path]) -> int:
    from mtv_world_ros.core.files import write_json, write_whole
    from mtv_world_ros.core.images import write_png
    from mtv_world_ros.core.progress import Progress
    from mtv_world_ros.inspection.folder import (
        broken_parts,
        folder_markdown,
        folder_picture,
        folder_text,
        inspect_folder,
    )
    from mtv_world_ros.inspection.inspect import load_inspector
    from mtv_world_ros.inspection.inspection_report import BROKEN, CHECKED, EXIT_STATUS, to_json

    file, source = robot_file(arguments, paths[0])
    inspector = load_inspector(file)
    found, pictures = inspect_folder(
        Progress(paths, unit='episode'),
        inspector,
        lambda path: read_for_checks(
            path,
            arguments.views,
            source,
            inspector.robot,
            inspector.robot.base_link,
            with_masks=True,
        ),
    )
    out = arguments.out or _default_out(arguments)
    picture = folder_picture(pictures)
    if picture is not None:
        write_png(out / 'episodes.png', picture)
    write_whole(out / 'report.md', folder_markdown(found, 'episodes.png'))
    write_whole(out / BROKEN, json.dumps(broken_parts(found), indent=2))
    values = {
        'verdict': found.verdict,
        'exit_status': EXIT_STATUS[found.verdict],
        'wrong': [finding.text for finding in found.findings],
        'episodes': to_json(found.episodes, found.failed),
    }
    write_json(out / CHECKED, values)
    print(folder_text(found))
    print(f"{found.verdict}: see '{out / 'report.md'}'")
    return EXIT_STATUS[found.verdict]


def _check(arguments: argparse.Namespace, path: Path) -> int:
    from functools import partial

    from mtv_world_ros.core.progress import Progress
    from mtv_world_ros.inspection.inspect import load_inspector
    from mtv_world_ros.inspection.inspection_report import EXIT_STATUS, to_text

    file, source = robot_file(arguments, path)
    inspector = load_inspector(file)
    robot = inspector.robot
    episode = read_for_checks(
        path, arguments.views, source, robot, robot.base_link, with_masks=True
    )
    bar = partial(Progress, desc='comparing', unit='view')
    inspection = inspector.inspect(episode, bar)
    out = arguments.out or _default_out(arguments)
    _write_inspection(inspector, episode, inspection, out)
    print(to_text(inspection))
    print(f"{inspection.verdict}: see '{out / 'report.md'}'")
    return EXIT_STATUS[inspection.verdict]


def _write_inspection(
    inspector: Inspector, episode: Episode, inspection: Inspection, out: Path
) -> None:
    from mtv_world_ros.core.files import write_json, write_whole
    from mtv_world_ros.core.images import write_png
    from mtv_world_ros.inspection.inspection_report import (
        CHECKED,
        EXIT_STATUS,
        to_json,
        to_markdown,
    )

    pictures = {}
    for view in episode.views:
        pictures[view] = f'{view}.png'
        write_png(out / pictures[view], inspector.picture(episode, view))
    write_whole(out / 'report.md', to_markdown(inspection, pictures))
    values = {
        'verdict': inspection.verdict,
        'exit_status': EXIT_STATUS[inspection.verdict],
        'wrong': [],
        'episodes': to_json({episode.info.path.name: inspection}),
    }
    write_json(out / CHECKED, values)
