"""Uses a segmenter of your own: how the masks of objects are found.

    python examples/own_segmenter.py [EPISODE]
    PYTHONPATH=examples mtv-world evaluate bundled EPISODES --segmenter own_segmenter:HueSegmenter

Anything with `name` and `segment` will do. This one finds objects by the colour in their name,
far more simply than the bundled one, and says nothing about its doubts. Commands and the node
take the class by its name, `module:Class`.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from mtv_world_ros import judge, load_recording, ObjectMasks, Pipeline, share_path

#: hues of OpenCV, 0 .. 179, around which a colour is
HUES = {'red': 0, 'yellow': 28, 'green': 60, 'blue': 110, 'purple': 140, 'pink': 165}


class HueSegmenter:
    """Takes what is colourful and near the hue that an object's name begins with."""

    name = 'hue'

    def segment(
        self,
        frames: np.ndarray,
        names: tuple[str, ...],
        first_masks: np.ndarray | None = None,
        first_frames: np.ndarray | None = None,
    ) -> ObjectMasks:
        """Return (V, O, T, H, W) masks of (V, T, H, W, 3) uint8 RGB frames."""
        del first_masks, first_frames  # every frame is looked at by itself
        hsv = cv2.cvtColor(frames.reshape(-1, frames.shape[3], 3), cv2.COLOR_RGB2HSV)
        hue, saturation, _ = np.moveaxis(hsv.reshape(frames.shape).astype(int), -1, 0)
        masks = []
        for name in names:
            away = np.abs(hue - HUES.get(name.split()[0], 1000))
            masks.append((np.minimum(away, 180 - away) < 9) & (saturation > 70))
        found = np.stack(masks, axis=1)
        seen = np.asarray(found.any(axis=(2, 3, 4)))
        status = tuple(tuple('ok' if one else 'absent' for one in row) for row in seen.tolist())
        return ObjectMasks(names=names, masks=found, status=status)


def main() -> None:
    """Judge an episode with the bundled segmenter and with this one."""
    parser = argparse.ArgumentParser()
    parser.add_argument(
        'episode', type=Path, nargs='?', default=share_path('resource', 'demo_episode')
    )
    options = parser.parse_args()

    pipeline = Pipeline.load('bundled')
    recording = load_recording(options.episode, pipeline.spec, pipeline.robot)
    for segmenter in (pipeline.segmenter, HueSegmenter()):
        success = judge(replace(pipeline, segmenter=segmenter), recording)
        print(f'{segmenter.name:<8} success {success.probability:.2f}; {success.reasons[0]}')


if __name__ == '__main__':
    main()
