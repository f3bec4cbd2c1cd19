"""`mtv-world task`: draft the YAML of a task from an instruction."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from mtv_world_ros.cli.shared_options import add_options, names
from mtv_world_ros.core.files import check_free

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands


def add(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'task',
        help='draft the YAML of a task from an instruction',
        epilog='The relation is guessed from the words of the instruction: read the file. '
        'evaluate, imagine, replay --offline and fit success take it as --task, the node as the '
        'parameter task.',
    )
    parser.add_argument('instruction', help='text for the robot, e.g. "put the cup on the plate"')
    parser.add_argument(
        '--objects',
        type=names,
        required=True,
        metavar='NAMES',
        help='names of its objects, comma-separated, as the instruction says them; the others are '
        'placed by the last one',
    )
    parser.add_argument(
        '--relation', default='', metavar='KIND', help='what must hold; default: by its words'
    )
    parser.add_argument('--out', type=Path, help='YAML to write; default: NAME.yaml')
    add_options(parser, 'overwrite')
    parser.set_defaults(handler=_task)


def _task(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.core.files import write_whole
    from mtv_world_ros.success.task_draft import draft_task

    draft = draft_task(arguments.instruction, arguments.objects, arguments.relation)
    out = arguments.out or Path(f'{draft.task.name}.yaml')
    check_free(out, arguments.overwrite)
    write_whole(out, draft.text)
    print(f'{draft.text}written: {out}; use it with: --task {out}')
    return 0
