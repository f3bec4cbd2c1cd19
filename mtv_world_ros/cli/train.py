"""`mtv-world train`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, TYPE_CHECKING

from mtv_world_ros.cli.options import add_dtype
from mtv_world_ros.cli.train_held_out import add_held_out, held_out

if TYPE_CHECKING:
    import torch

    from mtv_world_ros.training.config import TrainingConfig


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser(
        'train',
        help='train a world model on a folder of episodes',
        description='Several processes, GPUs or machines train together when a launcher starts '
        'it, e.g. torchrun --nproc-per-node 2 -m mtv_world_ros.cli train DATASET --out DIR, or '
        'accelerate launch --multi_gpu with the same -m. optimizer.batch_size is that of all of '
        'them together: they see the same clips as one would.',
    )
    parser.add_argument('dataset', type=Path, nargs='?', help='left out with --dry-run')
    parser.add_argument('--out', type=Path, help='resumes what is there')
    parser.add_argument('--preset', default='small', help='name or YAML file')
    parser.add_argument(
        '--set', action='append', default=[], metavar='SECTION.KEY=VALUE', dest='overrides'
    )
    parser.add_argument(
        '--control',
        help='how actions enter: trajectory_video, policy2vec, ee_mlp or fast_tokens; '
        'default: what the preset says',
    )
    parser.add_argument('--views', help='e.g. low,high or low; default: those of the preset')
    parser.add_argument(
        '--object-mask', choices=('on', 'off'), help='object masks in the trajectory video'
    )
    parser.add_argument(
        '--dry-run', action='store_true', help='print what a step takes, and train nothing'
    )
    parser.add_argument('--init', help="checkpoint to start from: a folder, or 'bundled'")
    parser.add_argument('--episodes', type=int, help='use only so many, spread over all')
    parser.add_argument(
        '--split', help="split of dataset.json, or 'all'; default: train where there is one"
    )
    parser.add_argument(
        '--cache', type=Path, metavar='DIR', help='what was read of episodes; runs may share it'
    )
    parser.add_argument(
        '--latent-cache',
        type=Path,
        metavar='DIR',
        help="what Wan's autoencoder and CLIP make of clips, computed once and kept; runs may "
        'share it',
    )
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--device', default='cpu')
    add_dtype(parser)
    parser.add_argument(
        '--threads', type=int, default=0, help='CPU threads a process; 0 = its share of all cores'
    )
    parser.add_argument('--save-every', type=int, default=250, help='steps between saved states')
    parser.add_argument(
        '--data-workers',
        type=int,
        default=0,
        metavar='N',
        help='processes that prepare clips, with segmenters on the CPU; 0 = a thread. The log has '
        'the share of time waited for them',
    )
    parser.add_argument(
        '--peak-tflops',
        type=float,
        default=0.0,
        metavar='N',
        help='of a device, for the model-FLOP utilisation in the log; 0 = that of a product of '
        'large matrices, measured at the start',
    )
    add_held_out(parser)
    parser.set_defaults(handler=_train)


def _train(arguments: argparse.Namespace) -> int:
    import os

    import torch

    from mtv_world_ros.assembly import assemble_segmenter, checkpoint_path, robot_path
    from mtv_world_ros.data.splits import select
    from mtv_world_ros.errors import ConfigError
    from mtv_world_ros.geometry.robot_file import load_robot
    from mtv_world_ros.model.runtime import choose_dtype
    from mtv_world_ros.sim.collect.recorded_policies import refuse_test_kinds
    from mtv_world_ros.training.config import load_training_config
    from mtv_world_ros.training.run import train

    config = load_training_config(arguments.preset, _overrides(arguments))
    dtype = choose_dtype(arguments.dtype, arguments.device)
    if arguments.dry_run:
        return _dry_run(config, dtype)
    if arguments.dataset is None or arguments.out is None:
        raise ConfigError(
            'training needs a folder of episodes and a folder for its results: '
            'mtv-world train DATASET --out DIR; without them only --dry-run works'
        )
    processes = int(os.environ.get('LOCAL_WORLD_SIZE', '1'))
    cores = max(1, len(os.sched_getaffinity(0)) // processes)
    torch.set_num_threads(arguments.threads or cores)
    paths = select(arguments.dataset, arguments.split, default='train').paths
    refuse_test_kinds(paths, 'training')
    folder = train(
        config,
        paths,
        arguments.out,
        robot=load_robot(robot_path(config.video.robot)),
        segmenter=assemble_segmenter(device=arguments.device),
        seed=arguments.seed,
        device=arguments.device,
        dtype=dtype,
        save_every=arguments.save_every,
        num_episodes=arguments.episodes,
        initial=arguments.init and checkpoint_path(arguments.init),
        cache=arguments.cache,
        held_out=held_out(arguments, paths, dtype),
        data_workers=arguments.data_workers,
        peak_flops=arguments.peak_tflops * 1e12,
        latent_cache=arguments.latent_cache,
    )
    if config.lora.rank:
        print(f'adapter for {arguments.init}: {folder}')
    else:
        print(f'checkpoint: {folder}\nevaluate it with: mtv-world evaluate {folder} DATASET')
    return 0


def _overrides(arguments: argparse.Namespace) -> dict[str, Any]:
    """What the options change of the preset; --set wins."""
    from mtv_world_ros.errors import ConfigError

    overrides: dict[str, Any] = {}
    if arguments.control is not None:
        overrides['video.control'] = arguments.control
    if arguments.views is not None:
        views = [view.strip() for view in arguments.views.split(',') if view.strip()]
        if not views:
            raise ConfigError(f"--views '{arguments.views}' names no view; e.g. --views low,high")
        overrides |= {'video.views': views, 'transformer.num_views': len(views)}
    if arguments.object_mask is not None:
        overrides['video.object_mask'] = arguments.object_mask == 'on'
    return overrides | set_overrides(arguments.overrides)


def set_overrides(items: list[str]) -> dict[str, Any]:
    """Returns what `--set SECTION.KEY=VALUE` options say.

    Raises:
        ConfigError: one has no value.
    """
    import yaml

    from mtv_world_ros.errors import ConfigError

    overrides: dict[str, Any] = {}
    for item in items:
        key, equals, value = item.partition('=')
        if not equals:
            raise ConfigError(f"--set '{item}' must look like optimizer.steps=5000")
        overrides[key] = yaml.safe_load(value)
    return overrides


def _dry_run(config: TrainingConfig, dtype: torch.dtype) -> int:
    from mtv_world_ros.assembly import robot_path
    from mtv_world_ros.geometry.robot_file import load_robot
    from mtv_world_ros.model.actions import action_names
    from mtv_world_ros.training.dry_run import step_cost

    video = config.video
    robot = load_robot(robot_path(video.robot))
    cost = step_cost(config, action_dim=len(action_names(video.control, robot)), dtype=dtype)
    print(
        f'control {video.control}, {len(video.views)} views of {1 + video.num_frames} frames of '
        f'{video.width}x{video.height}, batch {config.optimizer.batch_size}, {dtype}'
    )
    print('per step, the transformer alone:', *cost.lines(), sep='\n')
    return 0
