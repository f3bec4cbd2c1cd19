"""Real frames, trajectory video and imagined frames side by side, as pictures and videos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
import io
from pathlib import Path

import av
import cv2
import numpy as np

from mtv_world_ros.core.bounded_input import check_limit
from mtv_world_ros.core.data_types import ByteArray, FloatArray
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.files import write_whole

#: kinds of frames, in the order of rows and columns
KINDS = ('real', 'trajectory', 'imagined')
#: RGB colour of the background
_BACKGROUND = (255, 255, 255)
#: RGB colour of the text
_TEXT_COLOUR = (25, 25, 25)
#: RGB colour of captions and times
_CAPTION_COLOUR = (120, 120, 120)
#: gap between frames [px]
_GAP_PX = 4
#: height of a line of the header [px]
_HEAD_PX = 26
#: width of the column with the names of the rows [px]
_MARGIN_PX = 116
#: qualities of x264 that are tried until a video is small enough
_CRFS = (24, 30, 36, 42)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
#: factor on the font's base size
_FONT_SCALE = 0.45


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Recorded frames, trajectory video and predicted frames of one rollout.

    Attributes:
        views: names of the V views.
        times: (T,) times of the frames [s].
        real: (V, T, H, W, 3) uint8 RGB recorded frames.
        trajectory: (V, T, H, W, 3) uint8 RGB trajectory video.
        imagined: (V, T, H, W, 3) uint8 RGB predicted frames.
        captions: (V, T) short texts under the imagined frames, e.g. their J; empty = none.
        kinds: kinds of `KINDS`, those that are there and shown.
    """

    views: tuple[str, ...]
    times: FloatArray
    real: ByteArray
    trajectory: ByteArray
    imagined: ByteArray
    captions: tuple[tuple[str, ...], ...] = ()
    kinds: tuple[str, ...] = KINDS

    def __post_init__(self) -> None:
        shape = (len(self.views), len(self.times), *self.real.shape[2:])
        for kind in KINDS:
            if self.frames(kind).shape != shape:
                raise EpisodeError(
                    f'{kind} frames are {self.frames(kind).shape}, expected {shape}: all three '
                    'videos must have the same views, times and size'
                )

    def frames(self, kind: str) -> ByteArray:
        """Return the (V, T, H, W, 3) frames of one of `KINDS`."""
        return {'real': self.real, 'trajectory': self.trajectory, 'imagined': self.imagined}[kind]


def contact_sheet(
    comparison: Comparison,
    *,
    title: str = '',
    notes: Sequence[str] = (),
    num_columns: int = 8,
    tile_width: int = 240,
) -> ByteArray:
    """Return an (H, W, 3) uint8 RGB picture: a row per view and kind, time from left to right.

    Args:
        comparison: real, drawn and imagined frames of a rollout.
        title: heading of the sheet.
        notes: lines below the heading.
        num_columns: largest number of frames in a row; spread evenly, the first and last among
            them.
        tile_width: width of a frame [px]; small frames are enlarged by whole factors up to it.
    """
    num_frames = len(comparison.times)
    shown = np.linspace(0, num_frames - 1, min(num_columns, num_frames)).round().astype(int)
    bands = [
        _view_band(comparison, view, np.unique(shown), tile_width)
        for view in range(len(comparison.views))
    ]
    width = bands[0].shape[1]
    head = _blank(_HEAD_PX * (2 if title else 1), width)
    _text(head, title, (8, 18), scale=0.6)
    tile = _tile_size(comparison.real.shape[2:4], tile_width)[1]
    for column, frame in enumerate(np.unique(shown)):
        x = _MARGIN_PX + column * (tile + _GAP_PX)
        _text(
            head,
            f'{comparison.times[frame]:+.1f} s',
            (x + 2, len(head) - 8),
            colour=_CAPTION_COLOUR,
        )
    foot = _blank(_HEAD_PX * len(notes), width)
    for index, note in enumerate(notes):
        _text(foot, note, (8, 16 + index * _HEAD_PX))
    return np.concatenate([head, *bands, foot])


