"""What do real recordings show, and what is imagined of them whole? Verdicts, carried objects, sharpness.

    python experiments/real_recordings.py verdicts EPISODES [--task TASK.yaml] [--every 8]
    python experiments/real_recordings.py carried EPISODES --checkpoint CHECKPOINT
    python experiments/real_recordings.py rollouts EPISODES --checkpoint CHECKPOINT [--memory off]

EPISODES is a folder of imported recordings whose cameras are known (`mtv-world fit camera --apply`)
and whose objects were found (`import ... --objects`).

`verdicts` judges recorded frames by the masks of the import: whole, and cut off after every N
frames, so that most cuts are failures; somebody who looks at the frames says which verdicts are
right. `carried` compares where objects are foreseen in each chunk, from the recorded frame that it
starts from, with their recorded masks and with the first frame held; no picture is imagined.
`rollouts` imagines recordings whole from their first frame: J of the arm in the first chunk and in
all, PSNR, and J of moving objects, with and without the memory of the background.
"""  # noqa: E501

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from math import isnan, nan
from pathlib import Path
from typing import Any

import numpy as np
from page import table

from mtv_world_ros.cameras.camera import camera_poses
from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.core.data_types import FloatArray, WorldModelSpec
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_reader import list_episodes
from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.data.recordings import commands_until
from mtv_world_ros.evaluation.imagined_stretches import (
    imagine_stretch,
    predicted_frames,
    Stretch,
    stretches,
)
from mtv_world_ros.evaluation.metrics.arm_masks import arm_scenes
from mtv_world_ros.evaluation.metrics.jaccard_scores import find_masks, true_masks
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.shape import load_shape
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.success.estimator import SuccessEstimator, verdict_word
from mtv_world_ros.success.rollout_memory import footage_of
from mtv_world_ros.success.task import load_task, load_tasks
from mtv_world_ros.vision.jaccard import jaccard
from mtv_world_ros.vision.segmenters.segmenter import masks_from_ids

#: size at which recorded frames are judged, and their rate [px], [Hz]
RECORDED_SIZE, RECORDED_FPS = (320, 192), 5.0


def recordings(folder: Path, spec: WorldModelSpec) -> Iterator[Recording]:
    """Yield the recordings of a folder at a size."""
    robot = load_robot(folder / 'robot' / 'robot.yaml')
    for path in list_episodes(folder):
        yield load_recording(path, spec, robot)


def judge_recorded(arguments: argparse.Namespace) -> None:
    """Print the verdicts on recorded frames, whole and cut off."""
    folder: Path = arguments.episodes
    width, height = RECORDED_SIZE
    spec = WorldModelSpec(
        views=arguments.views, fps=RECORDED_FPS, num_frames=8, width=width, height=height, robot=''
    )
    known = tuple(load_tasks(share_path('config', 'tasks', 'any_size')))
    known += tuple(load_task(path) for path in arguments.task)
    estimator = SuccessEstimator(known)
    robot, rows = load_robot(folder / 'robot' / 'robot.yaml'), []
    for recording in recordings(folder, spec):
        ends = [*range(arguments.every, len(recording.times), arguments.every)]
        for end in [*ends, len(recording.times)]:
            assert recording.object_ids is not None
            ids, names = recording.object_ids[:, :end], recording.names
            first = masks_from_ids(ids[:, :1], recording.objects, names)
            rest = masks_from_ids(ids[:, 1:], recording.objects, names)
            motion = Motion.of(robot, recording.cameras, recording.positions[:end])
            shown = footage_of(motion, first, rest)
            found = estimator.estimate(shown, recording.instruction, is_real=True).estimate
            rows.append(
                (
                    recording.path.name,
                    f'{recording.times[end - 1]:.1f}',
                    f'{found.probability:.2f}',
                    verdict_word(found.probability),
                    found.reasons[0],
                )
            )
            if isnan(found.probability) and 'no known task' in found.reasons[0]:
                break  # and so it says of every cut
    print(table(('recording', 'until [s]', 'probability', 'verdict', 'first reason'), rows))


class HeldFrames:
    """World model that holds the start frame, where what is foreseen alone is asked."""

    def __init__(self, spec: WorldModelSpec) -> None:
        self.spec = spec

    def predict(self, start_frame: Any, control: Any, **_: Any) -> Any:
        """Return the start frame T times."""
        del control
        return np.repeat(start_frame[:, None], self.spec.num_frames, axis=1)


def open_pipeline(arguments: argparse.Namespace) -> Pipeline:
    """Return the bare pipeline of the checkpoint, with the objects of the import."""
    return Pipeline.load(
        arguments.checkpoint,
        robot=arguments.episodes / 'robot' / 'robot.yaml',
        segmenter=str(arguments.episodes / 'objects.safetensors'),
        num_threads=1,
        camera_check=False,
        calibrated=False,
    )


def compare_carried(arguments: argparse.Namespace) -> None:
    """Print J of what moves: where it is foreseen chunk by chunk, and held."""
    pipeline, rows = open_pipeline(arguments), []
    held = replace(pipeline, world_model=HeldFrames(pipeline.spec), scene_keeper=None)
    for recording in recordings(arguments.episodes, pipeline.spec):
        found = [
            score
            for stretch in stretches(recording, pipeline.spec, 'observe')
            for score in _foreseen(replace(held, objects=recording.names), recording, stretch)
        ]
        scores = np.array(found).reshape(-1, 2)
        rows.append((recording.path.name, str(len(scores)), *_means(scores)))
    print(table(('recording', 'view-objects that move', 'J foreseen', 'J held'), rows))


