"""`mtv-world report`."""

from __future__ import annotations

import argparse
from pathlib import Path


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser(
        'report', help='write the HTML report of one or several evaluations again'
    )
    parser.add_argument(
        'evaluations', type=Path, nargs='+', help="folders that 'mtv-world evaluate --out' wrote"
    )
    parser.add_argument('--out', type=Path, help='default: report.html in the first folder')
    parser.set_defaults(handler=_report)


def _report(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.evaluation.report.html import write_report

    path = arguments.out or arguments.evaluations[0] / 'report.html'
    print(f'written: {write_report(arguments.evaluations, path)}')
    return 0
