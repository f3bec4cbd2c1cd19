"""`mtv-world view`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, TYPE_CHECKING

from mtv_world_ros.cli.shared_options import add_overwrite
from mtv_world_ros.errors import EpisodeError
from mtv_world_ros.files import check_free

if TYPE_CHECKING:
    from mtv_world_ros.evaluation.results import StoredRollout
    from mtv_world_ros.viewing.streams import Streams

_DESCRIPTION = """\
Shows real, drawn and imagined frames of every view on one timeline, masks outlined, joints, the
success estimate and its reasons. PATH is an episode, predictions, an imagined episode, the folder
of mtv-world demo, or an evaluation (its episodes are tabs); bags of the same time that are given
together are shown together, e.g. an episode and its predictions. Needs the extra `view`.
"""


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser(
        'view',
        help='show episodes, predictions and evaluations in the Rerun viewer',
        description=_DESCRIPTION,
    )
    parser.add_argument('paths', type=Path, nargs='+', metavar='PATH')
    parser.add_argument(
        '--port', type=int, default=9090, help='of the viewer for browsers on this machine'
    )
    parser.add_argument(
        '--save', type=Path, metavar='FILE.rrd', help='write a file for the viewer, then exit'
    )
    parser.add_argument('--native', action='store_true', help='open a window, not a browser page')
    parser.add_argument(
        '--episodes', type=int, default=8, metavar='N', help='of an evaluation, the first N'
    )
    add_overwrite(parser)
    parser.set_defaults(handler=_view)


def _view(arguments: argparse.Namespace) -> int:
    for path in arguments.paths:
        if not path.exists():
            raise EpisodeError(f"there is no '{path}'")
    if arguments.save is not None:
        check_free(arguments.save, arguments.overwrite, '--save FILE')
    from mtv_world_ros.viewing import rerun_log

    stream = rerun_log.recording('_'.join(path.name for path in arguments.paths))
    shown = _shown(arguments)
    blueprint = rerun_log.layout(shown)
    if arguments.save is not None:
        rerun_log.save(stream, blueprint, arguments.save)
    elif arguments.native:
        stream.spawn(default_blueprint=blueprint)
    else:
        print(f'open {rerun_log.serve(stream, blueprint, arguments.port)}', flush=True)
    _log(stream, shown)
    stream.flush()
    if arguments.save is not None:
        print(f'written: {arguments.save}')
    elif not arguments.native:
        _wait()
    return 0


def _shown(arguments: argparse.Namespace) -> dict[str, Streams | StoredRollout]:
    """What the paths hold, by path of its entities."""
    from mtv_world_ros.evaluation.report.read_back import read_evaluations
    from mtv_world_ros.viewing.streams import read_streams

    found: dict[str, Any] = {}
    bags = []
    for path in arguments.paths:
        if (path / 'metrics.json').is_file():
            for evaluated in read_evaluations(path):
                names = sorted(evaluated.results)[: arguments.episodes]
                rollouts = {name: evaluated.rollout(name) for name in names}
                label = evaluated.metrics.get('label') or path.name
                found |= {f'/{label}/{n}': r for n, r in rollouts.items() if r is not None}
        else:
            bags.append(path / 'predictions' if (path / 'predictions').is_dir() else path)
    if bags:
        found = {'/bag': read_streams(bags), **found}
    if not found:
        raise EpisodeError(f'no frames were kept in {", ".join(map(str, arguments.paths))}')
    return found


def _log(stream: Any, shown: dict[str, Streams | StoredRollout]) -> None:
    from mtv_world_ros.viewing import rerun_log
    from mtv_world_ros.viewing.streams import Streams

    for root, one in shown.items():
        if isinstance(one, Streams):
            rerun_log.log_streams(stream, one, root)
        else:
            rerun_log.log_rollout(stream, one, root)


def _wait() -> None:
    import threading

    print('Ctrl-C ends it', flush=True)
    threading.Event().wait()
