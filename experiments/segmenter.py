"""How well does a segmenter, by default the weight-free one, find the simulator's objects?

    mtv-world collect --task all --episodes 3 --seed 9000 --out EPISODES
    python experiments/segmenter.py EPISODES [--segmenter sam2] [--out experiments/results]

Scores it on the recorded frames against the simulator's masks, in windows of 17 frames as in
serving, and counts the frames in which it was wrong and did not say so.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
import os
from pathlib import Path
import time

import cv2
import numpy as np
import page

from mtv_world_ros.core.data_types import ByteArray, ObjectMasks, WorldModelSpec
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_reader import list_episodes
from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.vision.jaccard import jaccard
from mtv_world_ros.vision.segmenters.choose import choose_segmenter
from mtv_world_ros.vision.segmenters.registry import check_segmenter_name
from mtv_world_ros.vision.segmenters.segmenter import masks_from_ids, Segmenter

WINDOW = 17
VIEWS = ('low', 'high')
RECORDED, MODEL = (384, 288), (96, 72)
#: an object that shows less, but something, is not expected to be found: 6 px of 96 x 72
MIN_SHARE = 6 / (96 * 72)
#: below this J a mask is wrong
WRONG = 0.5

Degrade = Callable[[ByteArray], ByteArray]


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One object in one view and frame."""

    view: str
    name: str
    status: str
    share: float
    j: float

    @property
    def counts(self) -> bool:
        """Whether it is clear what the segmenter should have said."""
        return self.share == 0 or self.share >= MIN_SHARE

    @property
    def wrong(self) -> bool:
        """An object missed or another thing outlined; one outlined that no pixel shows."""
        return self.j < WRONG


def _as_recorded(frame: ByteArray) -> ByteArray:
    return frame


def _blurred(frame: ByteArray) -> ByteArray:
    return np.asarray(cv2.GaussianBlur(frame, (0, 0), 1.0), np.uint8)


def _dark(frame: ByteArray) -> ByteArray:
    return (frame * 0.5).astype(np.uint8)


def _pale(frame: ByteArray) -> ByteArray:
    grey = frame.mean(-1, keepdims=True)
    return (grey + 0.6 * (frame - grey)).astype(np.uint8)


CONDITIONS: tuple[tuple[str, tuple[int, int], Degrade], ...] = (
    ('as recorded', RECORDED, _as_recorded),
    ('small preset', MODEL, _as_recorded),
    ('small preset, blurred by 1 px', MODEL, _blurred),
    ('small preset, half as bright', MODEL, _dark),
    ('small preset, 0.6 of the saturation', MODEL, _pale),
)


def score(
    segmenter: Segmenter, recording: Recording, degrade: Degrade, seconds: list[float]
) -> list[Row]:
    """A row per view, object and frame; adds the time of each window to `seconds`."""
    assert recording.object_ids is not None
    rows = []
    for start in range(0, len(recording.times), WINDOW):
        window = slice(start, start + WINDOW)
        frames = np.array([[degrade(f) for f in view] for view in recording.frames[:, window]])
        true = masks_from_ids(
            recording.object_ids[:, window], recording.objects, recording.objects
        )
        begun = time.process_time()
        found = segmenter.segment(frames, recording.objects)
        seconds.append(time.process_time() - begun)
        rows += _rows(found, true)
    return rows


def _rows(found: ObjectMasks, true: ObjectMasks) -> list[Row]:
    scores = jaccard(found.masks, true.masks)
    shares = true.masks.mean((-2, -1))
    return [
        Row(
            view=view,
            name=name,
            status=found.status[v][o],
            share=float(shares[v, o, t]),
            j=float(scores[v, o, t]),
        )
        for v, view in enumerate(VIEWS)
        for o, name in enumerate(found.names)
        for t in range(scores.shape[2])
    ]


def _recordings(paths: Sequence[Path], size: tuple[int, int]) -> list[Recording]:
    spec = WorldModelSpec(
        views=VIEWS, fps=5, num_frames=16, width=size[0], height=size[1], robot='yam_bimanual'
    )
    robot = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
    return [load_recording(path, spec, robot) for path in paths]


def _summary(rows: Sequence[Row]) -> list[str]:
    counted = [row for row in rows if row.counts]
    trusted = [row for row in counted if row.status == 'ok']
    shown = [row.j for row in trusted if row.share]
    silent = sum(row.wrong for row in trusted) / max(1, len(counted))
    return [
        f'{len(counted)}',
        f'{np.mean(shown):.3f}' if shown else '-',
        f'{1 - len(trusted) / max(1, len(counted)):.2%}',
        f'{silent:.2%}',
    ]


_HEADER = ('frames', 'J where trusted', 'says it does not know', 'wrong and silent')


def _by(rows: Sequence[Row], key: Callable[[Row], str]) -> str:
    groups = sorted({key(row) for row in rows})
    lines = [[group, *_summary([r for r in rows if key(r) == group])] for group in groups]
    return page.table(('', *_HEADER), lines)


def main() -> None:
    """Read the arguments, score and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('dataset', type=Path)
    parser.add_argument('--segmenter', type=check_segmenter_name, default='colour')
    parser.add_argument('--device', default='cpu')
    parser.add_argument('--episodes', type=int, help='use only the first so many')
    parser.add_argument('--seed', type=int, default=9000, help='that the episodes were made with')
    parser.add_argument('--machine', default=f'cpu{os.cpu_count()}')
    parser.add_argument('--out', type=Path, help='folder to write the page into')
    options = parser.parse_args()
    paths = list_episodes(options.dataset)[: options.episodes]
    options.repeats = len(paths)
    segmenter = choose_segmenter(options.segmenter, device=options.device)
    lines, kept = [], []
    loaded: dict[tuple[int, int], list[Recording]] = {}
    for title, size, degrade in CONDITIONS:
        seconds: list[float] = []
        if size not in loaded:
            loaded = {size: _recordings(paths, size)}
        rows = [row for r in loaded[size] for row in score(segmenter, r, degrade, seconds)]
        name = f'{title} ({size[0]} x {size[1]})'
        milliseconds = f'{1e3 * np.median(seconds):.0f}'
        lines.append([name, *_summary(rows), milliseconds])
        if degrade is _as_recorded:
            kept.append(f'## {name}\n')
            kept += [_by(rows, key) + '\n' for key in (_view, _shape, _colour, _status)]
    body = (
        f'{len(paths)} episodes. Wrong: J below {WRONG}; of an object that no pixel shows, any '
        f'mask. Frames that show an object with less than {MIN_SHARE:.2%} of their pixels do not '
        f'count. ms: processor time for 2 views x {WINDOW} frames, median.\n\n'
    )
    body += page.table(('frames are', *_HEADER, 'ms'), lines) + '\n\n' + '\n'.join(kept)
    page.publish(
        f'segmenter_{segmenter.name.replace("+", "_")}_seed{options.seed}',
        f"Segmenter `{segmenter.name}` against the simulator's masks",
        f'python experiments/segmenter.py EPISODES --segmenter {options.segmenter} '
        f'--seed {options.seed}',
        body,
        options,
        f'OpenCV {cv2.__version__}',
    )


def _view(row: Row) -> str:
    return f'view {row.view}'


def _shape(row: Row) -> str:
    return row.name.split()[-1]


def _colour(row: Row) -> str:
    return row.name.split()[0]


def _status(row: Row) -> str:
    return f'says {row.status}'


if __name__ == '__main__':
    main()
