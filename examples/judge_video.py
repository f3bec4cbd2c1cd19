"""Judges a recorded video: did the task succeed? Nothing is imagined.

    python examples/judge_video.py [EPISODE]

Prints the probability of success at the end of the episode, and why.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mtv_world_ros import judge, load_recording, Pipeline, share_path

parser = argparse.ArgumentParser()
parser.add_argument(
    'episode', type=Path, nargs='?', default=share_path('resource', 'demo_episode')
)
options = parser.parse_args()

pipeline = Pipeline.load('bundled')
recording = load_recording(options.episode, pipeline.spec, pipeline.robot)
success = judge(pipeline, recording)
print(f'{recording.instruction}: success {success.probability:.2f}, recorded {recording.outcome}')
print(*success.reasons, sep='\n')
