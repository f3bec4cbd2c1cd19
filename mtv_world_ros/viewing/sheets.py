"""Contact sheet and video of what bags show: real, drawn and imagined frames side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil
from pathlib import Path

import numpy as np

from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.estimate_words import estimate_lines
from mtv_world_ros.core.images import resize_frames, write_png
from mtv_world_ros.viewing.streams import read_streams, Streams
from mtv_world_ros.viewing.video import Comparison, contact_sheet, KINDS, side_by_side, write_video

#: maximum number of frames of a video
MAX_VIDEO_FRAMES = 600
#: size of a video at which its quality is not lowered any more; the lowest quality may exceed it
MAX_VIDEO_BYTES = 4_000_000
#: file name of a contact sheet
SHEET = 'contact_sheet.png'
#: file name of a video of recorded and imagined frames
VIDEO = 'comparison.mp4'
#: grey level of a missing frame
_BLANK = 225
#: maximum time between a frame and the moment that it represents [imagined frame periods]
_MAX_TIME_OFFSET = 0.6


def write_pictures(bags: Sequence[Path], out: Path, *, has_video: bool = True) -> list[Path]:
    """Write `contact_sheet.png` and `comparison.mp4` of predictions; return their paths.

    A long video shows every second, third, ... frame, `MAX_VIDEO_FRAMES` at most, in its own
    time; its quality is lowered until it takes `MAX_VIDEO_BYTES`, down to a limit.

    Args:
        bags: predictions, and the episode that they are of, if it is at hand.
        out: folder of the pictures.
        has_video: write the video as well.

    Raises:
        EpisodeError: nothing was imagined.
    """
    streams = read_streams(bags)
    comparison = comparison_frames(streams)
    instructions = [t for _, t in streams.words if t.startswith('instruction: ')]
    notes = _estimates(streams)
    title = instructions[0] if instructions else ''
    write_png(out / SHEET, contact_sheet(comparison, title=title, notes=notes))
    if not has_video:
        return [out / SHEET]
    period = float(np.median(np.diff(comparison.times))) if len(comparison.times) > 1 else 0.2
    stride = ceil(len(comparison.times) / MAX_VIDEO_FRAMES)
    frames = side_by_side(every_nth_frame(comparison, stride))
    write_video(out / VIDEO, frames, 1 / (period * stride), max_bytes=MAX_VIDEO_BYTES)
    return [out / SHEET, out / VIDEO]


def _estimates(streams: Streams) -> list[str]:
    """Return the success estimates and their first reasons, where these were recorded."""
    if not streams.success:
        return []
    reasons = [text for _, text in streams.reasons]
    if len(reasons) != len(streams.success):  # a bag without reports, or one that was cut off
        reasons = [''] * len(streams.success)
    return estimate_lines(
        'success after each chunk', [value for _, value in streams.success], reasons
    )


def every_nth_frame(comparison: Comparison, stride: int) -> Comparison:
    """Return every `stride`-th frame, the first among them."""
    return replace(
        comparison,
        times=comparison.times[::stride],
        **{kind: comparison.frames(kind)[:, ::stride] for kind in KINDS},
        captions=tuple(row[::stride] for row in comparison.captions),
    )


def comparison_frames(streams: Streams) -> Comparison:
    """Return imagined frames and the other kinds of frames at their times; missing ones are grey.

    Kinds without any frame at these times are not shown.

    Raises:
        EpisodeError: nothing was imagined.
    """
    views = tuple(view for kind, view in streams.images if kind == 'imagined')
    if not views:
        raise EpisodeError('the recording holds no imagined frames')
    stamps = np.unique([stamp for stamp, _ in streams.images['imagined', views[0]]])
    size = streams.images['imagined', views[0]][0][1].shape[:2]
    reach = _MAX_TIME_OFFSET * float(np.median(np.diff(stamps))) if len(stamps) > 1 else np.inf
    frames = {
        kind: np.stack([_at(streams, kind, view, stamps, size, reach) for view in views])
        for kind in KINDS
    }
    return Comparison(
        views=views,
        times=(stamps - stamps[0]) * 1e-9,
        real=frames['real'],
        trajectory=frames['trajectory'],
        imagined=frames['imagined'],
        kinds=tuple(kind for kind in KINDS if (frames[kind] != _BLANK).any()),
    )


def _at(
    streams: Streams, kind: str, view: str, stamps: np.ndarray, size: Sequence[int], reach: float
) -> ByteArray:
    """Return (T, H, W, 3) frames nearest to the stamps."""
    blank = np.full((*size, 3), _BLANK, np.uint8)
    found = streams.images.get((kind, view), [])
    if not found:
        return np.stack([blank] * len(stamps))
    known = np.array([stamp for stamp, _ in found])
    shown = []
    for stamp in stamps:
        index = int(np.abs(known - stamp).argmin())
        near = abs(int(known[index]) - int(stamp)) <= reach
        frame = resize_frames(found[index][1][None], size[1], size[0])[0] if near else blank
        shown.append(frame)
    return np.stack(shown)
