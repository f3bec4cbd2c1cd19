"""Contact sheets of a data set: frames of a success and a failure of every task, all views."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np

from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.simulation.collect.dataset_card import CardEntry

SHEET_FILE = 'contact_sheet.png'
OUTCOMES = ('success', 'failure')
#: gap between the blocks of a sheet [px]
_GAP_PX = 6
#: height of a line of text [px]
_LINE_PX = 18
#: grey level of the background
_BACKGROUND = 255
#: RGB colour of the text
_TEXT_COLOUR = (40, 40, 40)


def film_strip(path: Path, num_frames: int, width: int) -> ByteArray:
    """Return frames of an episode, evenly from first to last: time to the right, views below.

    Args:
        path: folder of the episode.
        num_frames: number of columns.
        width: width of a frame in the strip [px].

    Returns:
        (V * (h + 2), num_frames * (width + 2), 3) uint8 RGB; 2 px of paper follow each frame.
    """
    episode = read_episode(path, with_cameras=False, with_masks=False)
    rows = []
    for view in episode.views:
        frames = episode.images[view].frames
        chosen = np.linspace(0, len(frames) - 1, num_frames).round().astype(int)
        rows.append(np.concatenate([_small(frames[int(i)], width) for i in chosen], axis=1))
    return np.concatenate(rows)


def _small(frame: ByteArray, width: int) -> ByteArray:
    height = round(frame.shape[0] * width / frame.shape[1])
    small = cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)
    return np.pad(small, ((0, 2), (0, 2), (0, 0)), constant_values=_BACKGROUND).astype(np.uint8)


def titled_picture(text: str, picture: ByteArray) -> ByteArray:
    """Return a picture (H, W, 3) with a line of text above it."""
    line = np.full((_LINE_PX, picture.shape[1], 3), _BACKGROUND, np.uint8)
    cv2.putText(line, text, (2, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _TEXT_COLOUR, 1, cv2.LINE_AA)
    return np.concatenate([line, picture])


def _row(out: Path, pair: Sequence[CardEntry | None], num_frames: int, width: int) -> ByteArray:
    """Return a success and a failure of one task side by side.

    A missing one leaves its place empty.
    """
    strips = [entry and film_strip(out / entry.name, num_frames, width) for entry in pair]
    shape = next(strip.shape for strip in strips if strip is not None)
    blocks = [
        titled_picture(
            f'{entry.name}: {entry.instruction} ({entry.outcome})' if entry else f'no {outcome}',
            np.full(shape, 235, np.uint8) if strip is None else strip,
        )
        for outcome, entry, strip in zip(OUTCOMES, pair, strips, strict=True)
    ]
    gap = np.full((len(blocks[0]), _GAP_PX, 3), _BACKGROUND, np.uint8)
    return np.concatenate([blocks[0], gap, blocks[1]], axis=1)


def _pairs(
    entries: Iterable[CardEntry], count: int
) -> list[tuple[CardEntry | None, CardEntry | None]]:
    """Return the first `count` successes and failures of every task and kind."""
    groups: dict[tuple[str, str], dict[str, list[CardEntry]]] = {}
    for entry in sorted(entries, key=lambda entry: entry.name):
        group = groups.setdefault((entry.zero_shot or '', entry.task), {o: [] for o in OUTCOMES})
        group[entry.outcome].append(entry)
    pairs = []
    for group in groups.values():
        for k in range(min(count, max(map(len, group.values())))):
            found = [(group[outcome][k : k + 1] or [None])[0] for outcome in OUTCOMES]
            pairs.append((found[0], found[1]))
    return pairs


def contact_sheet(
    out: Path,
    entries: Iterable[CardEntry],
    *,
    pairs: int = 1,
    num_frames: int = 6,
    width: int = 128,
) -> ByteArray:
    """Return a picture (H, W, 3) uint8 RGB with a row per task, read from the episodes.

    Args:
        out: folder of the data set.
        entries: episodes of the data set, at least one.
        pairs: rows per task, each a success and a failure.
        num_frames: number of frames of each episode.
        width: width of a frame [px].
    """
    rows = [_row(out, pair, num_frames, width) for pair in _pairs(entries, pairs)]
    gap = np.full((_GAP_PX, rows[0].shape[1], 3), _BACKGROUND, np.uint8)
    return np.concatenate([part for row in rows for part in (row, gap)])
