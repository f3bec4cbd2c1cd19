"""`mtv-world train`, and how it scores held-out episodes."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import math
from pathlib import Path
import re
import shlex
import shutil
from typing import Any, TYPE_CHECKING

from mtv_world_ros.cli.bundled_help import presets
from mtv_world_ros.cli.shared_options import add_options, number_or_0
from mtv_world_ros.core.errors import ConfigError, MtvWorldError
from mtv_world_ros.core.processes import is_helper_rank

if TYPE_CHECKING:
    import torch

    from mtv_world_ros.cli.parser import Commands
    from mtv_world_ros.data.bag_mapping import EpisodeSource
    from mtv_world_ros.training.distributed import Processes
    from mtv_world_ros.training.training_config import TrainingConfig
    from mtv_world_ros.training.training_run import HeldOut, Judge
    from mtv_world_ros.viewing.scored_rollout import StoredRollout


def add(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'train',
        help='train a world model on a folder of episodes',
        epilog='Several processes, GPUs or machines train together when a launcher starts it, '
        'e.g. torchrun --nproc-per-node 2 -m mtv_world_ros.cli train DATASET --out DIR, or '
        'accelerate launch --multi_gpu with the same -m. optimizer.batch_size counts the clips '
        'of all processes together: they see the same clips as one process would.',
    )
    parser.add_argument(
        'dataset', type=Path, nargs='?', help='folder of episodes; left out with --dry-run'
    )
    parser.add_argument(
        '--out', type=Path, help='folder of the run; an earlier run in it is resumed'
    )
    parser.add_argument('--preset', default='small', help=f'training preset: {presets()}')
    parser.add_argument('--views', help="names of the views, e.g. low,high; default: the preset's")
    parser.add_advanced(
        '--object-mask',
        choices=('on', 'off'),
        help="draw object masks into the trajectory video; default: the preset's",
    )
    parser.add_argument(
        '--dry-run',
        action='store_true',
        help='print the memory and arithmetic that a step takes, then exit',
    )
    parser.add_argument(
        '--init', help="checkpoint to start from: a folder, 'bundled' or 'bundled-paper'"
    )
    parser.add_advanced(
        '--latent-cache',
        type=Path,
        metavar='DIR',
        help="folder that keeps the outputs of Wan's autoencoder and CLIP, so that they are "
        'computed once; runs may share it',
    )
    add_options(parser, 'source')
    parser.add_argument(
        '--set',
        action='append',
        default=[],
        metavar='SECTION.KEY=VALUE',
        dest='overrides',
        help='change a value of the preset, e.g. optimizer.steps=2000',
    )
    parser.add_argument(
        '--episodes', type=int, metavar='N', help='use N episodes, spread evenly over the data set'
    )
    parser.add_argument(
        '--split', help="split of dataset.json, or 'all'; default: train where there is one"
    )
    parser.add_advanced(
        '--cache',
        type=Path,
        metavar='DIR',
        help='folder of the decoded recordings; several runs may share it',
    )
    parser.add_argument('--seed', type=int, default=0, help='seed of weights, noise and batches')
    parser.add_argument('--device', default='cpu', help='PyTorch device, e.g. cpu or cuda')
    parser.add_argument(
        '--checked',
        '--doctor',
        type=Path,
        metavar='DIR',
        help='report folder of mtv-world check about these episodes; broken ones are left out',
    )
    add_options(parser, 'describer segmenter dtype')
    parser.add_advanced(
        '--threads',
        type=number_or_0,
        default=0,
        help='CPU threads per process; 0 = its share of all cores',
    )
    parser.add_advanced('--save-every', type=int, default=250, help='steps between saved states')
    parser.add_advanced(
        '--save-minutes',
        type=float,
        default=10.0,
        help='longest time between saved states [min]; Ctrl-C and SIGTERM save, too',
    )
    parser.add_advanced(
        '--data-workers',
        type=int,
        default=0,
        metavar='N',
        help='processes that prepare clips, with segmenters on the CPU; 0 = a thread. The log '
        'says how long training waited for clips',
    )
    parser.add_advanced(
        '--peak-tflops',
        type=float,
        default=0.0,
        metavar='N',
        help='peak of a device, for the model-FLOP utilisation in the log; 0 = measured at the '
        'start with a product of large matrices',
    )
    parser.add_advanced(
        '--sample-every',
        type=int,
        default=0,
        metavar='STEPS',
        help='imagine and score held-out episodes, and keep the best as checkpoint-best; 0 = off',
    )
    parser.add_argument(
        '--held-out',
        type=Path,
        metavar='DIR',
        help="data set of held-out episodes (its split 'val', else 'test'), for --sample-every "
        'and the evaluation afterwards; default: DATASET',
    )
    parser.set_defaults(handler=_train)


def _train(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.data.bag_mapping import load_source
    from mtv_world_ros.data.splits import select
    from mtv_world_ros.data.unusable import refuse_unusable
    from mtv_world_ros.training.training_config import load_training_config, TrainingRun

    config = load_training_config(arguments.preset, _overrides(arguments))
    if arguments.dry_run and is_helper_rank():
        return 0
    if arguments.dry_run:
        return _dry_run(config, arguments)
    if arguments.dataset is None or arguments.out is None:
        raise ConfigError(
            'training needs a folder of episodes and a folder for its results: '
            'mtv-world train DATASET --out DIR; without them only --dry-run works'
        )
    from mtv_world_ros.model.checkpoint import Checkpoint
    from mtv_world_ros.robot.file import load_robot, robot_path
    from mtv_world_ros.rollout.assembly import asked_describer
    from mtv_world_ros.vision.segmenters.choose import choose_segmenter

    # importing torch takes seconds: what is often mistyped is checked before
    for dataset in (arguments.dataset, arguments.held_out):
        if dataset is not None and not dataset.is_dir():
            select(dataset)  # says that it holds no episodes
    initial = Checkpoint.open(arguments.init) if arguments.init else None
    source = load_source(arguments.topics, arguments.calibration)
    paths = select(arguments.dataset, arguments.split, default='train').paths
    robot = load_robot(robot_path(config.video.robot))
    refuse_unusable(
        paths,
        config.video.views,
        robot,
        fps=config.video.fps,
        mapping=source.mapping,
        remedy='--set video.robot=FILE (of imported episodes: robot/robot.yaml beside them)',
    )
    held_out = _held_out_paths(arguments, paths) if arguments.sample_every else ()
    from mtv_world_ros.model.runtime import check_device, choose_dtype

    check_device(arguments.device)
    from mtv_world_ros.training.training_run import train

    dtype = choose_dtype(arguments.dtype, arguments.device)
    _use_threads(arguments)
    same = ('out', 'seed', 'device', 'dtype', 'save_every', 'save_minutes', 'cache')
    same += ('latent_cache', 'data_workers', 'peak_tflops')
    broken = (
        found_broken(arguments.checked, paths, config.video.views) if arguments.checked else {}
    )
    run = TrainingRun(
        config=config,
        dataset=tuple(paths),
        broken=broken,
        num_episodes=arguments.episodes,
        source=source,
        initial=initial,
        **{name: getattr(arguments, name) for name in same},
    )
    folder = train(
        run,
        robot=robot,
        segmenter=choose_segmenter(arguments.segmenter, device=arguments.device),
        describer=asked_describer(arguments.describer),
        held_out=_held_out(arguments, held_out, dtype, source),
    )
    if not is_helper_rank():  # the main process may still be writing the result
        _print_result(arguments, config, folder, paths)
    return 0


def _print_result(
    arguments: argparse.Namespace, config: TrainingConfig, folder: Path, paths: Sequence[Path]
) -> None:
    """Print the folder of the result and the commands that come next."""
    from mtv_world_ros.model.checkpoint import Checkpoint

    print(f'{f"adapter for {arguments.init}" if config.lora.rank else "checkpoint"}: {folder}')
    if not config.lora.rank and _lacks_contact(folder):
        views = ','.join(config.video.views)
        words = [str(arguments.dataset), '--checkpoint', str(folder)]
        words += ['--robot', str(config.video.robot), '--views', views]
        print(
            'where episodes have objects, first fit how they move: '
            f'{shlex.join(["mtv-world", "fit", "contact", *words])}'
        )
    model = [str(arguments.init), '--adapter', str(folder)] if config.lora.rank else [str(folder)]
    out = arguments.out / f'evaluation_{Checkpoint.open(folder).card.trained_on["steps"]}'
    print('\n'.join(_evaluation_advice(arguments, model, paths, out)))


#: number of held-out episodes that are scored during training
NUM_HELD_OUT = 4
#: stands for a folder that the user has to name
UNSEEN = 'EPISODES'


def _evaluation_advice(
    arguments: argparse.Namespace, model: Sequence[str], trained_on: Sequence[Path], out: Path
) -> list[str]:
    """Return the lines that say how to evaluate a checkpoint on episodes not trained on.

    A data set without usable episodes is named; it is no error, since the training is done.
    """
    from mtv_world_ros.data.splits import select

    dataset, why, both = arguments.held_out or arguments.dataset, '', set[Path]()
    seen = {path.resolve() for path in trained_on}
    try:
        both = seen & {path.resolve() for path in select(dataset).paths}
    except MtvWorldError as error:
        why = str(error)
    if both:
        why = f"it was on {len(both)} of '{dataset}', which tells how well it remembers them"
    words = [model[0], UNSEEN if why else str(dataset), *model[1:], '--out', str(out)]
    for option in ('segmenter', 'describer', 'topics', 'calibration'):
        value = getattr(arguments, option)
        if value and value != 'auto':
            words += [f'--{option}', str(value)]
    lines = [f'evaluate it with: {shlex.join(["mtv-world", "evaluate", *words])}']
    if why:
        lines.append(f'({UNSEEN}: a folder of episodes that it was not trained on; {why})')
    return lines


def _lacks_contact(folder: Path) -> bool:
    """Return whether a checkpoint draws objects, and nothing says how they move."""
    from mtv_world_ros.model.checkpoint import Checkpoint

    opened = Checkpoint.open(folder)
    control = opened.load_control(opened.load_robot())  # the file that was given may be gone
    return control.shows_objects and opened.object_motion is None


def found_broken(report: Path, paths: Sequence[Path], views: Sequence[str]) -> dict[str, str]:
    """Return why episodes are broken, by path.

    Args:
        report: folder that `mtv-world check` wrote.
        paths: paths of the episodes.
        views: names of those that are trained on; others may be broken.

    Raises:
        ConfigError: it is no report of these episodes.
    """
    from pydantic import TypeAdapter

    from mtv_world_ros.core.bounded_input import read_json
    from mtv_world_ros.inspection.inspection_report import BROKEN

    try:
        found = TypeAdapter(dict[str, dict[str, str]]).validate_python(read_json(report / BROKEN))
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"--checked '{report}': {BROKEN} cannot be read ({error}); mtv-world check FOLDER "
            '--out DIR writes it'
        ) from error
    unchecked = [path.name for path in paths if path.name not in found]
    if unchecked:
        raise ConfigError(
            f"--checked '{report}': {len(unchecked)} of the episodes were not checked, e.g. "
            f"'{unchecked[0]}'; run mtv-world check on the folder again"
        )
    parts = {path: {n: t for n, t in found[path.name].items() if n in (*views, 'recording')}
             for path in paths}  # fmt: skip
    return {
        str(path): '; '.join(f'{name}: {text}' for name, text in texts.items())
        for path, texts in parts.items()
        if texts
    }


def _use_threads(arguments: argparse.Namespace) -> None:
    """Let torch use the threads of `--threads`: 0 = the process's share of the cores."""
    import os

    import torch

    from mtv_world_ros.core.processes import threads_each

    processes = int(os.environ.get('LOCAL_WORLD_SIZE', '1'))
    torch.set_num_threads(arguments.threads or threads_each(processes))


