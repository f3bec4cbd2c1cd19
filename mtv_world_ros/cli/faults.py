"""`mtv-world rank --list-faults`: kinds of faults that scripted policies may have."""

from __future__ import annotations

import argparse
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import CommandParser


class ListFaults(argparse.Action):
    """Option that prints fault kinds and ends the process.

    A line has the name and the earlier one, family, split, typical and largest size; the next one
    says what the size means. A policy is called expert-NAME-SIZE.
    """

    def __call__(self, parser: CommandParser, namespace: object, values: Any, *_: object) -> None:
        """Print the kinds that were asked for."""
        print_faults(values or '')
        parser.exit()


def print_faults(asked: str) -> None:
    """Print fault kinds: name, family, split, sizes, and the meaning of the size.

    Args:
        asked: a split (train, calibrate, test), drawn:SEED, or comma-separated names; empty = all
            of the catalogue.

    Raises:
        ConfigError: there is no such kind.
    """
    from mtv_world_ros.simulation.faults.catalogue import FAULTS, kind_named, kinds_named

    names = kinds_named(asked) if asked else tuple(FAULTS)
    for kind in map(kind_named, names):
        fault = FAULTS[kind]
        typical, largest = (
            f'{size:g} {fault.size.unit}'.strip()
            for size in (fault.size.typical, fault.size.largest)
        )
        called = f' ({fault.alias})' if fault.alias else ''
        print(f'{kind}{called}: {fault.family}, {fault.split}; {typical}, at most {largest}')
        print(f'    {fault.text}')
