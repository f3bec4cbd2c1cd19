"""Why does one denoising step score higher than four? Samples, their mean, and their spread.

    python benchmark/denoising_steps.py DATASET [--checkpoint bundled] [--clips 60] [--out FOLDER]

Every clip, a chunk of a held-out episode from its recorded start frame, is imagined with several
seeds in 1, 2, 4, 8, 16 steps. Printed for each number of steps, over the pixels that change in the
recording: the error (RMS, of 255) of single samples and of the mean of a clip's samples; how far
samples of one clip are apart (standard deviation over seeds); how sharp they are (mean gradient as
a share of the recording's); and J of the objects that move, by the colour segmenter, of single
samples and of the mean image. If more steps only sample what one step averages, then the mean of
many-step samples scores as one step does, and samples are sharper and further apart.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
import shlex
import sys

import numpy as np
from page import publish, table
import torch
from tqdm import tqdm

from mtv_world_ros.assembly import load_pipeline
from mtv_world_ros.data.recording import cached_recording, clip_starts, cut_clip, Recording
from mtv_world_ros.data.splits import select
from mtv_world_ros.lab.training.training_run import spread
from mtv_world_ros.pipeline import Pipeline

STEPS = (1, 2, 4, 8, 16)
#: RGB difference (of 255) from which a pixel counts as changed
_CHANGE = 24


def chosen(paths: Sequence[Path], options: argparse.Namespace, pipeline: Pipeline) -> list:
    """(recording, start) of clips, spread over episodes and, in each, at random."""
    rng = np.random.default_rng(options.seed)
    found = []
    for path in spread(paths, options.clips):
        recording = cached_recording(path, pipeline.spec, pipeline.robot, options.cache)
        starts = clip_starts(recording, pipeline.spec)
        if len(starts):
            found.append((recording, int(starts[rng.integers(len(starts))])))
    return found


def imagine(
    pipeline: Pipeline, recording: Recording, start: int, steps: int, num_seeds: int
) -> tuple[np.ndarray, np.ndarray]:
    """(K, V, T, H, W, 3) samples and the (V, 1 + T, H, W, 3) frames of the recording."""
    clip = cut_clip(recording, start, pipeline.spec)
    segmented = pipeline.segmenter.segment(clip.frames[:, :1], clip.objects)
    control = pipeline.draw(clip.cameras, clip.positions, clip.times, segmented)
    samples = pipeline.world_model.predict_batch(  # type: ignore[attr-defined]
        clip.frames[:, 0],
        control.frames,
        positions=clip.positions,
        seeds=range(num_seeds),
        num_inference_steps=steps,
        should_stop=lambda: False,
    )
    return samples, clip.frames


def jaccard_moving(
    pipeline: Pipeline, frames: np.ndarray, recorded: np.ndarray, names: tuple[str, ...]
) -> list[float]:
    """J of each object of each view whose mask in the recording leaves its place."""

    def masks(video: np.ndarray) -> np.ndarray:
        start = pipeline.segmenter.segment(recorded[:, :1], names)
        found = pipeline.segmenter.segment(
            video, names, first_masks=start.masks[:, :, 0], first_frames=recorded[:, 0]
        )
        return found.masks

    true, imagined = masks(recorded[:, 1:]), masks(frames)
    first = pipeline.segmenter.segment(recorded[:, :1], names).masks[:, :, 0]
    values = []
    for view in range(true.shape[0]):
        for number in range(true.shape[1]):
            seen, held = true[view, number], first[view, number]
            if not held.any() or not seen.any() or _overlap(held, seen[-1]) > 0.5:
                continue
            values.append(
                float(
                    np.mean(
                        [_overlap(a, b) for a, b in zip(imagined[view, number], seen, strict=True)]
                    )
                )
            )
    return values


def _overlap(one: np.ndarray, other: np.ndarray) -> float:
    union = (one | other).sum()
    return float((one & other).sum() / union) if union else 1.0


def _sharpness(video: np.ndarray, where: np.ndarray) -> float:
    grey = video.astype(np.float32).mean(-1)
    down, right = np.gradient(grey, axis=(-2, -1))
    return float(np.hypot(down, right)[where].mean())


def measure_clip(
    pipeline: Pipeline, recording: Recording, start: int, steps: int, num_seeds: int
) -> dict[str, float | list[float]]:
    """The row's numbers of one clip."""
    samples, recorded = imagine(pipeline, recording, start, steps, num_seeds)
    future = recorded[:, 1:]
    changed = np.abs(future.astype(int) - recorded[:, :1]).max(-1) > _CHANGE
    if not changed.any():
        return {}
    mean = samples.astype(np.float32).mean(0)
    errors = [_rms(sample, future, changed) for sample in samples]
    names = recording.objects
    shown = [samples[0], mean.round().astype(np.uint8)]
    single, average = (jaccard_moving(pipeline, s, recorded, names) for s in shown)
    return {
        'error': float(np.mean(errors)),
        'error of mean': _rms(mean, future, changed),
        'spread': float(samples.astype(np.float32).std(0, ddof=1)[changed].mean()),
        'sharpness': float(
            np.mean([_sharpness(s, changed) for s in samples]) / _sharpness(future, changed)
        ),
        'sharpness of mean': _sharpness(mean, changed) / _sharpness(future, changed),
        'J': single,
        'J of mean': average,
    }


def _rms(video: np.ndarray, recorded: np.ndarray, where: np.ndarray) -> float:
    difference = video.astype(np.float32) - recorded
    return float(np.sqrt(np.square(difference)[where].mean()))


def main() -> None:
    """Measures and prints a Markdown table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('dataset', type=Path)
    parser.add_argument('--checkpoint', default='bundled')
    parser.add_argument('--split', default='all')
    parser.add_argument('--clips', type=int, default=60)
    parser.add_argument('--seeds', type=int, default=4, help='samples a clip')
    parser.add_argument('--steps', default=','.join(map(str, STEPS)))
    parser.add_argument('--cache', type=Path, default=Path('out/cache'))
    parser.add_argument('--device', default='cpu')
    parser.add_argument('--dtype', default='auto')
    parser.add_argument('--threads', type=int, default=1)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--machine', default='cpu2')
    parser.add_argument('--out', type=Path, help='folder to write the page into')
    options = parser.parse_args()
    pipeline = load_pipeline(
        options.checkpoint, device=options.device, dtype=options.dtype,
        num_threads=options.threads, segmenter='colour',
    )  # fmt: skip
    clips = chosen(select(options.dataset, options.split).paths, options, pipeline)
    header: list[str] = []
    rows = []
    for steps in map(int, options.steps.split(',')):
        found = [
            measure_clip(pipeline, recording, start, steps, options.seeds)
            for recording, start in tqdm(clips, desc=f'{steps} steps', unit='clip')
        ]
        found = [clip for clip in found if clip]
        header = list(found[0])
        values = [np.concatenate([np.atleast_1d(clip[name]) for clip in found]) for name in header]
        rows.append(
            [str(steps), *(f'{v.mean():.3f} ± {v.std() / np.sqrt(len(v)):.3f}' for v in values)]
        )
    options.repeats = len(clips)
    publish(
        'denoising_steps',
        'One denoising step against several',
        f'python {shlex.join(sys.argv)}',
        table(['steps', *header], rows)
        + f'\n\n{options.seeds} samples a clip; mean ± standard error over clips, of J over '
        'objects that move. Errors and spread in grey levels of 255, sharpness as a share of the '
        "recording's, all over pixels that change in the recording.",
        options,
        f'torch {torch.__version__}',
    )


if __name__ == '__main__':
    main()
