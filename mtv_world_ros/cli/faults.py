"""`mtv-world faults`: what can be wrong with a scripted policy."""

from __future__ import annotations

import argparse


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser(
        'faults',
        help="print the kinds of faults that scripted policies may have, and what each one's size "
        'means',
        description='Prints fault kinds: name and earlier name, family, split, typical and '
        'largest size, and what the size means. A policy is called expert-NAME-SIZE.',
    )
    parser.add_argument(
        'kinds',
        nargs='?',
        default='',
        metavar='KINDS',
        help='a split (train, calibrate, test), drawn:SEED, or comma-separated names; default: '
        'all of the catalogue',
    )
    parser.set_defaults(handler=_faults)


def _faults(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.simulation.faults.catalogue import FAULTS, kind_named, kinds_named

    names = kinds_named(arguments.kinds) if arguments.kinds else tuple(FAULTS)
    for kind in map(kind_named, names):
        fault = FAULTS[kind]
        typical, largest = (
            f'{size:g} {fault.size.unit}'.strip()
            for size in (fault.size.typical, fault.size.largest)
        )
        called = f' ({fault.alias})' if fault.alias else ''
        print(f'{kind}{called}: {fault.family}, {fault.split}; {typical}, at most {largest}')
        print(f'    {fault.text}')
    return 0
