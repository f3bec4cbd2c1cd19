"""The command `mtv-world`: demo, replay, collect, train, evaluate."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
import sys
from typing import TYPE_CHECKING

from mtv_world_ros.errors import MtvWorldError

if TYPE_CHECKING:
    from mtv_world_ros.pipeline import Pipeline

Handler = Callable[[argparse.Namespace], int]


def main(argv: list[str] | None = None) -> int:
    """Runs a command; returns the exit status (1 for an error of the user's)."""
    parser = _parser()
    arguments, more = parser.parse_known_args(argv)
    arguments.player = more
    if more and (arguments.handler is not _replay or arguments.offline):
        parser.error(f'unrecognized arguments: {" ".join(more)}')
    try:
        return arguments.handler(arguments)
    except MtvWorldError as error:
        print(f'mtv-world: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='mtv-world', description='An online embodied world model for ROS 2.'
    )
    commands = parser.add_subparsers(required=True, metavar='COMMAND')
    _add_demo(commands)
    _add_replay(commands)
    _add_collect(commands)
    _add_train(commands)
    _add_evaluate(commands)
    return parser


def _add_model_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--robot', help='robot YAML; default: the one of the checkpoint')
    parser.add_argument('--device', default='cpu')
    parser.add_argument('--threads', type=int, default=0, help='CPU threads; 0 = cores minus 1')
    parser.add_argument('--steps', type=int, default=4, help='denoising steps')
    parser.add_argument('--seed', type=int, default=0)


def _add_checkpoint(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--checkpoint', default='bundled', help="folder, or 'bundled'")


def _add_dtype(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--dtype', default='auto', help='auto, float32 or bfloat16')


def _pipeline(arguments: argparse.Namespace) -> Pipeline:
    from mtv_world_ros.assembly import load_pipeline

    return load_pipeline(
        arguments.checkpoint,
        robot=arguments.robot,
        device=arguments.device,
        dtype=arguments.dtype,
        num_threads=arguments.threads,
    )


def _add_demo(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        'demo', help='replay the bundled episode through the real node and score what it imagines'
    )
    parser.add_argument('--episode', type=Path, help='default: the bundled one')
    parser.add_argument('--out', type=Path, default=Path('out/demo'))
    _add_checkpoint(parser)
    _add_model_options(parser)
    parser.set_defaults(handler=_demo)


def _demo(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.demo.run import run_demo
    from mtv_world_ros.resources import share_path

    text = run_demo(
        arguments.episode or share_path('resource', 'demo_episode'),
        arguments.out,
        checkpoint=arguments.checkpoint,
        robot=arguments.robot,
        device=arguments.device,
        num_threads=arguments.threads,
        num_inference_steps=arguments.steps,
        seed=arguments.seed,
    )
    print(text)
    return 0


def _add_replay(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        'replay',
        help='play an episode into ROS topics, or imagine it offline (MCAP to MCAP)',
        epilog='Without --offline it takes the options of the ROS player (--rate, --loop, '
        '--clock, --lock-step, ...): see python -m mtv_world_ros.ros.player --help.',
        allow_abbrev=False,
    )
    parser.add_argument('episode', type=Path)
    parser.add_argument('--offline', action='store_true', help='no ROS, as fast as it goes')
    parser.add_argument('--out', type=Path, help='folder for the predictions (with --offline)')
    parser.add_argument('--calibration', type=Path, help='default: the one in the episode')
    _add_checkpoint(parser)
    _add_dtype(parser)
    _add_model_options(parser)
    parser.set_defaults(handler=_replay)


def _replay(arguments: argparse.Namespace) -> int:
    if not arguments.offline:
        return _play(arguments)
    from mtv_world_ros.evaluation.replay import replay_offline

    out = arguments.out or Path('out') / f'{arguments.episode.name}_predictions'
    summary = replay_offline(
        _pipeline(arguments),
        arguments.episode,
        out,
        calibration=arguments.calibration,
        seed=arguments.seed,
        num_inference_steps=arguments.steps,
    )
    print(summary)
    return 0


def _play(arguments: argparse.Namespace) -> int:
    import runpy

    sys.argv = ['mtv-world replay', str(arguments.episode), *arguments.player]
    runpy.run_module('mtv_world_ros.ros.player', run_name='__main__')
    return 0


def _add_collect(commands: argparse._SubParsersAction) -> None:
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


def _add_train(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser('train', help='train a world model on a folder of episodes')
    parser.add_argument('dataset', type=Path)
    parser.add_argument('--out', type=Path, required=True, help='resumes what is there')
    parser.add_argument('--preset', default='small', help='name or YAML file')
    parser.add_argument(
        '--set', action='append', default=[], metavar='SECTION.KEY=VALUE', dest='overrides'
    )
    parser.add_argument('--episodes', type=int, help='use only the first so many')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--device', default='cpu')
    _add_dtype(parser)
    parser.add_argument('--threads', type=int, default=0, help='CPU threads; 0 = all cores')
    parser.add_argument('--save-every', type=int, default=250, help='steps between saved states')
    parser.set_defaults(handler=_train)


def _train(arguments: argparse.Namespace) -> int:
    import os

    import torch
    import yaml

    from mtv_world_ros.assembly import assemble_segmenter, robot_path
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
        segmenter=assemble_segmenter(),
        seed=arguments.seed,
        device=arguments.device,
        dtype=choose_dtype(arguments.dtype, arguments.device),
        save_every=arguments.save_every,
        num_episodes=arguments.episodes,
    )
    print(f'checkpoint: {folder}\nevaluate it with: mtv-world evaluate {folder} DATASET')
    return 0


def _add_evaluate(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser('evaluate', help='score a checkpoint on recorded episodes')
    parser.add_argument('checkpoint', help="folder, or 'bundled'")
    parser.add_argument('dataset', type=Path)
    parser.add_argument('--out', type=Path, required=True)
    parser.add_argument('--mode', choices=('observe', 'imagine'), default='observe')
    parser.add_argument('--episodes', type=int, help='use only the first so many')
    _add_dtype(parser)
    _add_model_options(parser)
    parser.set_defaults(handler=_evaluate)


def _evaluate(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.assembly import fingerprint
    from mtv_world_ros.evaluation.evaluate import evaluate
    from mtv_world_ros.training.run import find_episodes

    table = evaluate(
        _pipeline(arguments),
        find_episodes(arguments.dataset)[: arguments.episodes],
        arguments.out,
        name=fingerprint(arguments.checkpoint),
        mode=arguments.mode,
        seed=arguments.seed,
        num_inference_steps=arguments.steps,
    )
    print(table)
    return 0


if __name__ == '__main__':
    sys.exit(main())
