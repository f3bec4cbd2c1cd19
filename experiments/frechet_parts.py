"""Which pixels make the Frechet distance of a row of the paper's tables?

    cd runs/paper_tables/rows
    frechet_parts.py mtv_world/seed_0/clips_000250/test fast_tokens/seed_0/clips_000250/test

takes the evaluations that `paper_tables.py` keeps. Of the frames that its features are of, the
distance to the recorded ones is printed for the frames as they are, for frames that are imagined
where the picture changes and recorded elsewhere, for the reverse, and for the first frame held;
each with the part that the mean of the features makes, the rest being that of their covariance. A
pixel changes where it differs from the first frame. RMSE [of 255] and sharpness (mean absolute
Laplacian, as a share of the recorded frames') stand beside them.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
from lite_features import FRAME_STRIDE, lite_features
import numpy as np
import torch

from mtv_world_ros.core.data_types import ByteArray, FloatArray
from mtv_world_ros.core.documents import Table
from mtv_world_ros.evaluation.metrics.feature_store import frechet_distance
from mtv_world_ros.reports.read_back import read_evaluations

HEAD = ('evaluation', 'frames', 'distance', 'of the mean', 'RMSE', 'sharpness')
#: a pixel changes where a recorded channel differs from the first frame by more, of 255
CHANGE = 24
#: a pixel changes where an imagined channel differs from the first frame by more, of 255
IMAGINED_CHANGE = 60


def frames_of(folder: Path, view: str) -> tuple[ByteArray, ByteArray, ByteArray]:
    """Return (N, H, W, 3) imagined, recorded and first frames of an evaluation."""
    (evaluation,) = read_evaluations(folder)
    parts = []
    chosen = slice(FRAME_STRIDE // 2, None, FRAME_STRIDE)
    for result in evaluation.results:
        rollout = evaluation.rollout(result.episode)
        assert rollout is not None
        at = list(rollout.views).index(view)
        imagined, real = (np.asarray(video[at]) for video in (rollout.imagined, rollout.real))
        held = np.repeat(real[:1], len(real[chosen]), 0)
        parts.append((imagined[chosen], real[chosen], held))
    imagined, real, held = (np.concatenate(side) for side in zip(*parts, strict=True))
    return imagined, real, held


def changed(imagined: ByteArray, real: ByteArray, held: ByteArray) -> np.ndarray:
    """Return (N, H, W) pixels that change, and their neighbours."""
    first = held.astype(np.int16)
    mask = np.abs(real - first).max(-1) > CHANGE
    mask |= np.abs(imagined - first).max(-1) > IMAGINED_CHANGE
    kernel = np.ones((5, 5), np.uint8)
    return np.stack([cv2.dilate(one.astype(np.uint8), kernel) > 0 for one in mask])


def sharpness(frames: ByteArray) -> float:
    """Return the mean absolute Laplacian of the brightness."""
    grey = (cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames)
    return float(np.mean([np.abs(cv2.Laplacian(one, cv2.CV_32F)).mean() for one in grey]))


def mean_part(one: FloatArray, other: FloatArray) -> float:
    """Return the squared distance of the means of features (N, D)."""
    return float(((one.mean(0, np.float64) - other.mean(0, np.float64)) ** 2).sum())


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('evaluations', nargs='+', type=Path, help='folders of evaluations')
    parser.add_argument('--view', default='high')
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    features, rows = lite_features(), []
    for folder in options.evaluations:
        imagined, real, held = frames_of(folder, options.view)
        mask = changed(imagined, real, held)[..., None]
        truth, sharp = features(real), sharpness(real)
        shown = {
            'imagined': imagined,
            'imagined where it changes': np.where(mask, imagined, real),
            'imagined where it stays': np.where(mask, real, imagined),
            'first frame held': held,
        }
        for name, frames in shown.items():
            found = features(frames)
            error = np.sqrt(((frames.astype(np.float64) - real) ** 2).mean())
            distance = frechet_distance(truth, found)
            rows.append((str(folder), name, f'{distance:.1f}', f'{mean_part(found, truth):.1f}',
                         f'{error:.1f}', f'{sharpness(frames) / sharp:.2f}'))  # fmt: skip
    print(Table(head=HEAD, rows=tuple(rows)).markdown())


if __name__ == '__main__':
    main()
