"""How well does the weight-free colour segmenter find the simulator's objects?

    python benchmark/segmenter.py DATASET [--episodes 60] [--width 96 --height 72] [--blur 0]

Scores it on the recorded frames against the simulator's masks, in windows of 17 frames as in
serving, and counts the frames in which it was wrong and did not say so.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import time

import cv2
import numpy as np

from mtv_world_ros.data.clips import load_recording, Recording
from mtv_world_ros.data.mcap_reader import list_episodes
from mtv_world_ros.data_types import ObjectMasks, WorldModelSpec
from mtv_world_ros.geometry.robot_file import load_robot
from mtv_world_ros.resources import share_path
from mtv_world_ros.success.jaccard import jaccard
from mtv_world_ros.success.segmenter import ColourSegmenter, masks_from_ids

WINDOW = 17
#: an object that shows fewer pixels is not expected to be found
MIN_AREA_PX = 6
#: below this J a mask is wrong
WRONG = 0.5
#: view, object, status, true area [px], J
Row = tuple[str, str, str, float, float]
SECONDS: list[float] = []


def score(recording: Recording, blur: float) -> list[Row]:
    """One row per view, object and frame; adds to `SECONDS`."""
    rows = []
    segmenter = ColourSegmenter()
    assert recording.object_ids is not None
    for start in range(0, len(recording.times) - WINDOW + 1, WINDOW):
        frames = recording.frames[:, start : start + WINDOW]
        if blur:
            frames = np.array(
                [[cv2.GaussianBlur(f, (0, 0), blur) for f in view] for view in frames]
            )
        ids = recording.object_ids[:, start : start + WINDOW]
        true = masks_from_ids(ids, recording.objects, recording.objects)
        begun = time.process_time()
        found = segmenter.segment(frames, recording.objects)
        SECONDS.append(time.process_time() - begun)
        rows += _rows(recording, found, true)
    return rows


def _rows(recording: Recording, found: ObjectMasks, true: ObjectMasks) -> list[Row]:
    scores = jaccard(found.masks, true.masks)
    areas = true.masks.sum((-2, -1))
    return [
        (camera.view, name, found.status[view][item], float(area), float(value))
        for view, camera in enumerate(recording.cameras)
        for item, name in enumerate(recording.objects)
        for area, value in zip(areas[view, item], scores[view, item], strict=True)
    ]


def main() -> None:
    """Reads the arguments, scores, prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('dataset', type=Path)
    parser.add_argument('--episodes', type=int, default=60)
    parser.add_argument('--width', type=int, default=96)
    parser.add_argument('--height', type=int, default=72)
    parser.add_argument('--blur', type=float, default=0.0, help='sigma [px] before segmenting')
    options = parser.parse_args()
    spec = WorldModelSpec(
        views=('low', 'high'),
        fps=5,
        num_frames=16,
        width=options.width,
        height=options.height,
        robot='yam_bimanual',
    )
    robot = load_robot(share_path('config', 'robots', 'yam_bimanual.yaml'))
    rows = []
    for path in list_episodes(options.dataset)[: options.episodes]:
        rows += score(load_recording(path, spec, robot), options.blur)
    shown = [row for row in rows if row[3] >= MIN_AREA_PX]
    print(
        f'{options.width}x{options.height} px, blur {options.blur}: {len(rows)} object frames, '
        f'{len(shown)} of them show at least {MIN_AREA_PX} px'
    )
    print(f'{1000 * np.median(SECONDS):.1f} ms of processor time for 2 x {WINDOW} frames (median)')
    for view in spec.views:
        _print_view(view, [row for row in shown if row[0] == view])
    _by('colour', shown, 1)
    _by('status', rows, 2)


def _print_view(view: str, rows: list[Row]) -> None:
    ok = [row[4] for row in rows if row[2] == 'ok']
    silent = sum(value < WRONG for value in ok)
    print(
        f'{view:5} J {np.mean(ok):.3f}  says it does not know {1 - len(ok) / len(rows):.2%}  '
        f'wrong and silent {silent / len(rows):.2%}'
    )


def _by(title: str, rows: list[Row], column: int) -> None:
    for key in sorted({str(row[column]) for row in rows}):
        scores = [row[4] for row in rows if row[column] == key]
        wrong = np.mean([value < WRONG for value in scores])
        print(
            f'{title} {key:14} {len(scores):7} frames  J {np.mean(scores):.3f}  wrong {wrong:.2%}'
        )


if __name__ == '__main__':
    main()
