"""How fast does a checkpoint imagine on this machine, and which stage takes the time?

    python experiments/serving_speed.py [--checkpoint bundled] [--threads 2] [--out FOLDER]

Median over chunks of the bundled episode, for several numbers of denoising steps and both number
formats, which take turns. Real-time factor: seconds of video for a second of computing, all
stages.
"""

from __future__ import annotations

import argparse
import statistics

import numpy as np
from page import parse_arguments, publish
import torch

from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.evaluation.imagined_stretches import imagine_stretch, stretches
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.prediction import Prediction


def main() -> None:
    """Measure and print a Markdown table."""
    options = parse_arguments(__doc__, repeats=7, more=_add)
    publish(
        'serving',
        'Serving speed',
        f'python experiments/serving_speed.py --threads {options.threads} '
        f'--device {options.device}',
        '\n'.join(lines(options)),
        options,
        f'torch {torch.__version__}',
    )


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--checkpoint', default='bundled')
    parser.add_argument('--threads', type=int, default=2)
    parser.add_argument('--device', default='cpu')


def lines(options: argparse.Namespace) -> list[str]:
    """The table, and what was measured."""
    rows = [
        'Medians of wall time of n chunks that take turns, one to warm up.',
        '',
        '| format | steps | chunk [s] | real-time factor | model [s] | all else [s] |',
        '|---|---|---|---|---|---|',
    ]
    pipelines = {
        dtype: Pipeline.load(
            options.checkpoint, device=options.device, dtype=dtype, num_threads=options.threads
        )
        for dtype in ('float32', 'bfloat16')
    }
    pipeline = pipelines['float32']
    spec = pipeline.spec
    recording = load_recording(share_path('resource', 'demo_episode'), spec, pipeline.robot)
    stretch = stretches(recording, spec, 'observe')[0]
    chunks: dict[tuple[str, int], list[Prediction]] = {
        (dtype, steps): [] for dtype in pipelines for steps in (1, 2, 4, 8)
    }
    for seed in range(options.seed, options.seed + options.repeats + 1):
        for (dtype, steps), found in chunks.items():  # in turns
            found += imagine_stretch(
                pipelines[dtype], recording, stretch, actions=recording, seed=seed,
                num_inference_steps=steps,
            )[:1]  # fmt: skip
    for (dtype, steps), found in chunks.items():
        total = statistics.median(sum(c.seconds.values()) for c in found[1:])
        model = statistics.median(c.seconds['model'] for c in found[1:])
        rows.append(
            f'| {dtype} | {steps} | {total:.3f} | {spec.chunk_seconds / total:.1f} | '
            f'{model:.3f} | {total - model:.3f} |'
        )
    parameters = sum(np.prod(p.shape) for p in _parameters(pipeline))
    size = f'{len(spec.views)} views x {spec.num_frames} frames of {spec.width}x{spec.height}'
    length = f'at {spec.fps:g} Hz = {spec.chunk_seconds:.1f} s'
    return [*rows, '', f'A chunk: {size} {length}; {parameters / 1e6:.2f} M parameters.']


def _parameters(pipeline: object) -> list[torch.Tensor]:
    return list(pipeline.world_model.transformer.parameters())  # type: ignore[attr-defined]


if __name__ == '__main__':
    main()
