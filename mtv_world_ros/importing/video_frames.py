"""Frames of video files as players show them, and their times compared with those of rows.

N frames, T rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
import struct
from typing import Any, Literal

import av
from av.container import InputContainer
from av.sidedata.sidedata import Type as SideDataType
import cv2
import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.core.bounded_input import check_limit, placeholder, require_regular
from mtv_world_ros.core.data_types import ByteArray, FloatArray
from mtv_world_ros.core.errors import EpisodeError

FrameTimes = Literal['auto', 'video', 'rows']

#: deviation of a display matrix from turns by 90 degrees that is rounding
_MATRIX_TOLERANCE = 0.02
#: largest deviation of a frame's distance from the median distance at a constant rate [periods]
_JITTER = 0.25
#: difference of a frame's and its row's time that is rounding [periods]
_SAME_TIME = 0.1
#: difference of two durations that count as equal [fraction of the longer one]
_SAME_SPAN = 0.05
#: difference of two durations that count as equal [periods]
_SAME_SPAN_PERIODS = 2.0
#: difference of two rates that still counts as one rate, as a share
_SAME_RATE = 0.1
#: packets are stored in the order of decoding: at most this much before others [s]
_REORDER_S = 2.0
#: units of time that are mistaken for seconds [1 / s]
_TIME_UNITS = {'ms': 1e3, 'us': 1e6, 'ns': 1e9}
#: deviation of a ratio of spans from a unit of time, as a share
_UNIT_TOLERANCE = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class Presentation:
    """Turn, mirroring and pixel aspect ratio that a container asks players to apply.

    Attributes:
        swaps_axes: rows become columns, before the flips.
        flips_x: columns are reversed.
        flips_y: rows are reversed.
        pixel_aspect: width of a pixel of the stored frame, divided by its height.
    """

    swaps_axes: bool = False
    flips_x: bool = False
    flips_y: bool = False
    pixel_aspect: float = 1.0

    @classmethod
    def of(cls, frame: av.VideoFrame, pixel_aspect: float) -> Presentation:
        """Return the presentation of a decoded frame.

        Raises:
            EpisodeError: the frame is turned by something else than a multiple of 90 degrees.
        """
        entries: Any = frame.side_data
        matrices = [d for d in entries if d.type == SideDataType.DISPLAYMATRIX]
        if not matrices:
            return cls(pixel_aspect=pixel_aspect)
        # a point (x, y) of the stored frame is shown at (a x + c y, b x + d y), 16.16 fixed point
        a, b, _, c, d, *_ = struct.unpack('=9i', bytes(matrices[0])[:36])
        swapped = abs(b) + abs(c) > abs(a) + abs(d)
        main, other = ((c, b), (a, d)) if swapped else ((a, d), (c, b))
        largest = max(map(abs, main))
        if not largest:  # empty matrix
            return cls(pixel_aspect=pixel_aspect)
        if max(map(abs, other)) > _MATRIX_TOLERANCE * largest or 0 in main:
            angle = np.degrees(np.arctan2(b, a))
            raise EpisodeError(
                f'its display matrix turns frames by {angle:.1f} degrees; turns by 90, 180 and '
                '270 degrees and mirroring are read'
            )
        return cls(
            swaps_axes=swapped,
            flips_x=main[0] < 0,
            flips_y=main[1] < 0,
            pixel_aspect=pixel_aspect,
        )

    def apply(self, frame: ByteArray) -> ByteArray:
        """Return the (H, W, 3) frame as it is to be seen, with square pixels."""
        height, width = self._square_size(frame)
        if (height, width) != frame.shape[:2]:
            check_limit('image_pixels', height * width, 'a frame with square pixels')
            frame = np.asarray(cv2.resize(frame, (width, height)), np.uint8)
        if self.swaps_axes:
            frame = frame.transpose(1, 0, 2)
        if self.flips_x:
            frame = frame[:, ::-1]
        if self.flips_y:
            frame = frame[::-1]
        return np.ascontiguousarray(frame)

    def _square_size(self, frame: ByteArray) -> tuple[int, int]:
        """Return height and width with square pixels; the shorter side of a pixel is stretched."""
        height, width = frame.shape[:2]
        if self.pixel_aspect >= 1:
            return height, round(width * self.pixel_aspect)
        return round(height / self.pixel_aspect), width

    def note(self, stored: ByteArray) -> str:
        """Describe the changes made to the frames of a video, with reasons; empty = none."""
        done = []
        if turn := self._turn():
            done.append(f'frames are {turn} (display matrix of the file)')
        height, width = self._square_size(stored)
        if (height, width) != stored.shape[:2]:
            done.append(
                f'{stored.shape[1]} x {stored.shape[0]} pixels are stretched to {width} x '
                f'{height}, because its pixels are not square (aspect ratio '
                f'{self.pixel_aspect:.4g})'
            )
        return '; '.join(done) + ', as players show them' if done else ''

    def _turn(self) -> str:
        turns = {
            (False, False, False): '',
            (False, True, True): 'turned by 180 degrees',
            (True, True, False): 'turned by 90 degrees clockwise',
            (True, False, True): 'turned by 90 degrees counterclockwise',
            (False, True, False): 'mirrored left to right',
            (False, False, True): 'mirrored top to bottom',
            (True, False, False): 'turned by 90 degrees and mirrored',
            (True, True, True): 'turned by 90 degrees and mirrored',
        }
        return turns[self.swaps_axes, self.flips_x, self.flips_y]


class VideoStream:
    """The video of an open file, decoded in order.

    Raises:
        EpisodeError: the file holds no video.
    """

    def __init__(self, container: InputContainer, path: Path) -> None:
        if not container.streams.video:
            raise EpisodeError(f"'{path}' holds no video")
        self._container, self._path = container, path
        self._stream = container.streams.video[0]
        ratio = self._stream.sample_aspect_ratio
        self._pixel_aspect = float(ratio) if ratio and ratio > 0 else 1.0

    def seek(self, seconds: float) -> None:
        """Go to the key frame before a time, where the file can be searched."""
        base = self._stream.time_base
        if base is not None:
            self._container.seek(int(seconds / base), stream=self._stream, backward=True)

    def packet_times(self, start_s: float, end_s: float) -> FloatArray:
        """Return the increasing times of frames in a part of the file, without decoding them."""
        base = self._stream.time_base
        if base is None:
            return np.zeros(0)
        if start_s > 0:
            self.seek(start_s)
        found = []
        for packet in self._container.demux(self._stream):
            if packet.pts is None:
                continue
            seconds = float(packet.pts * base)
            if seconds > end_s + _REORDER_S:
                break
            if start_s <= seconds <= end_s:
                found.append(seconds)
        return np.unique(found)

    def frames(self) -> Iterator[av.VideoFrame]:
        """Yield frames as they are stored."""
        for frame in self._container.decode(self._stream):
            check_limit('image_pixels', frame.width * frame.height, 'a frame')
            yield frame

    def shown(self, frame: av.VideoFrame) -> ByteArray:
        """Return the (H, W, 3) RGB frame as players show it."""
        return self._presentation(frame).apply(_rgb(frame))

    def note(self, frame: av.VideoFrame) -> str:
        """Describe the changes made to the frames, with reasons; empty = none."""
        return self._presentation(frame).note(_rgb(frame))

    def _presentation(self, frame: av.VideoFrame) -> Presentation:
        try:
            return Presentation.of(frame, self._pixel_aspect)
        except EpisodeError as error:
            raise EpisodeError(f"video '{self._path}': {error}") from error


@contextmanager
def open_video(path: Path) -> Iterator[VideoStream]:
    """Open a video file.

    Raises:
        EpisodeError: the file is missing or damaged, or holds no video; also while it is read.
    """
    try:
        require_regular(path)
        with av.open(str(path)) as container:
            yield VideoStream(container, path)
    except (av.FFmpegError, OSError, ValueError) as error:  # names in it may be no UTF-8
        reason = placeholder(path) or f'cannot be read: {error}'
        if isinstance(error, FileNotFoundError):
            reason = 'is not there; copy it, or correct its path'
        raise EpisodeError(f"video '{path}' {reason}") from error


def _rgb(frame: av.VideoFrame) -> ByteArray:
    return np.asarray(frame.to_ndarray(format='rgb24'), np.uint8)


def video_note(path: Path) -> str:
    """Describe the changes made to the frames of a video file, with reasons; empty = none.

    Raises:
        EpisodeError: see `open_video`.
    """
    with open_video(path) as video:
        frame = next(video.frames(), None)
        return '' if frame is None else video.note(frame)


class VideoFileFrames:
    """Frames of a video file, decoded one after the other.

    Attributes:
        times: (N,) times of the frames in the file [s]; None where the file has none that
            increase.
        note: change that is made to the frames, with its reason; empty = none.

    Raises:
        EpisodeError: the file is missing or damaged, or holds no frame.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.note = ''
        times: list[float] = []
        with open_video(path) as video:
            for frame in video.frames():
                if not times:
                    self.note = video.note(frame)
                times.append(np.nan if frame.time is None else float(frame.time))
        if not times:
            raise EpisodeError(f"'{path}' holds no frame")
        found = np.array(times)
        self.times: FloatArray | None = found if (np.diff(found) > 0).all() else None
        self._numbers = np.arange(len(times))
        self._decoded: Iterator[ByteArray] = iter(())
        self._next, self._last = len(times), np.zeros((0, 0, 3), np.uint8)

    def chosen(self, numbers: NDArray[np.int64]) -> VideoFileFrames:
        """Return some of the frames, by their increasing numbers."""
        found = VideoFileFrames.__new__(VideoFileFrames)
        found._path, found.note = self._path, self.note
        found._numbers = self._numbers[numbers]
        found.times = None if self.times is None else self.times[numbers]
        found._decoded, found._last = iter(()), np.zeros((0, 0, 3), np.uint8)
        found._next = self._numbers[-1] + 1
        return found

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, index: Any) -> ByteArray:
        if isinstance(index, slice):
            return np.stack([self._frame(i) for i in range(*index.indices(len(self)))])
        if np.ndim(index):
            return np.stack([self._frame(int(i)) for i in index])
        return self._frame(int(index))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return self[:]

    def _frame(self, index: int) -> ByteArray:
        index += len(self) if index < 0 else 0
        if not 0 <= index < len(self):
            raise IndexError(index)
        number = int(self._numbers[index])
        if number == self._next - 1 and self._last.size:
            return self._last
        if number < self._next:
            self._decoded, self._next = self._shown(), 0
        skipped = number - self._next
        found = next(islice(self._decoded, skipped, None), None)
        if found is None:
            raise EpisodeError(f"'{self._path}' ends before frame {number}")
        self._next, self._last = number + 1, found
        return found

    def _shown(self) -> Iterator[ByteArray]:
        with open_video(self._path) as video:
            for frame in video.frames():
                yield video.shown(frame)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameMatch:
    """Frames of a video that lie within the rows of a table.

    Attributes:
        numbers: (M,) numbers of the frames.
        times: (M,) times of the frames since the first row [s].
        note: rule of the match; empty where each row has one frame.
    """

    numbers: NDArray[np.int64]
    times: FloatArray
    note: str = ''


