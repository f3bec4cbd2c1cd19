"""Frames to H.264 in MP4 and back, in memory."""

from __future__ import annotations

from fractions import Fraction
import io

import av
import numpy as np

from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.errors import EpisodeError


def encode_video(
    frames: ByteArray,
    fps: float,
    *,
    crf: int = 20,
    full_colour: bool = False,
) -> bytes:
    """Returns an MP4 file of (T, H, W, 3) uint8 RGB frames.

    Args:
        frames: what to show; of even size unless `full_colour`.
        fps: frames a second.
        crf: quality, 0 best to 51 worst.
        full_colour: keep colour at every pixel (4:4:4), which not every browser plays.
    """
    rate = Fraction(fps).limit_denominator(1000)
    # one thread: with several, the same frames once gave another file on a busy machine
    options = {'crf': str(crf), 'preset': 'veryfast', 'threads': '1'}
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
    """Returns the (T, H, W, 3) uint8 RGB frames of a video file's bytes.

    Raises:
        EpisodeError: they are no video.
    """
    try:
        with av.open(io.BytesIO(data), 'r') as container:
            frames = [frame.to_ndarray(format='rgb24') for frame in container.decode(video=0)]
    except (av.FFmpegError, IndexError) as error:
        raise EpisodeError(f'{len(data)} bytes cannot be read as a video: {error}') from error
    return np.asarray(frames, np.uint8) if frames else np.zeros((0, 0, 0, 3), np.uint8)
