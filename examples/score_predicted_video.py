"""Scores an imagined video against the recorded one: Jaccard index of every object.

    python examples/score_predicted_video.py [EPISODE]

Both videos are segmented from the same masks of the first frame. The first frame, held, is the
score to beat.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mtv_world_ros import (
    commands_from,
    jaccard,
    load_recording,
    Pipeline,
    RolloutOptions,
    share_path,
)

parser = argparse.ArgumentParser()
parser.add_argument(
    'episode', type=Path, nargs='?', default=share_path('resource', 'demo_episode')
)
options = parser.parse_args()

pipeline = Pipeline.load('bundled')
recording = load_recording(options.episode, pipeline.spec, pipeline.robot)
observation = recording.observation(0)
episode = pipeline.begin(observation, RolloutOptions(instruction=recording.instruction))
prediction = next(episode.extend(commands_from(recording, 0)))

# the recorded frames at the predicted times, segmented as the prediction was
nearest = np.abs(recording.times[:, None] - prediction.video.times).argmin(axis=0)
start = prediction.start_masks.masks[:, :, 0]  # (V, O, H, W)
names = prediction.masks.names
real = pipeline.segmenter.segment(
    recording.frames[:, nearest], names, first_masks=start, first_frames=recording.frames[:, 0]
)
imagined_j = jaccard(prediction.masks.masks, real.masks)  # (V, O, T)
held_j = jaccard(np.broadcast_to(start[:, :, None], real.masks.shape), real.masks)

print('view  object          status    J imagined  J first frame held')
for row, view in enumerate(pipeline.spec.views):
    for column, name in enumerate(names):
        print(
            f'{view:<5} {name:<15} {real.status[row][column]:<9} '
            f'{imagined_j[row, column].mean():10.2f} {held_j[row, column].mean():19.2f}'
        )