def _overrides(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the overrides of the preset by options; --set has precedence."""
    overrides: dict[str, Any] = {}
    if arguments.views is not None:
        views = [view.strip() for view in arguments.views.split(',') if view.strip()]
        if not views:
            raise ConfigError(f"--views '{arguments.views}' names no view; e.g. --views low,high")
        overrides |= {'video.views': views, 'transformer.num_views': len(views)}
    if arguments.object_mask is not None:
        overrides['video.object_mask'] = arguments.object_mask == 'on'
    return overrides | set_overrides(arguments.overrides)


def set_overrides(items: list[str]) -> dict[str, Any]:
    """Return the overrides of `--set SECTION.KEY=VALUE` options.

    Raises:
        ConfigError: one has no value, or one that is not YAML.
    """
    import yaml

    from mtv_world_ros.core.bounded_input import parse_yaml

    overrides: dict[str, Any] = {}
    for item in items:
        key, equals, value = item.partition('=')
        if not equals:
            raise ConfigError(f"--set '{item}' must look like optimizer.steps=5000")
        try:
            is_number = re.fullmatch(r'[+-]?\d+(\.\d*)?[eE][+-]?\d+', value)
            overrides[key] = float(value) if is_number else parse_yaml(value)  # 4e-4 is a text
        except yaml.YAMLError:
            raise ConfigError(f"--set '{item}': {value!r} is not a YAML value") from None
    return overrides


def _dry_run(config: TrainingConfig, arguments: argparse.Namespace) -> int:
    from mtv_world_ros.control.registry import create_control
    from mtv_world_ros.model.runtime import choose_dtype
    from mtv_world_ros.robot.file import load_robot, robot_path
    from mtv_world_ros.training.dry_run import step_cost

    dtype = choose_dtype(arguments.dtype, arguments.device)
    video = config.video
    robot = load_robot(robot_path(video.robot))
    control = create_control(video.control, config.control_options(robot))
    cost = step_cost(config, control.layout, dtype=dtype)
    print(
        f'{len(video.views)} views of {1 + video.num_frames} frames of '
        f'{video.width}x{video.height}, batch {config.optimizer.batch_size}, {dtype}'
    )
    print('per step, the transformer alone:', *cost.lines(), sep='\n')
    return 0


_SPLITS = ('val', 'test')


def _held_out(
    arguments: argparse.Namespace, paths: Sequence[Path], dtype: torch.dtype, source: EpisodeSource
) -> HeldOut | None:
    """Return the scorer of held-out episodes; None if it is off."""
    if not arguments.sample_every:
        return None
    from mtv_world_ros.training.training_run import HeldOut

    return HeldOut(_judge(arguments, paths, dtype, source), arguments.sample_every)


def _held_out_paths(arguments: argparse.Namespace, trained_on: Sequence[Path]) -> Sequence[Path]:
    """Return held-out episodes, spread evenly over the split `val`, else `test`.

    Raises:
        ConfigError: there are none, or they are trained on.
    """
    from mtv_world_ros.data.splits import select, spread

    dataset = arguments.held_out or arguments.dataset
    selection = select(dataset, default=_SPLITS[0])
    for split in _SPLITS[1:]:
        if selection.split not in _SPLITS:
            selection = select(dataset, default=split)
    if selection.split not in _SPLITS and arguments.held_out is None:
        raise ConfigError(
            f"--sample-every needs held-out episodes, '{dataset}' has no split val or test; give "
            '--held-out DIR'
        )
    paths = spread(selection.paths, NUM_HELD_OUT)
    both = {path.resolve() for path in paths} & {path.resolve() for path in trained_on}
    if both:
        raise ConfigError(
            f"'{min(both)}' and {len(both) - 1} more would be trained on and held out; give "
            '--held-out another folder, or --split train'
        )
    return paths


def _judge(
    arguments: argparse.Namespace, paths: Sequence[Path], dtype: torch.dtype, source: EpisodeSource
) -> Judge:
    """Return a function that scores checkpoints by J of moving objects, as `mtv-world evaluate`.

    `OUT/held_out` gets a folder per step, with `metrics.json` and an MP4 per episode. Processes
    that train together score and draw a share of the episodes each.
    """
    import torch

    from mtv_world_ros.evaluation.evaluate_episodes import evaluate
    from mtv_world_ros.evaluation.results import rollout_path
    from mtv_world_ros.evaluation.settings import EvaluationConfig
    from mtv_world_ros.model.lora import ADAPTER
    from mtv_world_ros.rollout.assembly import asked_describer
    from mtv_world_ros.rollout.pipeline import Pipeline
    from mtv_world_ros.training.training_run import HeldOutScores
    from mtv_world_ros.viewing.stored_rollout import load_rollout

    describer = asked_describer(arguments.describer)

    def judge(checkpoint: Path, step: int, processes: Processes) -> HeldOutScores:
        folder = arguments.out / 'held_out' / f'{step:07d}'
        is_adapter = (checkpoint / ADAPTER).is_file()
        pipeline = Pipeline.load(
            arguments.init if is_adapter and arguments.init else checkpoint,
            adapter=checkpoint if is_adapter else None,
            device=arguments.device,
            dtype=str(dtype).removeprefix('torch.'),
            num_threads=torch.get_num_threads(),  # keep the training's threads
            segmenter=arguments.segmenter,
        )
        summary = evaluate(
            pipeline,
            paths,
            folder,
            EvaluationConfig(actions=('true',), ceiling=False, source=source),
            peers=processes,
            describer=describer,
            show_progress=False,
        )
        for result in summary.results[processes.number :: processes.count]:
            _show(load_rollout(rollout_path(folder, result.episode)), folder / result.episode)
        processes.any(False)  # all have read their rollouts
        if processes.is_main:
            shutil.rmtree(folder / 'episodes')
        by_view = {None: '', **{view: f'_{view}' for view in pipeline.spec.views}}
        numbers = {
            name + suffix: round(estimates[name].value, 4)
            for view, suffix in by_view.items()
            for estimates in [summary.estimates(view)]
            for name in ('j_moving', 'j_copy_moving')
            if math.isfinite(estimates[name].value)
        }
        return HeldOutScores(score=numbers.get('j_moving', math.nan), numbers=numbers)

    return judge


def _show(rollout: StoredRollout, path: Path) -> None:
    """Write an MP4: recorded, trajectory video and imagined side by side, views below."""
    import numpy as np

    from mtv_world_ros.core.files import write_whole
    from mtv_world_ros.viewing.video import encode_video

    columns = [rollout.real, rollout.trajectory, rollout.imagined]
    rows = np.concatenate(columns, axis=3)  # (V, T, H, 3 * W, 3)
    frames = np.concatenate(list(rows), axis=1)
    even = frames[:, : frames.shape[1] // 2 * 2, : frames.shape[2] // 2 * 2]
    write_whole(path.with_name(f'{path.name}.mp4'), encode_video(even, rollout.fps))
