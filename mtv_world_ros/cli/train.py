"""`mtv-world train`."""

from __future__ import annotations

import argparse
from pathlib import Path

from mtv_world_ros.cli.options import add_dtype


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser('train', help='train a world model on a folder of episodes')
    parser.add_argument('dataset', type=Path)
    parser.add_argument('--out', type=Path, required=True, help='resumes what is there')
    parser.add_argument('--preset', default='small', help='name or YAML file')
    parser.add_argument(
        '--set', action='append', default=[], metavar='SECTION.KEY=VALUE', dest='overrides'
    )
    parser.add_argument('--init', help="checkpoint to start from: a folder, or 'bundled'")
    parser.add_argument('--episodes', type=int, help='use only the first so many')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--device', default='cpu')
    add_dtype(parser)
    parser.add_argument('--threads', type=int, default=0, help='CPU threads; 0 = all cores')
    parser.add_argument('--save-every', type=int, default=250, help='steps between saved states')
    parser.set_defaults(handler=_train)


def _train(arguments: argparse.Namespace) -> int:
    import os

    import torch
    import yaml

    from mtv_world_ros.assembly import assemble_segmenter, checkpoint_path, robot_path
    from mtv_world_ros.errors import ConfigError
    from mtv_world_ros.geometry.robot_file import load_robot
    from mtv_world_ros.model.runtime import choose_dtype
    from mtv_world_ros.training.config import load_training_config
    from mtv_world_ros.training.run import train

    overrides = {}
    for item in arguments.overrides:
        key, equals, value = item.partition('=')
        if not equals:
            raise ConfigError(f"--set '{item}' must look like optimizer.steps=5000")
        overrides[key] = yaml.safe_load(value)
    config = load_training_config(arguments.preset, overrides)
    torch.set_num_threads(arguments.threads or len(os.sched_getaffinity(0)))
    folder = train(
        config,
        arguments.dataset,
        arguments.out,
        robot=load_robot(robot_path(config.video.robot)),
        segmenter=assemble_segmenter(device=arguments.device),
        seed=arguments.seed,
        device=arguments.device,
        dtype=choose_dtype(arguments.dtype, arguments.device),
        save_every=arguments.save_every,
        num_episodes=arguments.episodes,
        initial=arguments.init and checkpoint_path(arguments.init),
    )
    print(f'checkpoint: {folder}\nevaluate it with: mtv-world evaluate {folder} DATASET')
    return 0
