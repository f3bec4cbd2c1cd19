"""Puts a world model of your own into the main path.

    python examples/own_world_model.py [EPISODE]

A world model has `spec` and `predict`; drawing, masks and the estimate stay what they are. This
one holds the first frame: the baseline that every model has to beat.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mtv_world_ros import (
    commands_from,
    ControlInputs,
    load_recording,
    Pipeline,
    RolloutOptions,
    share_path,
    WorldModelSpec,
)


@dataclass(frozen=True)
class HeldFrame:
    """Predicts that nothing happens."""

    spec: WorldModelSpec

    def predict(
        self, start_frame: np.ndarray, control: ControlInputs, **options: object
    ) -> np.ndarray:
        """Return (V, T, H, W, 3) uint8 RGB frames: the (V, H, W, 3) start frame, T times."""
        del control, options  # positions, seed, steps, ...: see `WorldModel`
        return np.repeat(start_frame[:, None], self.spec.num_frames, axis=1)


def imagined(pipeline: Pipeline) -> float:
    """Estimate at the end of the recorded commands."""
    episode = pipeline.begin(
        recording.observation(0), RolloutOptions(instruction=recording.instruction)
    )
    *_, last = episode.extend(commands_from(recording, 0))
    return last.success.probability


parser = argparse.ArgumentParser()
parser.add_argument(
    'episode', type=Path, nargs='?', default=share_path('resource', 'demo_episode')
)
options = parser.parse_args()

bundled = Pipeline.load('bundled')
recording = load_recording(options.episode, bundled.spec, bundled.robot)
held = replace(bundled.without_foresight(), world_model=HeldFrame(bundled.spec))
print(f'bundled model: success {imagined(bundled):.2f}; held frame: {imagined(held):.2f}')
