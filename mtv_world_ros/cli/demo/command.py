"""`mtv-world demo`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from mtv_world_ros.cli.shared_options import add_options

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands


def add(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'demo', help='replay the bundled episode through the ROS node and score its predictions'
    )
    parser.add_argument('--episode', type=Path, help='episode folder; default: the bundled one')
    parser.add_argument('--out', type=Path, default=Path('out/demo'), help='default: out/demo')
    add_options(parser, 'overwrite checkpoint device threads steps')
    parser.set_defaults(handler=_demo)


def _demo(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.core.files import check_free, share_path

    check_free(arguments.out, arguments.overwrite)
    from mtv_world_ros.cli.demo.node_processes import DemoOptions
    from mtv_world_ros.cli.demo.run_demo import run_demo

    episode = arguments.episode or share_path('resource', 'demo_episode')
    options = DemoOptions(
        checkpoint=arguments.checkpoint,
        calibration=episode / 'calibration.yaml',
        device=arguments.device,
        num_threads=arguments.threads,
        num_inference_steps=arguments.steps,
    )
    print(run_demo(episode, arguments.out, options))
    return 0
