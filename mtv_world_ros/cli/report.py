"""`mtv-world report`."""

from __future__ import annotations

import argparse
from pathlib import Path

from mtv_world_ros.cli.shared_options import add_overwrite
from mtv_world_ros.errors import ConfigError
from mtv_world_ros.files import check_free


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser(
        'report', help='write the HTML report of one or several evaluations again'
    )
    parser.add_argument(
        'evaluations', type=Path, nargs='+', help="folders that 'mtv-world evaluate --out' wrote"
    )
    parser.add_argument(
        '--out', type=Path, help="HTML file; default: the evaluation's report.html, written anew"
    )
    add_overwrite(parser)
    parser.set_defaults(handler=_report)


def _report(arguments: argparse.Namespace) -> int:
    first, *others = arguments.evaluations
    if others and arguments.out is None:
        raise ConfigError(
            f'{1 + len(others)} evaluations go into one page; give --out FILE: the page of '
            f"'{first}' stays as it is"
        )
    if arguments.out is not None:
        check_free(arguments.out, arguments.overwrite)
    from mtv_world_ros.evaluation.report.read_back import check_evaluation

    for folder in arguments.evaluations:
        check_evaluation(folder)
    from mtv_world_ros.evaluation.report.html import write_report

    path = arguments.out or first / 'report.html'
    print(f'written: {write_report(arguments.evaluations, path)}')
    return 0
