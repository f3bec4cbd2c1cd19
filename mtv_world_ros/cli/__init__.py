# PYTHON_ARGCOMPLETE_OK
"""The command `mtv-world`."""

from __future__ import annotations

from contextlib import contextmanager, ExitStack, suppress
import signal

# Ctrl-C while the rest is imported ends the process, without a traceback; see `main` for later
_interrupt = signal.getsignal(signal.SIGINT)
if _interrupt is signal.default_int_handler:
    with suppress(ValueError):  # another thread imports this
        signal.signal(signal.SIGINT, signal.SIG_DFL)

import argparse  # noqa: E402
from collections.abc import Iterator, Sequence  # noqa: E402
import errno  # noqa: E402
from importlib import import_module, metadata  # noqa: E402
import os  # noqa: E402
from pathlib import Path  # noqa: E402
import shlex  # noqa: E402
import sys  # noqa: E402
import threading  # noqa: E402
import time  # noqa: E402
from types import ModuleType  # noqa: E402
from typing import Any  # noqa: E402
import warnings  # noqa: E402

from mtv_world_ros.cli.commands import (  # noqa: E402
    COMMANDS,
    REMOVED,
    REMOVED_OPTIONS,
    SECTIONS,
)
from mtv_world_ros.cli.parser import CommandParser, EMPTY  # noqa: E402
from mtv_world_ros.core import entry_points  # noqa: E402
from mtv_world_ros.core.errors import (  # noqa: E402
    MtvWorldError,
    nearest,
    TrainingInterrupted,
    UnknownNameError,
)
from mtv_world_ros.core.files import check_name, check_output  # noqa: E402
from mtv_world_ros.core.processes import (  # noqa: E402
    ended_by_signals,
    is_helper_rank,
    prepare_output,
    prepare_process,
    stopped_by_sigterm,
)
from mtv_world_ros.core.shown_text import MOST_OF_ERROR, shown  # noqa: E402
from mtv_world_ros.core.writer_lock import only_writer  # noqa: E402

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
#: groups of commands of two words -> their help
_GROUPS = {
    'import': 'convert recordings and weights of others',
    'fit': 'fit parameters to recordings',
    'export': 'write episodes and results in other formats',
}
_OWN = 'mtv_world_ros.'
#: time after which a command says that it is loading; most mistakes are found before [s]
_FIRST_LINE_S = 0.5
#: time between further lines until the progress is shown [s]
_NEXT_LINE_S = 30.0
#: control characters that messages may hold
_LINES = '\n\t'
_DESCRIPTION = 'An online embodied world model for ROS 2.'
#: second line of `mtv-world --help`
_BEGIN = 'Begin with `mtv-world demo`. `mtv-world COMMAND --help` has the options of a command.'
_USAGE = 'mtv-world [-h] [--version] COMMAND ...'
_ADVICE = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EFBIG: _FULL,
    errno.EROFS: _READ_ONLY,
    errno.EACCES: _READ_ONLY,
}


def make_parser(*wanted: str) -> argparse.ArgumentParser:
    """Return the parser of the command line.

    Args:
        wanted: commands of the table to add, such as 'train' or 'import bag'; default: all
            commands, with those of other packages. Modules of other commands are not imported.

    Raises:
        ConfigError: a command of another package cannot be loaded.
    """
    parser = CommandParser(prog='mtv-world', description=_DESCRIPTION)
    parser.add_argument('--version', action=_Version, nargs=0, help='print the version, then exit')
    commands = parser.add_subparsers(required=True, metavar='COMMAND')
    groups: dict[str, argparse._SubParsersAction] = {}
    for name in wanted or COMMANDS:
        group, _, last = name.rpartition(' ')
        if group and group not in groups:
            made = commands.add_parser(group, help=_GROUPS[group])
            groups[group] = made.add_subparsers(required=True, metavar=group.upper())
        module = import_module(f'mtv_world_ros.cli.{COMMANDS[name].module}')
        place = groups.get(group, commands)
        getattr(module, COMMANDS[name].function)(place)
        command = place.choices[last]
        command.description = command.description or _sentence(COMMANDS[name].help)
    if not wanted:
        _add_others(commands)
    return parser


def _sentence(text: str) -> str:
    return f'{text[:1].upper()}{text[1:]}.'


