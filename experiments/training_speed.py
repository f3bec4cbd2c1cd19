"""How fast does a preset train here, does it wait for data, and how is that beside a plain loop?

    python experiments/training_speed.py TRAIN --work runs/speed --preset small --threads 2 \
        --repeats 20 --out experiments/results

Takes turns, step by step, between this trainer and a straight accelerate loop over the same
batches with the same optimizer and averaged weights, so that whatever else the machine does meets
both, and the product of large matrices; then lets the trainer run with its data pipeline, and the
pipeline run alone. Medians of wall time, after two steps to warm up. MFU: operations of the
transformer's forward and backward in a
second, as a share of those of the fastest product of large matrices on this machine.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
import shlex
import statistics
import sys
import time
from typing import Any

import accelerate
from accelerate import Accelerator
from diffusers.training_utils import EMAModel
from page import in_turns, parse_arguments, publish, ratio, table
import torch

from mtv_world_ros.cli.train import set_overrides
from mtv_world_ros.data.splits import select, spread
from mtv_world_ros.model.runtime import choose_dtype, place
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.training.clips.batches import BatchSource, ClipBatch
from mtv_world_ros.training.dry_run import ideal_seconds, measured_peak
from mtv_world_ros.training.objective import NoiseDraws
from mtv_world_ros.training.trainer import batch_loss, Trainer
from mtv_world_ros.training.training_config import load_training_config
from mtv_world_ros.training.training_run import load_episodes
from mtv_world_ros.vision.segmenters.choose import choose_segmenter

_WARM_UP = 2


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what other benchmarks do not have."""
    parser.add_argument('train', type=Path, help='folder of episodes')
    parser.add_argument('--work', type=Path, required=True, help='what was read of them')
    parser.add_argument('--preset', default='small')
    parser.add_argument('--set', action='append', default=[], metavar='SECTION.KEY=VALUE')
    parser.add_argument('--episodes', type=int, default=8)
    parser.add_argument('--device', default='cpu')
    parser.add_argument('--dtype', default='auto')
    parser.add_argument('--threads', type=int, default=1)
    parser.add_argument('--data-workers', type=int, default=0)


def make(options: argparse.Namespace) -> tuple[Trainer, BatchSource]:
    """The trainer and its data, as `mtv-world train` makes them."""
    overrides = {**set_overrides(options.set), 'optimizer.steps': 10**6}
    config = load_training_config(options.preset, overrides)
    robot = load_robot(robot_path(config.video.robot))
    paths = spread(select(options.train, default='train').paths, options.episodes)
    episodes, _ = load_episodes(paths, config, robot, options.work / 'cache')
    trainer = Trainer(
        config,
        options.work,
        seed=options.seed,
        device=options.device,
        dtype=choose_dtype(options.dtype, options.device),
        trained_on={},
    )
    source = BatchSource(
        episodes,
        config,
        robot=robot,
        segmenter=choose_segmenter('colour'),
        seed=options.seed,
        workers=options.data_workers,
    )
    return trainer, source


def plain_loop(trainer: Trainer, dtype: torch.dtype) -> Callable[[ClipBatch], None]:
    """A step as accelerate's own examples make it: automatic mixed precision, AdamW, EMA."""
    config, settings = trainer.config, trainer.config.optimizer
    half = dtype == torch.bfloat16
    accelerator = Accelerator(
        cpu=trainer.device.type == 'cpu', mixed_precision='bf16' if half else 'no'
    )
    made: Any = MultiViewWanTransformer(**config.transformer)
    if settings.gradient_checkpointing:
        made.enable_gradient_checkpointing()
    made = place(made, trainer.device, torch.float32)
    optimizer: Any = torch.optim.AdamW(
        made.parameters(), settings.learning_rate, (0.9, 0.95), weight_decay=settings.weight_decay
    )
    model, optimizer = accelerator.prepare(made, optimizer)
    averaged = EMAModel(model.parameters(), decay=settings.ema_decay)

    def step(batch: ClipBatch) -> None:
        for part in batch.parts(settings.accumulation):
            draws = NoiseDraws(0, part.step, part.numbers)
            loss = batch_loss(model, trainer.encoders, part, config, draws, trainer.device)
            accelerator.backward(loss.mean / settings.accumulation)
        accelerator.clip_grad_norm_(model.parameters(), settings.max_grad_norm)
        optimizer.step()
        optimizer.zero_grad()
        averaged.step(model.parameters())
        loss.mean.item()

    return step


def main() -> None:
    """Measure, and print the page."""
    options = parse_arguments(__doc__, repeats=10, more=add_options)
    torch.set_num_threads(options.threads)
    trainer, source = make(options)
    dtype = trainer.weights.worker.dtype
    steps = _WARM_UP + options.repeats
    begun = time.perf_counter()
    batches = [source.batch(step) for step in range(steps)]
    clips = steps * len(batches[0].numbers) / (time.perf_counter() - begun)
    plain, peaks = plain_loop(trainer, dtype), []
    own_batches, plain_batches = iter(batches), iter(batches)
    spent = in_turns(
        {
            'own': lambda: trainer.train_step(next(own_batches)),
            'plain': lambda: plain(next(plain_batches)),
            'peak': lambda: peaks.append(measured_peak(trainer.device, dtype)),
        },
        options.repeats,
        warm_up=_WARM_UP,
    )
    own, other = (statistics.median(spent[name]) for name in ('own', 'plain'))
    gain = ratio(spent['plain'], spent['own'])
    trainer.step = steps
    reports = trainer.run(source, save_every=10**9, on_save=lambda _: None)
    whole = [next(reports) for _ in range(steps)][_WARM_UP:]
    source.close()
    waited = sum(report.waited for report in whole) / sum(report.seconds for report in whole)
    running = statistics.median(report.seconds for report in whole)
    peak = statistics.median(peaks[_WARM_UP:])
    ideal = ideal_seconds(trainer.config, dtype, peak)
    rows = [
        ['steps/s of the trainer with its data', f'{1 / running:.4f}'],
        ['of it waited for data', f'{100 * waited:.2f} %'],
        ['steps/s on batches at hand', f'{1 / own:.4f}'],
        ['steps/s of the plain accelerate loop on the same', f'{1 / other:.4f}'],
        ['trainer : plain loop (median of the pairs)', f'{gain:.2f}'],
        ['MFU of the trainer on batches at hand', f'{100 * ideal / own:.1f} %'],
        ['measured peak', f'{peak / 1e9:.0f} GFLOP/s'],
        ['operations a step', f'{ideal * peak / 1e9:.1f} GFLOP'],
        ['clips/s of the data pipeline alone', f'{clips:.2f}'],
    ]
    size = trainer.config.optimizer.batch_size
    body = (
        f'Preset `{options.preset}`, batch {size}, {dtype}, device {options.device}, '
        f'{options.threads} threads, {options.data_workers} data processes, '
        f'{options.episodes} episodes.\n\n' + table(['what', 'median'], rows)
    )
    command = shlex.join(['python', *sys.argv])
    versions = f'torch {torch.__version__}, accelerate {accelerate.__version__}'
    publish('training_speed', 'Training speed', command, body, options, versions)


if __name__ == '__main__':
    main()