def _view_band(
    comparison: Comparison, view: int, columns: np.ndarray, tile_width: int
) -> ByteArray:
    """Return rows of one view: real, trajectory, imagined, and the captions if there are any."""
    height, width = _tile_size(comparison.real.shape[2:4], tile_width)
    captions = _HEAD_PX - 8 if comparison.captions else 0
    total = len(comparison.kinds) * (height + _GAP_PX) + captions + 2 * _GAP_PX
    band = _blank(total, _MARGIN_PX + len(columns) * (width + _GAP_PX))
    for row, kind in enumerate(comparison.kinds):
        y = row * (height + _GAP_PX)
        _text(band, comparison.views[view], (8, y + height // 2 - 8), scale=0.55)
        _text(band, kind, (8, y + height // 2 + 12), colour=_CAPTION_COLOUR)
        for column, frame in enumerate(columns):
            x = _MARGIN_PX + column * (width + _GAP_PX)
            tile = comparison.frames(kind)[view, frame]
            band[y : y + height, x : x + width] = _fit(tile, width, height)
    if captions:
        for column, frame in enumerate(columns):
            place = (_MARGIN_PX + column * (width + _GAP_PX) + 2, total - 2 * _GAP_PX - 4)
            _text(band, comparison.captions[view][frame], place, colour=_CAPTION_COLOUR)
    return band


def side_by_side(comparison: Comparison, *, tile_width: int = 384) -> ByteArray:
    """Return (T, H, W, 3) uint8 RGB frames: a row per view; real, trajectory, imagined.

    Above each row stand the view and the captions of the imagined frames.
    """
    height, width = _tile_size(comparison.real.shape[2:4], tile_width)
    num_views, num_frames = len(comparison.views), len(comparison.times)
    total = (
        _even(num_views * (_HEAD_PX + height) + _GAP_PX),
        _even(len(comparison.kinds) * (width + _GAP_PX) + _GAP_PX),
    )
    video = np.stack([_blank(*total)] * num_frames)
    for frame in range(num_frames):
        for column, kind in enumerate(comparison.kinds):
            x = _GAP_PX + column * (width + _GAP_PX)
            for v in range(num_views):
                y = v * (_HEAD_PX + height) + _HEAD_PX
                _text(video[frame], _heading(comparison, kind, v, frame), (x + 4, y - 8))
                tile = comparison.frames(kind)[v, frame]
                video[frame, y : y + height, x : x + width] = _fit(tile, width, height)
    return video


def _heading(comparison: Comparison, kind: str, view: int, frame: int) -> str:
    caption = comparison.captions[view][frame] if comparison.captions else ''
    heading = f'{kind}  {caption}' if kind == 'imagined' else kind
    if kind == comparison.kinds[0]:
        return f'{comparison.views[view]}: {heading}  {comparison.times[frame]:+.1f} s'
    return heading


def write_video(
    path: Path, frames: ByteArray, fps: float, *, max_bytes: int | None = None
) -> None:
    """Write (T, H, W, 3) uint8 RGB frames of even size as H.264 in MP4.

    Args:
        path: ends in `.mp4`; written under a temporary name and renamed.
        frames: (T, H, W, 3) uint8 RGB.
        fps: frames a second.
        max_bytes: the quality is lowered until the file takes no more, down to a limit.
    """
    data = encode_video(frames, fps)
    if max_bytes is not None and len(data) > max_bytes:
        data = encode_small_video(frames, fps, max_bytes)
    write_whole(path, data)


def encode_small_video(frames: ByteArray, fps: float, max_bytes: int) -> bytes:
    """Return the MP4 of the best quality within `max_bytes`, else of the lowest quality."""
    data = b''
    for crf in _CRFS:
        data = encode_video(frames, fps, crf=crf)
        if len(data) <= max_bytes:
            break
    return data


def _tile_size(size: tuple[int, ...], tile_width: int) -> tuple[int, int]:
    """(height, width) of a frame in the picture: a whole multiple, or shrunk to the width."""
    height, width = size
    factor = tile_width // width
    if factor >= 1:
        return height * factor, width * factor
    return round(height * tile_width / width), tile_width


def _blank(height: int, width: int) -> ByteArray:
    return np.full((height, width, 3), _BACKGROUND, np.uint8)


def _fit(frame: ByteArray, width: int, height: int) -> ByteArray:
    shrinks = width < frame.shape[1]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(frame, (width, height), interpolation=method), np.uint8)


def _even(size: int) -> int:
    return size + size % 2


def _text(
    image: ByteArray,
    text: str,
    place: tuple[int, int],
    *,
    scale: float = _FONT_SCALE,
    colour: tuple[int, int, int] = _TEXT_COLOUR,
) -> None:
    """Draw plain ASCII text in place, its baseline at (x, y)."""
    plain = text.encode('ascii', 'replace').decode()
    cv2.putText(image, plain, place, _FONT, scale, colour, 1, cv2.LINE_AA)


def encode_video(
    frames: ByteArray,
    fps: float,
    *,
    crf: int = 20,
    full_colour: bool = False,
) -> bytes:
    """Return an MP4 file of (T, H, W, 3) uint8 RGB frames.

    Args:
        frames: (T, H, W, 3) uint8 RGB; H and W even unless `full_colour`.
        fps: frames a second.
        crf: quality, 0 best to 51 worst.
        full_colour: keep colour at every pixel (4:4:4), which not every browser plays; the same
            frames may then give another file.
    """
    rate = Fraction(fps).limit_denominator(1000)
    # bf: frames in the order in which they are shown; Rerun 0.41 plays no others without ffmpeg
    options = {'crf': str(crf), 'preset': 'veryfast', 'threads': '1', 'bf': '0'}
    if not full_colour:
        # with several threads, or with x264's macroblock tree, the same frames now and then gave
        # another file on a busy machine: 12 of 240 with the tree, 0 of 480 without it (PyAV 18);
        # without it files are a fifth larger
        options['x264-params'] = 'mbtree=0'
    file = io.BytesIO()
    with av.open(file, 'w', format='mp4') as container:
        stream = container.add_stream('libx264', rate=rate, options=options)
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = 'yuv444p' if full_colour else 'yuv420p'
        for frame in frames:
            image = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format='rgb24')
            container.mux(stream.encode(image))
        container.mux(stream.encode())
    return file.getvalue()


def decode_video(data: bytes) -> ByteArray:
    """Return the (T, H, W, 3) uint8 RGB frames of a video file's bytes.

    Raises:
        EpisodeError: the bytes are no video.
    """
    try:
        with av.open(io.BytesIO(data), 'r') as container:
            frames = []
            for frame in container.decode(video=0):
                num_bytes = 3 * frame.width * frame.height * (len(frames) + 1)
                check_limit('video_bytes', num_bytes, 'the video')
                frames.append(frame.to_ndarray(format='rgb24'))
            shapes = {frame.shape for frame in frames}
            if len(shapes) > 1:
                raise ValueError(f'its frames have the shapes {sorted(shapes)}')
    except (av.FFmpegError, IndexError, ValueError) as error:  # names in it may be no UTF-8
        raise EpisodeError(f'{len(data)} bytes cannot be read as a video: {error}') from error
    return np.asarray(frames, np.uint8) if frames else np.zeros((0, 0, 0, 3), np.uint8)
