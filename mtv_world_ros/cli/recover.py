"""`mtv-world recover`."""

from __future__ import annotations

import argparse
from pathlib import Path


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
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
    from mtv_world_ros.data.bag.recover import find_damaged, recover

    damaged = find_damaged(arguments.bag)
    for source in damaged:
        out = arguments.out
        if out is not None and len(damaged) > 1:
            out = out / source.name.strip('.')
        bag = recover(source, out)
        total = sum(bag.num_messages.values())
        print(f"recovered '{bag.path}': {total} messages over {bag.seconds:.1f} s")
        for topic, count in sorted(bag.num_messages.items()):
            print(f'  {topic} {count}')
        for line in bag.lost:
            print(f'  lost: {line}')
        print(f"  '{source}' is as it was; delete it once you have looked at the new bag")
    return 0
