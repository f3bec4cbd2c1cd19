# PYTHON_ARGCOMPLETE_OK
"""The command `mtv-world`."""

from __future__ import annotations

from contextlib import suppress
import signal

# Ctrl-C while the rest is imported ends the process, without a traceback; see `main` for later
_interrupt = signal.getsignal(signal.SIGINT)
if _interrupt is signal.default_int_handler:
    with suppress(ValueError):  # another thread imports this
        signal.signal(signal.SIGINT, signal.SIG_DFL)

import argparse  # noqa: E402
from collections.abc import Iterable, Sequence  # noqa: E402
import errno  # noqa: E402
from importlib import import_module, metadata  # noqa: E402
import os  # noqa: E402
from pathlib import Path  # noqa: E402
import re  # noqa: E402
import shlex  # noqa: E402
import sys  # noqa: E402
from types import ModuleType  # noqa: E402
from typing import Any  # noqa: E402

from mtv_world_ros.core.entry_points import broken, COMMANDS, load, registered  # noqa: E402
from mtv_world_ros.core.errors import (  # noqa: E402
    ConfigError,
    MtvWorldError,
    nearest,
    TrainingInterrupted,
)
from mtv_world_ros.core.files import check_output  # noqa: E402
from mtv_world_ros.core.processes import (  # noqa: E402
    ended_by_signals,
    escape_unprintable_output,
    stopped_by_sigterm,
)

if _interrupt is signal.default_int_handler:
    with suppress(ValueError):
        signal.signal(signal.SIGINT, _interrupt)

_FULL = '; make room and run the command again'
_MORE_MEMORY = (
    ': the memory does not suffice; is a file larger than it should be? Else give fewer '
    'recordings, views or --workers'
)
_READ_ONLY = '; choose another folder'
#: options that name what a command writes
_OUTPUTS = ('out', 'picture', 'save')
#: modules of commands as `--help` shows them; those of other packages come last
_ORDER = (
    'demo',
    'imagine',
    'collect',
    'train',
    'fit_contact',
    'foresee',
    'evaluate',
    'rank',
    'faults',
    'calibrate',
    'view',
    'own_robot',
    'datasets',
    'import_weights',
)
_EMPTY = "it is empty; leave it out, or give a path or a name ('.' is the present folder)"
#: commands that left, and the last version that has them
_REMOVED = {'distill': '0.1.0', 'train-motion': '0.1.0'}
_ADVICE = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EFBIG: _FULL,
    errno.EROFS: _READ_ONLY,
    errno.EACCES: _READ_ONLY,
}


def make_parser() -> argparse.ArgumentParser:
    """Returns the parser of the command line."""
    parser = _Parser(prog='mtv-world', description='An online embodied world model for ROS 2.')
    parser.add_argument('--version', action=_Version, nargs=0, help='print the version, then exit')
    commands = parser.add_subparsers(required=True, metavar='COMMAND')
    for entry in _commands():
        module: ModuleType = load(entry)
        try:
            module.add(commands)
        except Exception as error:  # without `add`, or of a name that is taken
            raise broken(entry, error) from error
    return parser


def _commands() -> Iterable[metadata.EntryPoint]:
    """The commands, in the order of `--help`.

    Raises:
        ConfigError: none is registered.
    """
    found = registered(COMMANDS)
    if not found:
        raise ConfigError(
            'the installed mtv_world_ros registers no commands; install it again: make, or '
            'pip install --no-deps --no-build-isolation -e .'
        )
    others = sorted(found.keys() - set(_ORDER))
    return [found[name] for name in (*_ORDER, *others) if name in found]


class _Parser(argparse.ArgumentParser):
    """Refuses empty paths, which Python reads as the present folder."""

    def __init__(self, **how: Any) -> None:
        super().__init__(**how)
        self.register('type', Path, _path)


def _path(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError(_EMPTY)
    return Path(text)


def _check_texts(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Refuses an empty text that is not the option's default."""
    for action in parser._actions:
        given = getattr(arguments, action.dest, None)
        is_empty = '' in given if isinstance(given, list) else given == ''
        if is_empty and action.type is None and '' not in (action.default, action.const):
            parser.error(str(argparse.ArgumentError(action, _EMPTY)))


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        print(f'mtv-world {metadata.version("mtv_world_ros")}')
        parser.exit()


def _parsed(words: Sequence[str]) -> argparse.Namespace:
    parser = make_parser()
    with suppress(ImportError):  # completion in the shell, where this is installed
        import_module('argcomplete').autocomplete(parser)
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    if words and not words[0].startswith('-') and words[0] not in commands.choices:
        known = list(commands.choices)
        if words[0] in _REMOVED:
            parser.error(
                f"'{words[0]}' is no longer a command: no measurement showed its worth; version "
                f'{_REMOVED[words[0]]} has it. Commands are {", ".join(known)}'
            )
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
    _check_texts(commands.choices[words[0]], arguments)
    for name in _OUTPUTS:
        given = getattr(arguments, name, None)
        path = getattr(arguments, f'default_{name}', None) if given is None else given
        if isinstance(path, Path):
            check_output(path, f'--{name}')
    return arguments


def main(argv: list[str] | None = None) -> int:
    """Runs a command; returns the exit status.

    That is 1 for an error of the user's or of the disk, and 128 + n where signal n ended it.
    """
    escape_unprintable_output()
    try:
        with ended_by_signals('mtv-world'):
            arguments = _parsed(sys.argv[1:] if argv is None else argv)
    except ConfigError as error:  # of the installation
        return _said(str(error), 1)
    try:
        with stopped_by_sigterm():
            return arguments.handler(arguments)
    except TrainingInterrupted as stopped:
        again = shlex.join(['mtv-world', *arguments.command_line])
        return _said(f'{stopped}; go on with: {again}', 128 + stopped.signum)
    except BrokenPipeError:  # `mtv-world ... | head` has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except (MtvWorldError, OSError, MemoryError) as error:
        return _said(f'{error}{_advice(error)}', 1)
    except ModuleNotFoundError as error:
        package = (error.name or '').partition('.')[0]
        extra = _extra_of(package)
        if not extra:
            raise
        ways = f"make in the folder of mtv_world_ros, or pip install 'mtv_world_ros[{extra}]'"
        return _said(f'{package} is not installed: {ways}', 1)
    except KeyboardInterrupt as stopped:
        number = getattr(stopped, 'signum', signal.SIGINT)
        return _said(f'stopped ({signal.Signals(number).name})', 128 + number)


def _extra_of(package: str) -> str:
    """The first extra of this package that asks for another one; empty = none does."""
    for line in metadata.requires('mtv_world_ros') or ():
        found = re.match(rf'{re.escape(package)}\b(?!-).*extra == .(\w+)', line)
        if found and package:
            return found[1]
    return ''


def _advice(error: Exception) -> str:
    if isinstance(error, MemoryError):
        return _MORE_MEMORY if str(error) else _MORE_MEMORY.removeprefix(': ')
    return _ADVICE.get(error.errno or 0, '') if isinstance(error, OSError) else ''


def _said(text: str, status: int) -> int:
    """Prints the line on stderr and returns the status."""
    print(f'mtv-world: {text}', file=sys.stderr)
    return status
