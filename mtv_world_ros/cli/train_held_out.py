"""Held-out episodes of `mtv-world train`: which they are, and how they are scored and shown."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import math
from pathlib import Path
import shutil
from typing import TYPE_CHECKING

from mtv_world_ros.errors import ConfigError

if TYPE_CHECKING:
    import torch

    from mtv_world_ros.evaluation.results import StoredRollout
    from mtv_world_ros.training.held_out import HeldOut, Judge

_SPLITS = ('val', 'test')


def add_held_out(parser: argparse.ArgumentParser) -> None:
    """Adds the options."""
    parser.add_argument(
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
        help="data set they are of; default: DATASET. Its split 'val', else 'test'",
    )
    parser.add_argument('--held-out-episodes', type=int, default=4, metavar='N')


def held_out(
    arguments: argparse.Namespace, trained_on: Sequence[Path], dtype: torch.dtype
) -> HeldOut | None:
    """Returns what judges the training's checkpoints; None where it is off.

    Raises:
        ConfigError: there are no held-out episodes, or they are trained on.
    """
    if not arguments.sample_every:
        return None
    from mtv_world_ros.training.held_out import HeldOut
    from mtv_world_ros.training.run import spread

    paths = spread(_paths(arguments), arguments.held_out_episodes)
    both = {path.resolve() for path in paths} & {path.resolve() for path in trained_on}
    if both:
        raise ConfigError(
            f"'{min(both)}' and {len(both) - 1} more would be trained on and held out; give "
            '--held-out another folder, or --split train'
        )
    judge = make_judge(
        paths, arguments.out / 'held_out', arguments.device, dtype, base=arguments.init
    )
    return HeldOut(judge, arguments.sample_every)


def _paths(arguments: argparse.Namespace) -> Sequence[Path]:
    from mtv_world_ros.data.splits import select

    dataset = arguments.held_out or arguments.dataset
    for split in _SPLITS:
        selection = select(dataset, default=split)
        if selection.split == split:
            return selection.paths
    if arguments.held_out is None:
        raise ConfigError(
            f"--sample-every needs held-out episodes, '{dataset}' has no split val or test; give "
            '--held-out DIR'
        )
    return selection.paths


def make_judge(
    paths: Sequence[Path], out: Path, device: str, dtype: torch.dtype, base: str | None = None
) -> Judge:
    """Returns what scores checkpoints as `mtv-world evaluate` does, J of moving objects first.

    Args:
        paths: of the episodes.
        out: gets a folder a step: `metrics.json` and an MP4 an episode.
        device: where to imagine.
        dtype: of the model.
        base: checkpoint that adapters are used on.
    """
    import torch

    from mtv_world_ros.assembly import load_pipeline
    from mtv_world_ros.evaluation.evaluate import evaluate
    from mtv_world_ros.evaluation.results import load_rollout, rollout_path
    from mtv_world_ros.model.lora import ADAPTER
    from mtv_world_ros.training.held_out import Judged

    def judge(checkpoint: Path, step: int) -> Judged:
        folder = out / f'{step:07d}'
        is_adapter = (checkpoint / ADAPTER).is_file()
        pipeline = load_pipeline(
            base if is_adapter and base else checkpoint,
            adapter=checkpoint if is_adapter else None,
            device=device,
            dtype=str(dtype).removeprefix('torch.'),
            num_threads=torch.get_num_threads(),  # the training's stay as they are
        )
        summary = evaluate(
            pipeline, paths, folder, actions=('true',), ceiling=False, show_progress=False
        )
        for result in summary.results:
            show(load_rollout(rollout_path(folder, result.episode)), folder / result.episode)
        shutil.rmtree(folder / 'episodes')
        by_view = {None: '', **{view: f'_{view}' for view in pipeline.spec.views}}
        numbers = {}
        for view, suffix in by_view.items():
            estimates = summary.estimates(view)
            for name in ('j_moving', 'j_copy_moving'):
                value = estimates[name].value if name in estimates else math.nan
                if math.isfinite(value):
                    numbers[name + suffix] = round(value, 4)
        return Judged(score=numbers.get('j_moving', math.nan), numbers=numbers)

    return judge


def show(rollout: StoredRollout, path: Path) -> None:
    """Writes an MP4: recorded, trajectory video and imagined side by side, views below."""
    import numpy as np

    from mtv_world_ros.evaluation.video_file import encode_video

    columns = [rollout.real, rollout.trajectory, rollout.imagined]
    rows = np.concatenate(columns, axis=3)  # (V, T, H, 3 * W, 3)
    frames = np.concatenate(list(rows), axis=1)
    even = frames[:, : frames.shape[1] // 2 * 2, : frames.shape[2] // 2 * 2]
    path.with_name(f'{path.name}.mp4').write_bytes(encode_video(even, rollout.fps))