def _means(scores: FloatArray) -> list[str]:
    return [f'{value:.3f}' for value in scores.mean(0)] if len(scores) else ['-', '-']


def _foreseen(
    pipeline: Pipeline, recording: Recording, stretch: Stretch
) -> Iterator[tuple[float, float]]:
    """Yield J of each view of each object that moves in a chunk: foreseen, and held."""
    options = RolloutOptions(instruction=recording.instruction, objects=recording.names)
    episode = pipeline.begin(recording.observation(0), options)
    if stretch.start:
        rows = np.arange(stretch.start + 1)
        episode.observe(recording.frames[:, rows[1:]], recording.positions[rows])
        episode = episode.branch(recording.observation(stretch.start))
    seconds = stretch.num_frames / pipeline.spec.fps
    deque(episode.extend(commands_until(recording, stretch.start, seconds)), maxlen=0)
    objects = episode.objects
    assert objects is not None
    truth = true_masks(
        stretch, pipeline.segmenter, recording.names, recording.objects, use_ids=True
    )
    cameras = episode.observation.cameras
    poses = np.stack([camera_poses(c, pipeline.robot, stretch.positions) for c in cameras])
    times = np.arange(1 + stretch.num_frames) / pipeline.spec.fps
    for item in map(int, np.flatnonzero(truth.moving.any(0))):
        alone = np.zeros_like(objects.cuts)
        alone[:, item] = objects.cuts[:, item]
        shown = replace(objects, cuts=alone).pictures(times, cameras, poses)[..., 3] > 127
        for view in map(int, np.flatnonzero(truth.moving[:, item])):
            true, first = truth.masks.masks[view, item], truth.first.masks[view, item, 0]
            seen = true.any((-2, -1))
            yield (
                float(np.mean(jaccard(shown[view, 1:][seen], true[seen]))),
                float(np.mean(jaccard(first[None], true[seen]))),
            )


def imagine_whole(arguments: argparse.Namespace) -> None:
    """Print scores of whole rollouts."""
    pipeline, rows = open_pipeline(arguments), []
    if arguments.memory == 'off':
        pipeline = replace(pipeline, scene_keeper=None)
    parts = load_shape(pipeline.robot).parts
    for recording in recordings(arguments.episodes, pipeline.spec):
        (stretch,) = stretches(recording, pipeline.spec, 'imagine')
        chunks = imagine_stretch(
            replace(pipeline, objects=recording.names),
            recording,
            stretch,
            actions=recording,
            seed=arguments.seed,
            num_inference_steps=0,
        )
        frames, real = predicted_frames(chunks), stretch.frames[:, 1:]
        moving = _moving(pipeline, recording, stretch, frames)
        for view, scene in enumerate(arm_scenes(recording, pipeline.robot, parts)):
            if scene is None:
                continue
            masks = scene.masks(stretch.positions[1 : 1 + frames.shape[1]])
            first = slice(0, pipeline.spec.num_frames)
            early = replace(masks, arm=masks.arm[first])
            error = ((frames[view].astype(float) - real[view]) ** 2).mean((1, 2, 3))
            rows.append(
                (
                    recording.path.name,
                    pipeline.spec.views[view],
                    f'{early.jaccard(frames[view, first]):.3f}',
                    f'{early.jaccard(real[view, first]):.3f}',
                    f'{masks.jaccard(frames[view]):.3f}',
                    f'{masks.jaccard(real[view]):.3f}',
                    f'{float((10 * np.log10(255**2 / error)).mean()):.2f}',
                    *(f'{value:.3f}' for value in moving[view]),
                )
            )
        print(recording.path.name, chunks[-1].success.reasons, chunks[-1].success.probability)
    head = ('recording', 'view', 'J of the arm, first chunk', 'recorded', 'whole', 'recorded',
            'PSNR, whole [dB]', 'J of moving objects, whole', 'held')  # fmt: skip
    print(table(head, rows))


def _moving(
    pipeline: Pipeline, recording: Recording, stretch: Stretch, frames: Any
) -> list[tuple[float, float]]:
    """Return J of moving objects by view: imagined, and of the first frame held."""
    truth = true_masks(
        stretch, pipeline.segmenter, recording.names, recording.objects, use_ids=True
    )
    found, scores = find_masks(frames, truth, pipeline.segmenter), []
    for view in range(len(frames)):
        each = []
        for item in map(int, np.flatnonzero(truth.moving[view])):
            true, first = truth.masks.masks[view, item], truth.first.masks[view, item, 0]
            seen = true.any((-2, -1))
            shown = found.masks[view, item][seen]
            each.append(
                (np.mean(jaccard(shown, true[seen])), np.mean(jaccard(first[None], true[seen])))
            )
        scores.append(tuple(np.mean(each, axis=0)) if each else (nan, nan))
    return scores


def main() -> None:
    """Run one of the three measurements."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n', 1)[0])
    parser.add_argument('what', choices=('verdicts', 'carried', 'rollouts'))
    parser.add_argument('episodes', type=Path)
    parser.add_argument(
        '--views', type=lambda text: tuple(text.split(',')), default=('ext1', 'ext2')
    )
    parser.add_argument('--task', type=Path, nargs='*', default=[])
    parser.add_argument('--every', type=int, default=8, help='frames between two cuts')
    parser.add_argument('--checkpoint', default='')
    parser.add_argument('--memory', choices=('on', 'off'), default='on')
    parser.add_argument('--seed', type=int, default=0)
    arguments = parser.parse_args()
    {'verdicts': judge_recorded, 'carried': compare_carried, 'rollouts': imagine_whole}[
        arguments.what
    ](arguments)


if __name__ == '__main__':
    main()
