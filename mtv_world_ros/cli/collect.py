"""`mtv-world collect`."""

from __future__ import annotations

import argparse
from pathlib import Path


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser('collect', help='make episodes of the simulated benchmark')
    parser.add_argument('--task', default='all', help="names, comma-separated, or 'all'")
    parser.add_argument('--episodes', type=int, required=True, help='episodes per task')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--out', type=Path, required=True)
    parser.add_argument('--workers', type=int, default=1)
    parser.set_defaults(handler=_collect)


def _collect(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.sim.collect import collect

    tasks = [name.strip() for name in arguments.task.split(',')]
    collect(tasks, arguments.episodes, arguments.seed, arguments.out, workers=arguments.workers)
    return 0
