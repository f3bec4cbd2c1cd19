"""Parsers of commands: options of the model and advanced ones stand under their own headings."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    #: subparsers that a command is added to
    Commands = argparse._SubParsersAction['CommandParser']

#: error of an empty path or text
EMPTY = "it is empty; leave it out, or give a path or a name ('.' is the present folder)"


class CommandParser(argparse.ArgumentParser):
    """Parser of a command.

    `--help` leaves out the options that were added by `add_advanced`; `--help-all` prints all. An
    empty path is refused, which Python reads as the present folder.

    Attributes:
        model: group of the options that say which model runs, and how.
    """

    def __init__(self, **how: Any) -> None:
        super().__init__(**how)
        self.register('type', Path, _path)
        self._all = self.add_argument('--help-all', action=_HelpAll, help=argparse.SUPPRESS)
        self.model = self.add_argument_group('model options')
        self._advanced_group = self.add_argument_group('advanced options')
        self._advanced: list[argparse.Action] = []

    def add_advanced(self, *flags: str, **how: Any) -> None:
        """Add an option that few users need, with the arguments of `add_argument`."""
        self._advanced.append(self._advanced_group.add_argument(*flags, **how))
        self._all.help = f'show {len(self._advanced)} more options, too'

    def format_usage(self) -> str:
        """Return the usage without advanced options."""
        with self._without_advanced():
            return super().format_usage()

    def format_help(self) -> str:
        """Return the help without advanced options."""
        with self._without_advanced():
            return super().format_help()

    def format_help_all(self) -> str:
        """Return the help with all options."""
        return super().format_help()

    @contextmanager
    def _without_advanced(self) -> Iterator[None]:
        texts = [action.help for action in self._advanced]
        for action in self._advanced:
            action.help = argparse.SUPPRESS
        try:
            yield
        finally:
            for action, text in zip(self._advanced, texts, strict=True):
                action.help = text


class _HelpAll(argparse._HelpAction):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        assert isinstance(parser, CommandParser)
        print(parser.format_help_all(), end='')
        parser.exit()


def _path(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError(EMPTY)
    return Path(text)
