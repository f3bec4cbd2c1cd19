"""What is gained by denoising the chunks of several episodes in one batch?

    python benchmark/batching.py [--threads 1] [--repeats 9] [--out benchmark/results]

CPU time of a chunk in batches of 1, 2, 4 and 8, which take turns. The chunks of a batch have one
start image and one trajectory here, which are encoded once: batching episodes gains less.
"""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

import numpy as np
from page import measure, parse_arguments, publish, table
import torch

from mtv_world_ros.assembly import load_pipeline

SIZES = (1, 2, 4, 8)


def main() -> None:
    """Measures and prints a table."""
    options = parse_arguments(__doc__, repeats=9, more=_add)
    pipeline = load_pipeline('bundled', num_threads=options.threads)
    model: Any = pipeline.world_model
    spec, rng = pipeline.spec, np.random.default_rng(options.seed)
    shape = (len(spec.views), 1 + spec.num_frames, spec.height, spec.width, 3)
    trajectory = rng.integers(0, 256, shape, np.uint8)
    predict = partial(
        model.predict_batch,
        trajectory[:, 0],
        trajectory,
        positions=np.zeros((shape[1], len(pipeline.robot.joint_names))),
        num_inference_steps=1,
        should_stop=lambda: False,
    )
    found = measure(
        {str(size): partial(predict, seeds=list(range(size))) for size in SIZES}, options.repeats
    )
    alone = found['1'][0]
    rows = []
    for size in SIZES:
        each = [value / size for value in found[str(size)]]
        spread = f'{each[1]:.0f} to {each[2]:.0f}'
        rows.append([str(size), f'{each[0]:.0f}', spread, f'{alone / each[0]:.2f}'])
    head = ['chunks in a batch', 'CPU-ms a chunk, median', '5 to 95 %', 'times as fast as alone']
    size = f'{len(spec.views)} views x {spec.num_frames} frames of {spec.width}x{spec.height}'
    body = f'A chunk: {size}; one denoising step; threads: {options.threads}.'
    command = f'python benchmark/batching.py --threads {options.threads}'
    versions = f'torch {torch.__version__}'
    publish('batching', 'Batches', command, f'{table(head, rows)}\n\n{body}', options, versions)


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--threads', type=int, default=1)


if __name__ == '__main__':
    main()