def match_frames(
    frame_times: FloatArray | None,
    count: int,
    row_times: FloatArray,
    *,
    rows_are_timed: bool,
    source: FrameTimes = 'auto',
) -> FrameMatch:
    """Match a video's frames to the rows of a table.

    Frame k belongs to row k where there are as many, unless the video has times of its own at an
    uneven rate. Otherwise frames keep the times of the video, counted from its first frame, which
    belongs to the first row.

    Args:
        frame_times: (N,) frame times in the file [s]; None = not known.
        count: number of frames, N.
        row_times: (T,) since the first row [s].
        rows_are_timed: whether each row has a time of its own, in place of a rate.
        source: `video` and `rows` choose the times of frames without looking at them.

    Raises:
        EpisodeError: number, rate and duration of frames and rows contradict each other.
    """
    if frame_times is None and source == 'video':
        raise EpisodeError("the video has no times that increase; set 'frame_times: rows'")
    if frame_times is None or source == 'rows' or min(count, len(row_times)) < 2:
        return _by_number(count, row_times)
    shown = frame_times - frame_times[0]
    _check_unit(shown, row_times)
    if source == 'video':
        return _by_time(shown, row_times)
    pair = _Rates.of(shown, row_times)
    if count == len(row_times):
        return _as_many(shown, row_times, pair, rows_are_timed)
    if pair.share_a_rate:
        return _by_number(count, row_times)
    if pair.share_a_span:
        return _by_time(shown, row_times)
    raise EpisodeError(
        f'{count} frames over {shown[-1]:.2f} s and {len(row_times)} rows over '
        f'{row_times[-1]:.2f} s have neither their number, their rate nor their duration in '
        "common; set 'frame_times' in the mapping: 'video' = frames keep the times of the video, "
        "'rows' = frame k belongs to row k"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rates:
    """Median distance of frames and of rows [s], and what both have in common."""

    frames_s: float
    rows_s: float
    share_a_rate: bool
    share_a_span: bool

    @classmethod
    def of(cls, shown: FloatArray, row_times: FloatArray) -> _Rates:
        frames_s, rows_s = (float(np.median(np.diff(times))) for times in (shown, row_times))
        # a frame and a row last one period
        spans = shown[-1] + frames_s, row_times[-1] + rows_s
        slack = max(_SAME_SPAN * max(spans), _SAME_SPAN_PERIODS * max(frames_s, rows_s))
        return cls(
            frames_s=frames_s,
            rows_s=rows_s,
            share_a_rate=abs(frames_s - rows_s) <= _SAME_RATE * rows_s,
            share_a_span=abs(spans[0] - spans[1]) <= slack,
        )


def _check_unit(shown: FloatArray, row_times: FloatArray) -> None:
    """Refuse times of rows that are not in seconds.

    Raises:
        EpisodeError: the rows last 1000 times as long as the video, or a power of that.
    """
    for unit, factor in _TIME_UNITS.items():
        if abs(row_times[-1] / shown[-1] / factor - 1) < _UNIT_TOLERANCE:
            raise EpisodeError(
                f'the rows last {row_times[-1]:.6g} s and the video {shown[-1]:.4g} s: times of '
                f"rows seem to be in {unit}; set 'time_unit: {unit}' in the mapping"
            )


def _as_many(
    shown: FloatArray, row_times: FloatArray, pair: _Rates, rows_are_timed: bool
) -> FrameMatch:
    """Match frames to as many rows."""
    is_even = np.abs(np.diff(shown) - pair.frames_s).max() <= _JITTER * pair.frames_s
    if not rows_are_timed or is_even or not pair.share_a_span:
        return _by_number(len(shown), row_times, _doubt(pair, shown, row_times))
    if np.abs(shown - row_times).max() <= _SAME_TIME * pair.rows_s:
        return _by_number(len(shown), row_times)
    return _by_time(shown, row_times)


def _doubt(pair: _Rates, shown: FloatArray, row_times: FloatArray) -> str:
    if pair.share_a_span:
        return ''
    return _as_many_text(shown, row_times)


def _as_many_text(shown: FloatArray, row_times: FloatArray) -> str:
    return (
        f'{len(shown)} frames last {shown[-1]:.2f} s by the video and {row_times[-1]:.2f} s by '
        'the rows: frame k is taken to belong to row k, as there are as many'
    )


def _by_number(count: int, row_times: FloatArray, note: str = '') -> FrameMatch:
    kept = min(count, len(row_times))
    if count != len(row_times):
        note = (
            f'{count} frames and {len(row_times)} rows: frame k is taken to belong to row k, and '
            'what is longer is left out'
        )
    return FrameMatch(numbers=np.arange(kept), times=row_times[:kept], note=note)


def _by_time(shown: FloatArray, row_times: FloatArray) -> FrameMatch:
    numbers = np.flatnonzero(shown <= row_times[-1] + 1e-9)
    left_out = len(shown) - len(numbers)
    note = (
        f'{len(shown)} frames over {shown[-1]:.2f} s and {len(row_times)} rows over '
        f'{row_times[-1]:.2f} s: frames keep the times of the video, from the first row on'
    )
    if left_out:
        note += f'; {left_out} frames after the last row are left out'
    return FrameMatch(numbers=numbers, times=shown[numbers], note=note)


def times_in_video(
    path: Path, times: FloatArray, tolerance_s: float, *, is_alone: bool
) -> tuple[FloatArray, str]:
    """Return the times (T,) in a video of the frames of rows [s], and how they were matched.

    The text is empty where each row has a frame at its time, or where no match is found.

    Args:
        path: path of the video file.
        times: increasing times of the rows in the file [s].
        tolerance_s: a frame may be this far from its row [s].
        is_alone: whether the file holds these rows and no others. As many frames as rows then
            belong to each other: frame k to row k, where the video has a rate in place of times.

    Raises:
        EpisodeError: see `open_video`.
    """
    offset_s = video_offset(path, times, tolerance_s, is_alone=is_alone)
    if offset_s:
        return times + offset_s, (
            f'its frames are {1000 * offset_s:+.1f} ms from the times of the rows, all alike; '
            'they were shifted onto the rows'
        )
    if not is_alone or len(times) < 2:
        return times, ''
    with open_video(path) as video:
        found = video.packet_times(-np.inf, np.inf)
    if len(found) != len(times) or np.abs(found - times).max() <= tolerance_s:
        return times, ''
    steps = np.diff(found)
    if np.abs(steps - np.median(steps)).max() > _JITTER * np.median(steps):
        return times, ''
    return found, _as_many_text(found - found[0], times - times[0])


def video_offset(path: Path, times: FloatArray, tolerance_s: float, *, is_alone: bool) -> float:
    """Return how much later the frames of a video are than (T,) times of rows, all alike [s].

    0 where the first row has a frame, or where no offset explains all rows: then `frames_at`
    names the first row without a frame.

    Args:
        path: path of the video file.
        times: increasing times of the rows in the file [s].
        tolerance_s: a frame may be this far from its row [s].
        is_alone: whether the file holds these rows and no others. As many frames as rows then
            belong to each other, however late they begin; else an offset is at most half a
            period, because the frames next to these are of another episode.

    Raises:
        EpisodeError: see `open_video`.
    """
    if len(times) < 2:
        return 0.0
    period_s = float(np.median(np.diff(times)))
    part = (-np.inf, np.inf) if is_alone else (times[0] - 2 * period_s, times[-1] + 2 * period_s)
    with open_video(path) as video:
        found = video.packet_times(*part)
    if not len(found) or np.abs(found - times[0]).min() <= tolerance_s:
        return 0.0
    offset_s, most_s = found[np.abs(found - times[0]).argmin()] - times[0], period_s / 2
    if is_alone and len(found) == len(times):
        offset_s, most_s = found[0] - times[0], np.inf
    if abs(offset_s) > most_s:
        return 0.0
    at = np.clip(np.searchsorted(found, times + offset_s), 1, len(found) - 1)
    distances = np.minimum(
        np.abs(found[at] - times - offset_s), np.abs(found[at - 1] - times - offset_s)
    )
    return float(offset_s) if distances.max() <= tolerance_s else 0.0


def frames_at(path: Path, times: FloatArray, tolerance_s: float) -> Iterator[ByteArray]:
    """Yield the (H, W, 3) RGB frame of a video at each of (T,) increasing times [s], in one pass.

    Raises:
        EpisodeError: the file is missing or damaged, or has no frame near enough to a time.
    """
    if len(times) == 0:
        return
    with open_video(path) as video:
        yield from _matched(video, path, times, tolerance_s)


def _matched(
    video: VideoStream, path: Path, times: FloatArray, tolerance_s: float
) -> Iterator[ByteArray]:
    if times[0] > tolerance_s:
        video.seek(times[0] - tolerance_s)
    wanted, last, seen = 0, float('nan'), 0
    for seen, frame in enumerate(video.frames(), 1):  # noqa: B007
        seconds = float('nan') if frame.time is None else float(frame.time)
        while wanted < len(times) and abs(seconds - times[wanted]) <= tolerance_s:
            yield video.shown(frame)
            wanted += 1
        if wanted == len(times):
            return
        if seconds > times[wanted] + tolerance_s:
            raise EpisodeError(
                f"video '{path}' has no frame at {times[wanted]:.4f} s: there is one at "
                f'{last:.4f} s and the next at {seconds:.4f} s'
                f'{_rates_differ(last, seconds, times)}'
            )
        last = seconds
    raise EpisodeError(
        f"video '{path}' ends at {last:.4f} s, but the data have a frame at "
        f'{times[wanted]:.4f} s ({len(times) - wanted} frames are missing)'
        f'{_as_many_but_shorter(seen, last, times)}'
    )


def _as_many_but_shorter(seen: int, last: float, times: FloatArray) -> str:
    """Return that a video has a frame for each row, at another rate; else nothing."""
    if seen != len(times) or len(times) < 2:
        return ''
    return (
        f': the video has {seen} frames, as many as there are rows, but its rate is '
        f'{(seen - 1) / max(last, 1e-9):.4g} a second and that of the rows '
        f'{(len(times) - 1) / (times[-1] - times[0]):.4g}; write the video with the rate of the '
        'data set'
    )


def _rates_differ(last: float, seconds: float, times: FloatArray) -> str:
    """Return the rates of frames and rows, where frames are further apart; else nothing."""
    if len(times) < 2 or not last < seconds:
        return ''
    period_s = float(np.median(np.diff(times)))
    if seconds - last < (1 + _SAME_RATE) * period_s:
        return ''
    return (
        f': frames are {seconds - last:.3f} s apart and rows {period_s:.3f} s; give the data set '
        'the rate of the video, or the video that of the rows'
    )
