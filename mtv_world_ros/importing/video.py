"""Decodes the frames of a video at given times."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import av
from av.container import InputContainer
import numpy as np

from mtv_world_ros.data_types import ByteArray, FloatArray
from mtv_world_ros.errors import EpisodeError


def frames_at(path: Path, times: FloatArray, tolerance_s: float) -> Iterator[ByteArray]:
    """Yields the (H, W, 3) RGB frame at each of increasing times, in one pass.

    Args:
        path: video file.
        times: (T,) presentation times in the file [s], increasing.
        tolerance_s: largest distance of a frame from its time [s].

    Raises:
        EpisodeError: the file is missing or damaged, or has no frame at a time.
    """
    if len(times) == 0:
        return
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise EpisodeError(f"'{path}' holds no video")
            yield from _matched(container, path, times, tolerance_s)
    except (av.FFmpegError, OSError) as error:
        raise EpisodeError(f"video '{path}' cannot be read: {error}") from error


def _matched(
    container: InputContainer, path: Path, times: FloatArray, tolerance_s: float
) -> Iterator[ByteArray]:
    stream = container.streams.video[0]
    base = stream.time_base
    if base is not None and times[0] > tolerance_s:
        container.seek(int((times[0] - tolerance_s) / base), stream=stream, backward=True)
    wanted, last = 0, float('nan')
    for frame in container.decode(stream):
        seconds = float('nan') if frame.time is None else float(frame.time)
        while wanted < len(times) and abs(seconds - times[wanted]) <= tolerance_s:
            yield np.asarray(frame.to_ndarray(format='rgb24'), np.uint8)
            wanted += 1
        if wanted == len(times):
            return
        if seconds > times[wanted] + tolerance_s:
            raise EpisodeError(
                f"video '{path}' has no frame at {times[wanted]:.4f} s: there is one at "
                f'{last:.4f} s and the next at {seconds:.4f} s'
            )
        last = seconds
    raise EpisodeError(
        f"video '{path}' ends at {last:.4f} s, but the data have a frame at "
        f'{times[wanted]:.4f} s ({len(times) - wanted} frames are missing)'
    )
