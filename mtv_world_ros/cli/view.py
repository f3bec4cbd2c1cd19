"""`mtv-world view`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from mtv_world_ros.cli.shared_options import add_options
from mtv_world_ros.core.errors import ConfigError, EpisodeError
from mtv_world_ros.core.files import check_free
from mtv_world_ros.viewing.viewer_process import PageAddress

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands
    from mtv_world_ros.viewing.scored_rollout import ScoredRollout
    from mtv_world_ros.viewing.streams import Streams

_DESCRIPTION = """\
Show real, drawn and imagined frames of every view on one timeline, masks outlined, joints, the
success estimate and its reasons. PATH is an episode, predictions, an imagined episode, the folder
of mtv-world demo, or, with a tab for each of its episodes, that of mtv-world imagine or evaluate,
or of mtv-world rank (its worst rollouts); bags of the same time that are given together are shown
together, e.g. an episode and its predictions. --live shows what the cameras and the node publish
now. Needs the extra `view`.
"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'view',
        help='show episodes, predictions, evaluations, rankings or a running node in Rerun',
        description=_DESCRIPTION,
    )
    parser.add_argument(
        'paths', type=Path, nargs='*', metavar='PATH', help='what to show, see above'
    )
    parser.add_argument(
        '--live', action='store_true', help='show the topics of running nodes, until Ctrl-C'
    )
    parser.add_argument(
        '--port',
        type=PageAddress.parse,
        default=PageAddress(),
        metavar='[ADDRESS:]PORT',
        help='port of the page for browsers on this machine; with an address, e.g. 0.0.0.0:9090, '
        'others can see what is shown and write to it (default: %(default)s)',
    )
    parser.add_argument(
        '--save', type=Path, metavar='FILE.rrd', help='write a file for the viewer, then exit'
    )
    parser.add_argument('--native', action='store_true', help='open a window, not a browser page')
    parser.add_argument(
        '--episodes',
        type=int,
        default=8,
        metavar='N',
        help='number of episodes: the first N of an evaluation, the worst N of a ranking',
    )
    add_options(parser, 'overwrite')
    parser.set_defaults(handler=_view)


def _view(arguments: argparse.Namespace) -> int:
    if bool(arguments.paths) == arguments.live:
        raise ConfigError('give one PATH or more to show, or --live for what is published now')
    for path in arguments.paths:
        if not path.exists():
            raise EpisodeError(f"there is no '{path}'")
    if arguments.save is not None:
        check_free(arguments.save, arguments.overwrite, '--save FILE')
    return _view_live(arguments) if arguments.live else _view_paths(arguments)


def _view_paths(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.viewing import rerun_log

    stream = rerun_log.recording('_'.join(path.name for path in arguments.paths))
    shown = _shown(arguments)
    told = rerun_log.open_viewer(
        stream, rerun_log.layout(shown), arguments.port, arguments.save, arguments.native
    )
    if arguments.save is None:
        print(told, flush=True)
    for root, one in shown.items():
        rerun_log.log_any(stream, one, root)
    rerun_log.flush(stream, arguments.save)
    if arguments.save is not None:
        print(told)
    elif not arguments.native:
        _wait()
    return 0


def _view_live(arguments: argparse.Namespace) -> int:
    import runpy
    import sys

    sys.argv = ['mtv-world view', '--port', str(arguments.port)]
    sys.argv += ['--native'] if arguments.native else []
    sys.argv += ['--save', str(arguments.save)] if arguments.save is not None else []
    runpy.run_module('mtv_world_ros.ros.live_viewer', run_name='__main__')
    return 0


def _shown(arguments: argparse.Namespace) -> dict[str, Streams | ScoredRollout]:
    """Return the content of the paths, by path of its entities."""
    from mtv_world_ros.data.episode_reader import list_episodes
    from mtv_world_ros.viewing.scored_rollout import is_scored, scored_rollouts
    from mtv_world_ros.viewing.streams import read_streams

    found: dict[str, Streams | ScoredRollout] = {}
    bags = []
    for path in arguments.paths:
        if is_scored(path):
            found |= {f'/{one.name}': one for one in scored_rollouts(path, arguments.episodes)}
        elif (path / 'episodes.json').is_file():
            episodes = list_episodes(path)[: arguments.episodes]
            found |= {f'/{one.name}': read_streams([one]) for one in episodes}
        else:
            bags.append(_bag(path))
    if bags:
        found = {'/bag': read_streams(bags), **found}
    if not found:
        raise EpisodeError(
            f'{", ".join(map(str, arguments.paths))}: no frames were kept; run it into another '
            "--out: 'mtv-world rank' without --no-video"
        )
    return found


def _bag(path: Path) -> Path:
    """Return the bag of a path: itself, or the predictions in the folder of `mtv-world demo`."""
    from mtv_world_ros.data.episode_reader import list_episodes

    if (path / 'predictions').is_dir():
        return path / 'predictions'
    inside = list_episodes(path)
    if inside and path not in inside:
        raise EpisodeError(f"'{path}' is a folder of episodes; name one, e.g. '{inside[0]}'")
    return path


def _wait() -> None:
    import threading

    print('Ctrl-C ends it', flush=True)
    threading.Event().wait()