def _add_others(commands: argparse._SubParsersAction) -> None:
    """Add the commands that other packages register.

    Raises:
        ConfigError: one cannot be loaded, or has a name that is taken.
    """
    found = entry_points.registered(entry_points.COMMANDS)
    for name in sorted(found):
        if found[name].value.startswith(_OWN):  # of an installation before 0.2
            continue
        module: ModuleType = entry_points.load(found[name])
        try:
            module.add(commands)
        except Exception as error:  # without `add`, or of a name that is taken
            raise entry_points.broken(found[name], error) from error


def _others_parser() -> argparse.ArgumentParser:
    """Return a parser of the commands of other packages; the names of the table are taken."""
    parser = CommandParser(prog='mtv-world', description=_DESCRIPTION)
    commands = parser.add_subparsers(required=True, metavar='COMMAND')
    for name in _first_words():
        commands.add_parser(name)
    _add_others(commands)
    return parser


def _first_words() -> list[str]:
    return list(dict.fromkeys(name.split()[0] for name in COMMANDS))


def _choices(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of a parser's commands by name; empty = it has none."""
    found = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return next((dict(action.choices) for action in found), {})


def _overview() -> str:
    """Return the text of `mtv-world --help`: the table of commands under its headings."""
    lines = [f'usage: {_USAGE}', '', _DESCRIPTION, _BEGIN]
    for section in SECTIONS:
        lines += ['', f'{section}:']
        named = {name: entry.help for name, entry in COMMANDS.items() if entry.section == section}
        lines += [f'  {name:15} {text}' for name, text in named.items()]
    others = [name for name in _choices(_others_parser()) if name not in _first_words()]
    lines += ['', 'Of other packages:', *(f'  {name}' for name in others)] if others else []
    return '\n'.join(lines)


def _check_texts(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Refuse an empty text that is not the option's default."""
    for action in parser._actions:
        given = getattr(arguments, action.dest, None)
        is_empty = '' in given if isinstance(given, list) else given == ''
        if is_empty and action.type is None and '' not in (action.default, action.const):
            parser.error(str(argparse.ArgumentError(action, EMPTY)))


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        print(f'mtv-world {metadata.version("mtv_world_ros")}')
        parser.exit()


def _parser_for(words: Sequence[str]) -> argparse.ArgumentParser:
    """Return a parser that knows the command which words begin with.

    Ends the process with a message where there is no such command.
    """
    plain = CommandParser(prog='mtv-world', usage=_USAGE)
    first, second = [*words, '', ''][:2]
    if first in ('-h', '--help', '--help-all'):
        print(_overview())
        plain.exit()
    if first in COMMANDS:
        return make_parser(first)
    if first in _GROUPS:
        members = [name.split()[1] for name in COMMANDS if name.split()[0] == first]
        if second in members:
            return make_parser(f'{first} {second}')
        if second and not second.startswith('-'):
            plain.error(
                f"there is no '{first} {second}'{nearest(second, members)}; there are "
                f'{", ".join(f"{first} {name}" for name in members)}'
            )
        return make_parser(*(f'{first} {name}' for name in members))
    if not first or first.startswith('-'):
        return make_parser('demo')
    others = _others_parser()
    known = list(_choices(others))
    if first in known:
        return others
    if first in REMOVED:
        plain.error(f"'{first}' is no longer a command: {REMOVED[first]}")
    plain.error(
        str(UnknownNameError('there is no command', first, known, listed='; commands are'))
    )


def _parsed(words: Sequence[str]) -> argparse.Namespace:
    if '_ARGCOMPLETE' in os.environ:  # completion in the shell, where this is installed
        with suppress(ImportError):
            import_module('argcomplete').autocomplete(make_parser())
    for word in words:
        check_name(word)
    parser = _parser_for(words)
    arguments, more = parser.parse_known_args(words)
    arguments.ros, arguments.command_line = more, words
    leaf = parser
    for word in words[:2]:
        leaf = _choices(leaf).get(word, leaf)
    if more and not getattr(arguments, 'takes_more', lambda *_: False)(arguments, more):
        _refuse_removed(parser, leaf, more)
        hints = [f'{word}{nearest(word, leaf._option_string_actions)}' for word in more]
        parser.error(f'unrecognized arguments: {" ".join(hints)}')
    _check_texts(leaf, arguments)
    for path, option in _outputs(arguments):
        check_output(path, option)
    if words:
        from mtv_world_ros.cli.needs import check_needs  # not for the overview

        check_needs(words, arguments)
    return arguments


def _refuse_removed(
    parser: argparse.ArgumentParser, leaf: argparse.ArgumentParser, more: Sequence[str]
) -> None:
    """End with what to use now if one of the words is an option of an earlier version."""
    command = leaf.prog.removeprefix('mtv-world ')
    for word in more:
        option = word.partition('=')[0]
        if now := REMOVED_OPTIONS.get(f'{command} {option}'):
            parser.error(f"'{option}' is no longer an option of '{command}': {now}")


def _outputs(arguments: argparse.Namespace) -> list[tuple[Path, str]]:
    """Return the paths that a command is to write, with the options that name them."""
    found = []
    for name in _OUTPUTS:
        path = getattr(arguments, name, None)
        if path is None:
            path = getattr(arguments, f'default_{name}', None)
        path = path(arguments) if callable(path) else path
        found += [(path, f'--{name}')] if isinstance(path, Path) else []
    watched = getattr(getattr(arguments, 'watch', None), 'file', None)
    return [*found, *([(watched, '--watch')] if isinstance(watched, Path) else [])]


def main(argv: list[str] | None = None) -> int:
    """Run a command; return the exit status.

    That is 1 for an error of the user's or of the disk, and 128 + n where signal n ended it.
    """
    prepare_process()
    prepare_output()
    try:
        with ended_by_signals('mtv-world'):
            arguments = _parsed(sys.argv[1:] if argv is None else argv)
    except MtvWorldError as error:  # of the installation, or of an option that only prints
        return _said(str(error), 1)
    try:
        with stopped_by_sigterm(), _own_warnings(), ExitStack() as locks:
            locks.enter_context(_said_to_load(arguments.command_line))
            for path, option in [] if is_helper_rank() else _outputs(arguments):
                locks.enter_context(only_writer(path, option))
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
        from mtv_world_ros.cli.needs import missing_text
        from mtv_world_ros.core.extras import extra_of

        package = (error.name or '').partition('.')[0]
        if not extra_of(package):
            raise
        return _said(missing_text([package]), 1)
    except KeyboardInterrupt as stopped:
        number = getattr(stopped, 'signum', signal.SIGINT)
        return _said(f'stopped ({signal.Signals(number).name})', 128 + number)


@contextmanager
def _said_to_load(words: Sequence[str]) -> Iterator[None]:
    """Print a line soon after the start of a command that takes seconds to load."""
    name = next((n for n in (' '.join(words[:2]), *words[:1]) if n in COMMANDS), '')
    if not name or not COMMANDS[name].is_long or is_helper_rank():
        yield
        return
    done = threading.Event()
    threading.Thread(target=_say_loading, args=(name, done), daemon=True).start()
    try:
        yield
    finally:
        done.set()


def _say_loading(name: str, done: threading.Event) -> None:
    """Print that a command is loading, then the seconds so far until it shows its progress."""
    begun_s, wait_s, num_shown = time.monotonic(), _FIRST_LINE_S, _num_progresses()
    while not done.wait(wait_s) and _num_progresses() == num_shown:
        so_far = '' if wait_s == _FIRST_LINE_S else f', {time.monotonic() - begun_s:.0f} s so far'
        _said(f'{name}: loading{so_far}', 0)
        wait_s = _NEXT_LINE_S


def _num_progresses() -> int:
    # importing the module here may wait for others; while they import it the class is missing
    progress = getattr(sys.modules.get('mtv_world_ros.core.progress'), 'Progress', None)
    return progress.num_shown if progress else 0


@contextmanager
def _own_warnings() -> Iterator[None]:
    """Print warnings of this package as one line, without the place in its source."""
    others = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if category.__module__.startswith(_OWN):
            _said(str(message), 0)
        else:
            others(message, category, *place, **more)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


def _advice(error: Exception) -> str:
    if isinstance(error, MemoryError):
        return _MORE_MEMORY if str(error) else _MORE_MEMORY.removeprefix(': ')
    return _ADVICE.get(error.errno or 0, '') if isinstance(error, OSError) else ''


def _said(text: str, status: int) -> int:
    """Print the line on stderr and return the status."""
    print(f'mtv-world: {shown(text, MOST_OF_ERROR, _LINES)}', file=sys.stderr)
    return status
