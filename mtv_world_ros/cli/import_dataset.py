"""`mtv-world import-dataset`."""

from __future__ import annotations

import argparse
from pathlib import Path
import sys


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser(
        'import-dataset',
        help='convert a LeRobot dataset (v2.0, v2.1, v3.0) into episodes',
        epilog='config/datasets/example.yaml describes the mapping file. Call it again to '
        'continue: finished episodes are kept. Exit status: 1 if an episode failed.',
    )
    parser.add_argument('dataset', type=Path, help='folder with meta/, data/ and videos/')
    parser.add_argument('--mapping', type=Path, required=True, help='which feature is what')
    parser.add_argument('--out', type=Path, required=True)
    parser.add_argument('--episodes', help="numbers, comma-separated, e.g. '0,4,7'; default: all")
    parser.set_defaults(handler=_import)


def _import(arguments: argparse.Namespace) -> int:
    from tqdm import tqdm

    from mtv_world_ros.importing.convert import import_dataset

    summary = import_dataset(
        arguments.dataset,
        arguments.mapping,
        arguments.out,
        episodes=_numbers(arguments.episodes),
        progress=lambda numbers: tqdm(numbers, unit='ep'),
    )
    print(f'{len(summary.made)} made, {len(summary.kept)} kept, {len(summary.failed)} failed')
    for number, reason in summary.failed.items():
        print(f'episode {number}: {reason}', file=sys.stderr)
    return 1 if summary.failed else 0


def _numbers(text: str | None) -> list[int] | None:
    from mtv_world_ros.errors import ConfigError

    if text is None:
        return None
    try:
        return [int(part) for part in text.split(',')]
    except ValueError as error:
        raise ConfigError(f"--episodes is '{text}', must be numbers such as 0,4,7") from error
