"""`mtv-world distill`."""

from __future__ import annotations

import argparse
from pathlib import Path

from mtv_world_ros.lab.cli.train import add_run_options, run_of, set_overrides, use_threads

#: overrides of the preset: a student starts from a trained model, close to its goal
_DEFAULTS = {
    'optimizer.learning_rate': 1e-4,
    'optimizer.warmup_steps': 50,
    'optimizer.steps': 1000,
    'optimizer.ema_decay': 0.99,
}


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser(
        'distill', help='distil a trained model into one that needs fewer denoising steps'
    )
    parser.add_argument('checkpoint', help="the teacher: a folder, or 'bundled'")
    parser.add_argument('dataset', type=Path)
    parser.add_argument('--out', type=Path, required=True, help='resumes what is there')
    parser.add_argument('--steps', type=int, default=4, help='denoising steps of the student')
    parser.add_argument(
        '--teacher-steps',
        type=int,
        help='denoising steps of the teacher; default: 8 times those of the student',
    )
    parser.add_argument('--preset', default='small', help='optimizer, loss and augmentation')
    add_run_options(parser)
    parser.set_defaults(handler=_distill)


def _distill(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.assembly import (
        asked_describer,
        assemble_segmenter,
        checkpoint_path,
        checkpoint_robot,
    )
    from mtv_world_ros.data.splits import select
    from mtv_world_ros.lab.training.training_config import load_training_config

    teacher = checkpoint_path(arguments.checkpoint)
    robot = checkpoint_robot(teacher)
    overrides = {**_DEFAULTS, **set_overrides(arguments.overrides)}
    config = load_training_config(arguments.preset, overrides)
    paths = select(arguments.dataset, arguments.split, default='train').paths
    # importing torch takes seconds: what is often mistyped is checked before
    from mtv_world_ros.data.recorded_policies import refuse_test_kinds
    from mtv_world_ros.lab.training.distillation import distill, DistillConfig

    settings = DistillConfig(
        num_steps=arguments.steps, teacher_steps=arguments.teacher_steps or 8 * arguments.steps
    )
    use_threads(arguments)
    refuse_test_kinds(paths, 'training')
    folder = distill(
        teacher,
        run_of(arguments, config, paths),
        settings,
        robot=robot,
        segmenter=assemble_segmenter(arguments.segmenter, device=arguments.device),
        describer=asked_describer(arguments.describer),
    )
    print(f'checkpoint for {settings.num_steps} denoising steps: {folder}')
    return 0
