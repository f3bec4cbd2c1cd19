"""`mtv-world imagine`."""

from __future__ import annotations

import argparse
from pathlib import Path

from mtv_world_ros.cli.shared_options import (
    add_checkpoint,
    add_model_options,
    add_overwrite,
    add_segmenter,
)


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser(
        'imagine', help='run a policy for whole episodes in the world model, over ROS topics'
    )
    parser.add_argument(
        '--policy',
        default='scripted',
        help='YAML file, name of one in config/policies, or a scripted policy such as '
        'expert-miss-0.5',
    )
    parser.add_argument(
        '--episodes',
        type=Path,
        nargs='+',
        default=[],
        help='recorded episodes whose first frames to start from, or a folder of them',
    )
    parser.add_argument('--live', action='store_true', help='start from what the cameras show')
    parser.add_argument('--count', type=int, default=0, help='default: each episode once')
    parser.add_argument('--start', type=float, default=0.0, help='recorded time to start at [s]')
    parser.add_argument('--max-chunks', type=int, default=0, help='0 = until the policy is done')
    parser.add_argument('--max-seconds', type=float, default=3600.0, help='of an episode [s]')
    parser.add_argument('--instruction', default='', help="default: the recorded episode's")
    parser.add_argument('--out', type=Path, default=Path('out/imagine'))
    add_overwrite(parser)
    add_checkpoint(parser)
    add_model_options(parser)
    add_segmenter(parser)
    parser.set_defaults(handler=_imagine)


def _imagine(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.data.episode_reader import list_episodes
    from mtv_world_ros.demo.imagination import imagine_episodes, ImagineOptions
    from mtv_world_ros.errors import ConfigError

    episodes = [path for folder in arguments.episodes for path in list_episodes(folder)]
    if bool(episodes) == arguments.live:
        raise ConfigError(
            'give --episodes with recorded episodes to start from, or --live to start from the '
            f'cameras; --episodes has {len(episodes)}'
        )
    options = ImagineOptions(
        policy=arguments.policy,
        episodes=tuple(episodes),
        count=arguments.count,
        start_s=arguments.start,
        max_chunks=arguments.max_chunks,
        max_seconds=arguments.max_seconds,
        instruction=arguments.instruction,
        seed=arguments.seed,
        checkpoint=arguments.checkpoint,
        robot=arguments.robot or '',
        device=arguments.device,
        num_threads=arguments.threads,
        num_inference_steps=arguments.steps,
        segmenter=arguments.segmenter,
    )
    results = imagine_episodes(options, arguments.out, overwrite=arguments.overwrite)
    from mtv_world_ros.viewing.sheets import write_pictures

    for result in results:
        if result['num_chunks'] and Path(str(result['bag'])).is_dir():
            write_pictures([Path(str(result['bag']))], Path(str(result['bag'])))
    print('episode  end          chunks  seconds  bag')
    for result in results:
        print(
            f'{result["episode"]:>7}  {result["how"]:<11}  {result["num_chunks"]:>6}  '
            f'{result["episode_s"]:>7}  {result["bag"]}'
        )
    return 0
