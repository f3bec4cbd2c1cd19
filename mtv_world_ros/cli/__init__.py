"""The command `mtv-world`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import shlex
import sys

from mtv_world_ros.cli import (
    calibrate,
    collect,
    datasets,
    demo,
    distill,
    evaluate,
    imagine,
    import_weights,
    own_robot,
    rank,
    train,
    train_motion,
    view,
)
from mtv_world_ros.errors import MtvWorldError, nearest, TrainingInterrupted

COMMANDS = (
    demo,
    imagine,
    collect,
    train,
    train_motion,
    distill,
    evaluate,
    rank,
    calibrate,
    view,
    own_robot,
    datasets,
    import_weights,
)
#: of the extra `evaluate`, which several commands need
_EVALUATE_PACKAGES = ('matplotlib', 'scipy')


def make_parser() -> argparse.ArgumentParser:
    """Returns the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='mtv-world', description='An online embodied world model for ROS 2.'
    )
    parser.add_argument('--version', action=_Version, nargs=0, help='print the version, then exit')
    commands = parser.add_subparsers(required=True, metavar='COMMAND')
    for command in COMMANDS:
        command.add(commands)
    return parser


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib import metadata

        print(f'mtv-world {metadata.version("mtv_world_ros")}')
        parser.exit()


def _parsed(words: Sequence[str]) -> argparse.Namespace:
    parser = make_parser()
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    if words and not words[0].startswith('-') and words[0] not in commands.choices:
        known = list(commands.choices)
        parser.error(
            f"there is no command '{words[0]}'{nearest(words[0], known)}; commands are "
            f'{", ".join(known)}'
        )
    arguments, more = parser.parse_known_args(words)
    arguments.player, arguments.command_line = more, list(words)
    if more and not getattr(arguments, 'takes_player_options', lambda _: False)(arguments):
        options = commands.choices[words[0]]._option_string_actions
        hints = [f'{word}{nearest(word, options)}' for word in more]
        parser.error(f'unrecognized arguments: {" ".join(hints)}')
    return arguments


def main(argv: list[str] | None = None) -> int:
    """Runs a command; returns the exit status (1 for an error of the user's)."""
    arguments = _parsed(sys.argv[1:] if argv is None else argv)
    try:
        return arguments.handler(arguments)
    except TrainingInterrupted as stopped:
        print(
            f'mtv-world: {stopped}; go on with: '
            f'{shlex.join(["mtv-world", *arguments.command_line])}',
            file=sys.stderr,
        )
        return 128 + stopped.signum
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
