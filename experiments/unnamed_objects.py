"""Do objects survive that nobody names? Their area after a chunk, against the recorded one.

    mtv-world collect --task all --episodes 4 --seed 9000 --out data/test
    python experiments/unnamed_objects.py data/test --repeats 40

Of every episode the first chunk is imagined three times: with all its objects named, with all but
one, and with none. Of every object that stays where it is (its recorded mask moves by less than
2 px): its area in the last imagined frame, as the segmenter finds it by its colour, over its area
in the recorded one; more than all counts as all.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from page import parse_arguments, publish, table

from mtv_world_ros.cameras.mask_geometry import centroids
from mtv_world_ros.core.data_types import BoolArray, JointTrajectory, Observation
from mtv_world_ros.data.episode_reader import list_episodes
from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.data.recordings import commanded
from mtv_world_ros.evaluation.imagined_stretches import predicted_frames, stretches
from mtv_world_ros.evaluation.result_settings import fingerprint
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline

HEAD = ('named', 'objects', 'area left, mean', '95 % interval', 'least', 'at least 90 % left')
_STILL_PX = 2.0
_LEAST_AREA_PX = 15


def more(parser: argparse.ArgumentParser) -> None:
    """Add options."""
    parser.add_argument('dataset', type=Path)
    parser.add_argument('--checkpoint', default='bundled')


def areas_left(pipeline: Pipeline, recording: Recording, seed: int) -> dict[str, list[float]]:
    """Return the shares of the objects that stay, by which objects were named."""
    stretch = stretches(recording, pipeline.spec, 'observe')[0]
    real = masks_of(pipeline, recording, stretch.frames[:, [0, -1]])
    still = np.flatnonzero(stays(real))
    found: dict[str, list[float]] = {'all': [], 'all but it': [], 'none': []}
    for name in found:
        for item in still if name == 'all but it' else [None]:
            named = () if name == 'none' else recording.objects
            given = tuple(o for k, o in enumerate(named) if k != item)
            episode = pipeline.begin(
                Observation(
                    cameras=recording.cameras,
                    frames=stretch.frames[:, 0],
                    positions=recording.positions[0],
                    stamp_ns=recording.stamp_ns,
                ),
                RolloutOptions(objects=given, seed=seed, num_inference_steps=1),
            )
            times = np.arange(1, stretch.num_frames + 1) / pipeline.spec.fps
            plan = JointTrajectory(
                joint_names=pipeline.robot.joint_names,
                times=times,
                positions=commanded(recording, 0, times),
            )
            frames = predicted_frames(list(episode.extend(plan)))
            end = masks_of(pipeline, recording, frames[:, -1:])[:, :, 0]
            for k in still if item is None else [item]:
                share = end[:, k].sum((-2, -1)) / real[:, k, 1].sum((-2, -1))
                found[name].append(float(np.minimum(share, 1.0).mean()))
    return found


def masks_of(pipeline: Pipeline, recording: Recording, frames: np.ndarray) -> BoolArray:
    """Return (V, O, T, H, W) masks of frames (V, T, H, W, 3), each found by itself."""
    found = [
        pipeline.segmenter.segment(frames[:, [k]], recording.objects).masks[:, :, 0]
        for k in range(frames.shape[1])
    ]
    return np.stack(found, axis=2)


def stays(real: BoolArray) -> BoolArray:
    """Return (O,) which objects are seen in all views and do not move, (V, O, 2, H, W)."""
    areas = real.sum((-2, -1))
    first, last = centroids(real[:, :, 0]), centroids(real[:, :, 1])
    way = np.nan_to_num(np.linalg.norm(last - first, axis=-1), nan=np.inf)
    return np.asarray(((way < _STILL_PX) & (areas.min(-1) > _LEAST_AREA_PX)).all(0))


def main() -> None:
    """Print a row for each choice of names, and write them as a result page."""
    options = parse_arguments(__doc__, 40, more)
    pipeline = Pipeline.load(options.checkpoint)
    paths = list_episodes(options.dataset)
    paths = [paths[k] for k in np.linspace(0, len(paths), options.repeats, False).astype(int)]
    shares: dict[str, list[float]] = {}
    for path in paths:
        recording = load_recording(path, pipeline.spec, pipeline.robot)
        for name, found in areas_left(pipeline, recording, options.seed).items():
            shares.setdefault(name, []).extend(found)
    rows = []
    for name, values in shares.items():
        half = 1.96 * np.std(values, ddof=1) / np.sqrt(len(values))
        mean = float(np.mean(values))
        rows.append(
            [
                name,
                str(len(values)),
                f'{mean:.3f}',
                f'[{mean - half:.3f}, {min(mean + half, 1.0):.3f}]',
                f'{min(values):.2f}',
                f'{np.mean(np.array(values) >= 0.9):.2f}',
            ]
        )
    publish(
        'unnamed_objects',
        'What is left of objects that are not named',
        f'python experiments/unnamed_objects.py DIR, '
        f'{fingerprint(Checkpoint.open(options.checkpoint))}',
        f'{(__doc__ or "").split(chr(10) * 2)[-1]}\n{table(HEAD, rows)}',
        options,
        '1 process',
    )


if __name__ == '__main__':
    main()
