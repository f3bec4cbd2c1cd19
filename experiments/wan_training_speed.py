"""How fast does a Wan preset train on latents, and how fast is its latent cache filled?

    python experiments/wan_training_speed.py --preset wan-1.3b --device cuda --out out/wan

Weights and frames are random, which takes as long. A step is the trainer's own (adapter, averaged
weights, AdamW, gradient checkpointing as in the preset) on latents at hand, as with
`--latent-cache`; filling that cache is the autoencoder's work on a clip, CLIP's is not in it.
Medians of wall time after one step to warm up. MFU: operations of the transformer's forward and
backward in a second, without what gradient checkpointing computes again, as a share of those of
the fastest product of large matrices, which takes turns with the steps.

Under `torchrun --nproc-per-node N` N processes, a GPU each, train one model (optimizer.batch_size
counts the clips of all): `clips/s` beside that of one process says what communication costs.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
import os
from pathlib import Path
import shlex
import statistics
import sys
import tempfile
import time

from page import in_turns, parse_arguments, publish, table
import torch
from wan_bench import Bench

from mtv_world_ros.cli.train import set_overrides
from mtv_world_ros.model.conditioning import ControlBatch
from mtv_world_ros.model.serving import ServingOptions
from mtv_world_ros.model.trained_model import TrainedModel
from mtv_world_ros.training.adapter import add_adapter
from mtv_world_ros.training.base_checkpoint import Base
from mtv_world_ros.training.clips.batches import ClipBatch
from mtv_world_ros.training.clips.encoding import encode_batch, EncodedBatch, Encoders
from mtv_world_ros.training.dry_run import ideal_seconds, measured_peak
from mtv_world_ros.training.trainer import Trainer
from mtv_world_ros.training.training_config import load_training_config, TrainingConfig


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what other benchmarks do not have."""
    parser.add_argument('--preset', default='wan-1.3b')
    parser.add_argument('--set', action='append', default=[], metavar='SECTION.KEY=VALUE')
    parser.add_argument('--device', default='cpu')
    parser.add_argument('--dtype', default='bfloat16', help='bfloat16 or float32')
    parser.add_argument('--threads', type=int, default=2)


def random_clip(bench: Bench) -> ClipBatch:
    """A clip of noise with everything that the preset shows of its past."""
    frames, settings = bench.frames, bench.config.history
    start, count = frames[:, :, 0], settings.num_frames
    return ClipBatch(
        frames=frames,
        start_frame=start,
        inputs=ControlBatch.drawn(frames),
        object_ids=None,
        anchor=start if settings.anchored else None,
        history=frames[:, :, :count] if count else None,
        history_sigmas=torch.full((1,), settings.noise_level) if count else None,
        numbers=(0,),
    )


def repeated(clip: EncodedBatch, bench: Bench, size: int) -> EncodedBatch:
    """A step's batch of one clip, with the tokens of text and start images."""
    one = bench.with_tokens(clip.conditioning)
    values = {
        name: value.repeat_interleave(size, 0)
        for name in one.__dataclass_fields__
        if isinstance(value := getattr(one, name), torch.Tensor)
    }
    return EncodedBatch(
        clean=clip.clean.repeat_interleave(size, 0),
        conditioning=replace(one, **values),
        weights=clip.weights.repeat_interleave(size, 0),
        numbers=range(size),
    )


def make(bench: Bench, config: TrainingConfig, encoders: Encoders, work: Path) -> Trainer:
    """The trainer of the preset on top of random weights."""
    transformer = bench.transformer.requires_grad_(config.lora.rank == 0)
    if config.lora.rank:
        add_adapter(transformer, rank=config.lora.rank, alpha=config.lora.alpha)
    parts = TrainedModel(
        transformer=transformer,
        autoencoder=bench.autoencoder,
        scheduler=bench.scheduler,
        card=config.card({}),
    )
    base = Base(folder=work, checkpoint=parts, encoders=encoders, digest='random')
    return Trainer(
        config,
        work,
        seed=bench.options.seed,
        device=bench.options.device,
        dtype=bench.dtype,
        trained_on={},
        base=base,
    )


def main() -> None:
    """Measure, and print the page."""
    options = parse_arguments(__doc__, repeats=5, more=add_options)
    torch.set_num_threads(options.threads)
    # of `torchrun`: each process has a GPU and a share of the clips
    count, rank = int(os.environ.get('WORLD_SIZE', '1')), int(os.environ.get('RANK', '0'))
    if options.device == 'cuda':
        torch.cuda.set_device(int(os.environ.get('LOCAL_RANK', '0')))
    config = load_training_config(options.preset, set_overrides(options.set)).with_steps(10**6)
    bench = Bench(config, options, ServingOptions())
    encoders = Encoders(autoencoder=bench.autoencoder, history=config.history)
    filling = []
    for _ in range(1 + options.repeats):
        begun = time.perf_counter()
        clip = encode_batch(encoders, random_clip(bench), config.objective, bench.device)
        clip.clean.sum().item()  # waits for the device
        filling.append(time.perf_counter() - begun)
    size = config.optimizer.batch_size
    batch = repeated(clip, bench, size // count)
    with tempfile.TemporaryDirectory() as work:
        trainer = make(bench, config, encoders, Path(work))
        peaks: list[float] = []
        spent = in_turns(
            {
                'step': lambda: trainer.train_step(batch),
                'peak': lambda: peaks.append(measured_peak(bench.device, bench.dtype)),
            },
            options.repeats,
        )
    if rank:
        return
    step, peak = statistics.median(spent['step']), statistics.median(peaks[1:])
    ideal = ideal_seconds(config, bench.dtype, peak)
    memory = '–'
    if bench.device.type == 'cuda':
        memory = f'{torch.cuda.max_memory_allocated(bench.device) / 2**30:.1f} GiB'
    rows = [
        ['seconds a step', f'{step:.3f}'],
        ['clips/s', f'{size / step:.3f}'],
        ['MFU', f'{100 * ideal / count / step:.1f} %'],
        ['measured peak', f'{peak / 1e12:.3f} TFLOP/s'],
        ['operations a step', f'{ideal * peak / 1e12:.3f} TFLOP'],
        ['clips/s into the latent cache', f'{1 / statistics.median(filling[1:]):.3f}'],
        ['memory at most', memory],
    ]
    video = config.video
    body = (
        f'Preset `{options.preset}`, batch {size} on {count} process{"es" * (count > 1)}, '
        f'{len(video.views)} views of '
        f'{1 + video.num_frames} frames of {video.width}x{video.height}, {bench.dtype}, '
        f'device {options.device}, {options.threads} threads, n = {options.repeats}, '
        'random weights.\n\n' + table(['what', 'median'], rows)
    )
    command = shlex.join(['python', *sys.argv])
    versions = f'torch {torch.__version__}'
    publish(
        'wan_training_speed', 'Training speed of a Wan preset', command, body, options, versions
    )


if __name__ == '__main__':
    main()
