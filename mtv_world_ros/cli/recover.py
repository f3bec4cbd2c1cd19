"""`mtv-world recover`: whole bags of recordings that were killed or cut off."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from mtv_world_ros.core.errors import EpisodeError

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands
    from mtv_world_ros.importing.recover import Recovered


def add(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'recover', help='make whole bags of recordings that were killed or cut off'
    )
    parser.add_argument(
        'bag',
        type=Path,
        help='a damaged bag, the name a recording would have had, or the folder it was made in '
        '(recordings in progress are hidden folders .NAME.*.tmp)',
    )
    parser.add_argument(
        '--out', type=Path, help='bag to make, e.g. on another disk; default: beside the damaged'
    )
    parser.set_defaults(handler=_recover)


def _recover(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.importing.recover import find_damaged, recover

    damaged, lost = find_damaged(arguments.bag), []
    for source in damaged:
        out = arguments.out
        if out is not None and len(damaged) > 1:
            out = out / source.name.strip('.')
        try:
            _print_recovered(recover(source, out))
        except EpisodeError as error:  # of this one; the others may hold something
            lost.append(str(error))
    if lost:
        raise EpisodeError('; '.join(lost))
    return 0


def _print_recovered(bag: Recovered) -> None:
    total = sum(bag.num_messages.values())
    print(f"recovered '{bag.path}': {total} messages over {bag.seconds:.1f} s")
    for topic, count in sorted(bag.num_messages.items()):
        print(f'  {topic} {count}')
    for line in bag.lost:
        print(f'  lost: {line}')
    print(f"  '{bag.source}' is as it was; delete it once you have looked at the new bag")
