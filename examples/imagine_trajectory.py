"""Imagines the recorded commands of an episode from its first frame.

    python examples/imagine_trajectory.py [EPISODE] [--out out/examples]

Writes the imagined video of every view, and prints the success estimate after each chunk.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mtv_world_ros import (
    commands_from,
    load_recording,
    Pipeline,
    RolloutOptions,
    share_path,
    write_video,
)

parser = argparse.ArgumentParser()
parser.add_argument(
    'episode', type=Path, nargs='?', default=share_path('resource', 'demo_episode')
)
parser.add_argument('--out', type=Path, default=Path('out/examples'))
options = parser.parse_args()

pipeline = Pipeline.load('bundled')
recording = load_recording(options.episode, pipeline.spec, pipeline.robot)
observation = recording.observation(0)

episode = pipeline.begin(observation, RolloutOptions(instruction=recording.instruction, seed=0))
chunks = []
for prediction in episode.extend(commands_from(recording, 0)):
    video, success = prediction.video, prediction.success
    chunks.append(video.frames)
    print(f'up to {video.times[-1]:.1f} s: success {success.probability:.2f}')
    print(*success.reasons, sep='\n', end='\n\n')

options.out.mkdir(parents=True, exist_ok=True)
frames = np.concatenate(chunks, axis=1)  # (V, T, H, W, 3)
for view, frames_of_view in zip(pipeline.spec.views, frames, strict=True):
    write_video(options.out / f'imagined_{view}.mp4', frames_of_view, pipeline.spec.fps)
print(f'written: {options.out}/imagined_*.mp4')
