"""The command `mtv-world`."""

from __future__ import annotations

import argparse
import sys

from mtv_world_ros.cli import (
    calibrate,
    collect,
    demo,
    distill,
    doctor,
    evaluate,
    imagine,
    import_dataset,
    import_weights,
    rank,
    recover,
    replay,
    report,
    train,
    train_motion,
)
from mtv_world_ros.errors import MtvWorldError

COMMANDS = (
    demo,
    replay,
    imagine,
    collect,
    train,
    train_motion,
    distill,
    evaluate,
    rank,
    calibrate,
    report,
    doctor,
    recover,
    import_dataset,
    import_weights,
)
#: of the extra `evaluate`, which several commands need
_EVALUATE_PACKAGES = ('matplotlib', 'scipy')


def make_parser() -> argparse.ArgumentParser:
    """Returns the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='mtv-world', description='An online embodied world model for ROS 2.'
    )
    commands = parser.add_subparsers(required=True, metavar='COMMAND')
    for command in COMMANDS:
        command.add(commands)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Runs a command; returns the exit status (1 for an error of the user's)."""
    parser = make_parser()
    arguments, more = parser.parse_known_args(argv)
    arguments.player = more
    arguments.command_line = sys.argv[1:] if argv is None else argv
    if more and not getattr(arguments, 'takes_player_options', lambda _: False)(arguments):
        parser.error(f'unrecognized arguments: {" ".join(more)}')
    try:
        return arguments.handler(arguments)
    except MtvWorldError as error:
        print(f'mtv-world: {error}', file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        package = (error.name or '').partition('.')[0]
        if package not in _EVALUATE_PACKAGES:
            raise
        print(
            f"mtv-world: {package} is not installed: pip install 'mtv_world_ros[evaluate]'",
            file=sys.stderr,
        )
        return 1
    except KeyboardInterrupt:
        return 130
