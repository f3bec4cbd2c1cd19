"""`mtv-world replay`."""

from __future__ import annotations

import argparse
from pathlib import Path
import sys

from mtv_world_ros.cli.shared_options import (
    add_checkpoint,
    add_dtype,
    add_model_options,
    add_overwrite,
    add_segmenter,
    add_serving,
    add_source,
    add_task,
    pipeline_of,
)
from mtv_world_ros.errors import EpisodeError
from mtv_world_ros.files import check_free


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser(
        'replay',
        help='play an episode into ROS topics, or imagine it offline (MCAP to MCAP)',
        epilog='Without --offline it takes the options of the ROS player (--rate, --loop, '
        '--clock, --lock-step, ...): see python -m mtv_world_ros.ros.bags.player --help.',
        allow_abbrev=False,
    )
    parser.add_argument('episode', type=Path)
    parser.add_argument('--offline', action='store_true', help='without ROS, as fast as possible')
    parser.add_argument('--out', type=Path, help='folder for the predictions (with --offline)')
    add_overwrite(parser)
    add_source(parser)
    add_checkpoint(parser)
    add_dtype(parser)
    add_model_options(parser)
    add_segmenter(parser)
    add_serving(parser)
    add_task(parser)
    parser.set_defaults(handler=_replay, takes_player_options=lambda chosen: not chosen.offline)


def _replay(arguments: argparse.Namespace) -> int:
    if not arguments.offline:
        return _play(arguments)
    if not arguments.episode.exists():
        raise EpisodeError(f"there is no episode '{arguments.episode}'")
    from mtv_world_ros.data.bag_mapping import load_source
    from mtv_world_ros.replay.offline import replay_offline

    out = arguments.out or Path('out') / f'{arguments.episode.name}_predictions'
    check_free(out, arguments.overwrite)
    summary = replay_offline(
        pipeline_of(arguments),
        arguments.episode,
        out,
        source=load_source(arguments.topics, arguments.calibration),
        seed=arguments.seed,
        num_inference_steps=arguments.steps,
        overwrite=arguments.overwrite,
    )
    from mtv_world_ros.viewing.sheets import write_pictures

    pictures = write_pictures([arguments.episode, out], out)
    print(summary)
    print(f'written: {" ".join(map(str, pictures))}')
    return 0


def _play(arguments: argparse.Namespace) -> int:
    import runpy

    sys.argv = ['mtv-world replay', str(arguments.episode), *arguments.player]
    runpy.run_module('mtv_world_ros.ros.bags.player', run_name='__main__')
    return 0
