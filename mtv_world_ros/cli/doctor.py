"""`mtv-world doctor`."""

from __future__ import annotations

import argparse
from pathlib import Path
import sys
import tempfile
from typing import TYPE_CHECKING

from mtv_world_ros.cli.shared_options import add_source
from mtv_world_ros.errors import ConfigError

if TYPE_CHECKING:
    from mtv_world_ros.data.episode import Episode
    from mtv_world_ros.inspection.inspect import Inspector
    from mtv_world_ros.inspection.inspection_report import Inspection


#: exit status by verdict; 2 is argparse's
_STATUS = {'ok': 0, 'not checked': 3, 'suspicious': 1, 'broken': 1}


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser(
        'doctor',
        help='check calibration, joints and clocks of an episode or of running topics',
        epilog='Exit status: 0 where everything was checked and is ok, 1 where something is '
        'suspicious or broken, 3 where nothing wrong was found but not everything could be '
        'checked.',
    )
    parser.add_argument('episode', type=Path, nargs='?')
    parser.add_argument('--live', action='store_true', help='check the running ROS topics')
    parser.add_argument(
        '--seconds', type=float, default=10.0, help='with --live: how long to record'
    )
    parser.add_argument('--views', help='comma-separated; default: all; needed with --live')
    add_source(parser)
    parser.add_argument('--robot', help="YAML, or a bundled robot; default: the episode's")
    parser.add_argument('--out', type=Path, help='default: out/doctor/<episode>')
    parser.set_defaults(handler=_doctor)


def _doctor(arguments: argparse.Namespace) -> int:
    if arguments.live == (arguments.episode is not None):
        raise ConfigError('name an EPISODE, or give --live to check the running topics')
    if not arguments.live:
        return _check(arguments, arguments.episode, arguments.episode.name)
    from mtv_world_ros.inspection.live import record_topics

    views = _views(arguments)
    if not views:
        raise ConfigError('--live needs the names of the views: --views low,high')
    if arguments.robot is None or arguments.calibration is None:
        raise ConfigError('--live needs --robot and --calibration: topics do not carry them')
    with tempfile.TemporaryDirectory(prefix='mtv_world_doctor_') as folder:
        print(f'recording {", ".join(views)} for {arguments.seconds:g} s', file=sys.stderr)
        bag = record_topics(views, Path(folder) / 'live', arguments.seconds)
        return _check(arguments, bag, 'live')


def _check(arguments: argparse.Namespace, path: Path, name: str) -> int:
    from mtv_world_ros.assembly import recorded_robot, robot_path
    from mtv_world_ros.data.bag_mapping import load_source
    from mtv_world_ros.data.episode_reader import read_episode, read_info
    from mtv_world_ros.inspection.inspect import load_inspector
    from mtv_world_ros.inspection.inspection_report import to_text

    source = load_source(arguments.topics, arguments.calibration)
    robot = arguments.robot or (source.mapping.robot if source.mapping else '')
    file = robot_path(robot) if robot else recorded_robot(path, read_info(path).robot)
    inspector = load_inspector(file)
    episode = read_episode(
        path,
        views=_views(arguments),
        calibration=source.calibration,
        with_masks=False,
        mapping=source.mapping,
        robot=inspector.robot,
    )
    inspection = inspector.inspect(episode)
    out = arguments.out or Path('out/doctor') / name
    _write(inspector, episode, inspection, out)
    print(to_text(inspection))
    print(f"{inspection.verdict}: see '{out / 'report.md'}'")
    return _STATUS[inspection.verdict]


def _write(inspector: Inspector, episode: Episode, inspection: Inspection, out: Path) -> None:
    from mtv_world_ros.data.bag.messages import encode_png
    from mtv_world_ros.inspection.inspection_report import to_markdown

    out.mkdir(parents=True, exist_ok=True)
    pictures = {}
    for view in episode.views:
        pictures[view] = f'{view}.png'
        (out / pictures[view]).write_bytes(encode_png(inspector.picture(episode, view)))
    (out / 'report.md').write_text(to_markdown(inspection, pictures), encoding='utf-8')


def _views(arguments: argparse.Namespace) -> list[str] | None:
    if arguments.views is None:
        return None
    return [name.strip() for name in arguments.views.split(',') if name.strip()]
