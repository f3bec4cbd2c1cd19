"""Do long rollouts hold better after training on the model's own rollouts?

    python benchmark/self_rollout.py TRAIN HELD_OUT --work runs/self_rollout \
        --training-steps 2000 --batch-size 8 --device cuda --out benchmark/results

Trains `--checkpoint` on for the same steps on the same clips, once as always and once with
self-rollout, and imagines held-out episodes from their first frame, chunks chained on their own
predictions. Printed: the error (RMS, of 255) over pixels that change in the recording, by number
of the chunk, and J of the chained episodes and of single chunks. Running it again goes on where it
was stopped.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import shlex
import sys

from model_scores import add_options, cells, COLUMNS, loader, overrides, run_of, score
import numpy as np
from page import publish, table
import torch
from tqdm import tqdm

from mtv_world_ros.assembly import assemble_segmenter, checkpoint_path, checkpoint_robot
from mtv_world_ros.data.recording import cached_recording
from mtv_world_ros.data.splits import select
from mtv_world_ros.lab.evaluation.imagined_stretches import imagine_stretch, stretches
from mtv_world_ros.lab.training.training_run import spread, train

#: RGB difference (of 255) from which a pixel counts as changed
_CHANGE = 24
_CHUNKS = 4


def trained(share: float, options: argparse.Namespace) -> Path:
    """Trains on, or goes on; returns the checkpoint."""
    initial = checkpoint_path(options.checkpoint)
    changes = {
        **overrides(options),
        'self_rollout.share': share,
        'self_rollout.steps': options.steps,
        'self_rollout.max_chunks': options.max_chunks,
    }
    return train(
        run_of(options, f'share{share:g}', changes).replace(initial=initial),
        robot=checkpoint_robot(initial),
        segmenter=assemble_segmenter('colour'),
    )


def chained_errors(checkpoint: str | Path, options: argparse.Namespace) -> np.ndarray:
    """(episodes, chunks) error of chained rollouts from each first frame, NaN behind the end."""
    pipeline = loader(checkpoint, options)()
    paths = spread(select(options.held_out, 'all').paths, options.held_out_episodes)
    rows = np.full((len(paths), _CHUNKS), np.nan)
    for number, path in enumerate(tqdm(paths, desc='chained rollouts', unit='ep')):
        recording = cached_recording(
            path, pipeline.spec, pipeline.robot, options.work / 'held_out_cache'
        )
        stretch = stretches(recording, pipeline.spec, 'imagine')[0]
        chunks = imagine_stretch(
            pipeline, recording, stretch, actions=recording, seed=options.seed,
            num_inference_steps=options.steps,
        )  # fmt: skip
        first = 1
        for chunk in chunks[:_CHUNKS]:
            frames = chunk.video.frames
            recorded = stretch.frames[:, first : first + frames.shape[1]].astype(np.float32)
            changed = np.abs(recorded - stretch.frames[:, :1]).max(-1) > _CHANGE
            if changed.any():
                error = np.square(frames - recorded)[changed].mean()
                rows[number, chunk.chunk] = np.sqrt(error)
            first += frames.shape[1]
    return rows


def row(title: str, checkpoint: str | Path, options: argparse.Namespace) -> list[str]:
    """A line of the table."""
    errors = chained_errors(checkpoint, options)
    counts = np.isfinite(errors).sum(0)
    shown = [
        f'{np.nanmean(e):.2f} ± {np.nanstd(e) / np.sqrt(n):.2f}' if n else '-'
        for e, n in zip(errors.T, counts, strict=True)
    ]
    if not options.scores:
        return [title, *shown]
    out = options.work / 'scores' / title.replace(' ', '_')
    for mode in ('imagine', 'observe'):
        summary = score(checkpoint, out / mode, options, mode=mode, steps=options.steps)
        shown.append(cells(summary)[0])
    return [title, *shown]


def main() -> None:
    """Trains, scores, prints."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_options(parser)
    parser.add_argument('--share', type=float, default=0.5)
    parser.add_argument('--steps', type=int, default=1, help='denoising steps')
    parser.add_argument('--max-chunks', type=int, default=3)
    parser.add_argument(
        '--scores', action=argparse.BooleanOptionalAction, default=True, help='J as well'
    )
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    checkpoints = {
        'start': options.checkpoint,
        'without': trained(0.0, options),
        'self-rollout': trained(options.share, options),
    }
    rows = [row(title, checkpoint, options) for title, checkpoint in checkpoints.items()]
    header = ['training', *(f'chunk {k + 1}' for k in range(_CHUNKS))]
    if options.scores:
        name = next(iter(COLUMNS))
        header += [f'{name}, chained', f'{name}, single chunks']
    options.repeats = len(spread(select(options.held_out, 'all').paths, options.held_out_episodes))
    publish(
        'self_rollout',
        'Training on own rollouts',
        f'python {shlex.join(sys.argv)}',
        table(header, rows)
        + '\n\nError of chained chunks by number of the chunk: mean ± standard error over '
        f'episodes. Both trainings: {options.training_steps} steps of batch {options.batch_size} '
        f'from `{options.checkpoint}`; self-rollout in {options.share:g} of the clips.',
        options,
        f'torch {torch.__version__}',
    )


if __name__ == '__main__':
    main()
