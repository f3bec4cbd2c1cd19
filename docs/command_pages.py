"""Writes the reference of commands: `python docs/command_pages.py`."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from mtv_world_ros.cli import make_parser
from mtv_world_ros.cli.commands import COMMANDS, SECTIONS

PAGE = Path(__file__).parent / 'commands.md'
_HEAD = """\
# Commands

`mtv-world --help` prints the list, `mtv-world COMMAND --help` the options of one that most need,
`--help-all` every one. This page is written by `python docs/command_pages.py`.
"""


def page() -> str:
    """Return the text of the page: commands under their headings, with tables of options."""
    lines = [_HEAD]
    for section in SECTIONS:
        lines += [f'## {section}', '']
        for name in (name for name, entry in COMMANDS.items() if entry.section == section):
            lines += [f'### mtv-world {name}', '', *_described(parser_of(name)), '']
    return '\n'.join(lines)


def parser_of(name: str) -> argparse.ArgumentParser:
    """Return the parser of a command of one or two words."""
    parser = make_parser(name)
    for word in name.split():
        choices = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
        parser = choices.choices[word]
    return parser


def _described(parser: argparse.ArgumentParser) -> Iterator[str]:
    name = parser.prog.removeprefix('mtv-world ')
    text = parser.description or COMMANDS[name].help
    yield (text[:1].upper() + ' '.join(text.split())[1:]).replace('|', r'\|')
    if parser.epilog:
        yield ''
        yield ' '.join(parser.epilog.split())
    yield from ('', '| argument | default | |', '|---|---|---|')
    for action in parser._actions:
        if not isinstance(action, argparse._HelpAction | argparse._SubParsersAction):
            yield _row(action)


def _row(action: argparse.Action) -> str:
    metavar = action.metavar if isinstance(action.metavar, str) else action.dest.upper()
    if action.choices:
        metavar = '{' + ','.join(map(str, action.choices)) + '}'
    takes = '' if action.nargs == 0 else f' {metavar}'
    shown = ', '.join(f'`{option}{takes}`' for option in action.option_strings)
    is_empty = action.nargs == 0 or action.default in (None, '', (), argparse.SUPPRESS)
    default = '' if is_empty else f'`{_text(action.default)}`'
    default = 'required' if action.required and action.option_strings else default
    cells = (shown or f'`{metavar}`', default, ' '.join((action.help or '').split()))
    return '| ' + ' | '.join(cell.replace('|', r'\|') for cell in cells) + ' |'


def _text(default: object) -> str:
    return ','.join(map(str, default)) if isinstance(default, list | tuple) else str(default)


if __name__ == '__main__':
    PAGE.write_text(page(), encoding='utf-8')
