"""Video packets of ffmpeg_image_transport as frames: a packet an image, most are differences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import av
from av.video.codeccontext import VideoCodecContext
import numpy as np

from mtv_world_ros.core.bounded_input import check_limit, LimitError, limits
from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.core.errors import EpisodeError, ObservationError
from mtv_world_ros.data.episode import LazyFrames

FFMPEG_PACKET = 'ffmpeg_image_transport_msgs/msg/FFMPEGPacket'
#: as in ros-misc-utilities/ffmpeg_image_transport_msgs
FFMPEG_PACKET_DEFINITION = """std_msgs/Header header
int32 width
int32 height
string encoding
uint64 pts
uint8 flags
bool is_bigendian
uint8[] data
"""
#: flag of a packet that can be decoded without the ones before it
_KEY = 1
#: encoders that are named where the codec should be, and the decoders of what they write
_CODECS = {'libx264': 'h264', 'libx264rgb': 'h264', 'libx265': 'hevc', 'h265': 'hevc',
           'libsvtav1': 'av1', 'libaom-av1': 'av1', 'librav1e': 'av1', 'libvpx': 'vp8',
           'libvpx-vp9': 'vp9'}  # fmt: skip
_HARDWARE = ('_nvenc', '_vaapi', '_qsv', '_nvmpi', '_v4l2m2m', '_videotoolbox', '_omx')


def codec_of(encoding: str) -> str:
    """Return the decoder of a packet's `encoding`, e.g. `h264_nvenc` or `h264;yuv420p;bgr8`.

    Raises:
        ObservationError: no decoder is known for it.
    """
    name = encoding.split(';')[0].strip().lower()
    for suffix in _HARDWARE:
        name = name.removesuffix(suffix)
    name = _CODECS.get(name, name)
    try:
        av.Codec(name, 'r')
    except (av.FFmpegError, ValueError) as error:
        raise ObservationError(
            f"video packets of encoding '{encoding}' cannot be decoded ({error})"
        ) from error
    return name


def is_key(encoding: str, data: bytes) -> bool:
    """Return whether a packet can be decoded without the ones before it.

    Of H.264 and H.265 by the kinds of NAL units in Annex B, of VP9 and AV1 by their first header.
    """
    codec = codec_of(encoding)
    if codec in ('h264', 'hevc'):
        return any(_starts_anew(codec, kind) for kind in _nal_headers(data))
    if codec == 'vp9':
        return bool(data) and not data[0] & _VP9_INTER
    if codec == 'av1':
        return any(kind == _AV1_SEQUENCE for kind in _obu_kinds(data))
    return True


#: bit of a VP9 frame's first byte that is set in frames that need others
_VP9_INTER = 0x04
#: kinds of OBUs of AV1
_AV1_SEQUENCE, _AV1_DELIMITER = 1, 2
#: NAL units that are looked at in a packet
_MOST_UNITS = 64


def _nal_headers(data: bytes) -> Iterator[int]:
    """Yield the first byte of each NAL unit of a packet in Annex B."""
    at = -1
    for _ in range(_MOST_UNITS):
        at = data.find(b'\0\0\1', at + 1)
        if at < 0 or at + 3 >= len(data):
            return
        yield data[at + 3]


def _starts_anew(codec: str, header: int) -> bool:
    """Return whether a NAL unit is of an IDR frame (H.264) or a random access point (H.265)."""
    return header & 0x1F == 5 if codec == 'h264' else 16 <= header >> 1 & 0x3F <= 21


def _obu_kinds(data: bytes) -> Iterator[int]:
    """Yield the kinds of the first two OBUs; a delimiter has no content."""
    at = 0
    for _ in range(2):
        if at >= len(data):
            return
        yield (kind := data[at] >> 3 & 0x0F)
        if kind != _AV1_DELIMITER:
            return
        at += 2


def check_packet(message: Any) -> None:
    """Check the fields of an FFMPEGPacket.

    Raises:
        ObservationError: no such decoder, no data, or too large.
    """
    codec_of(message.encoding)
    if len(message.data) == 0:
        raise ObservationError('a video packet has no data')
    try:
        size = message.width * message.height
        check_limit('image_pixels', size, f'a video of {message.width}x{message.height}')
        check_limit('image_bytes', len(message.data), 'a video packet')
    except LimitError as error:
        raise ObservationError(str(error)) from error


def from_first_key(messages: Sequence[tuple[int, Any]]) -> list[tuple[int, Any]]:
    """Return the (stamp, packet) from the first one on that needs no other."""
    first = next((i for i, (_, m) in enumerate(messages) if m.flags & _KEY), len(messages))
    return list(messages[first:])


class VideoFrames(LazyFrames):
    """Frames of packets, decoded when asked for, in order best.

    Args:
        topic: topic of the packets, for error texts.
        packets: packets in the order of their stamps; the first one is a key frame.
    """

    def __init__(self, topic: str, packets: Sequence[Any]) -> None:
        self._topic, self._messages = topic, packets
        self._codec = codec_of(packets[0].encoding)
        self._keys = [i for i, packet in enumerate(packets) if packet.flags & _KEY]
        self._ahead: Iterator[tuple[int, ByteArray]] = iter(())
        self._last: tuple[int, ByteArray] | None = None

    def _frame(self, index: int) -> ByteArray:
        key = max(i for i in self._keys if i <= index)
        if self._last is None or not key <= self._last[0] <= index:
            self._ahead, self._last = self._decoded(key), None
        while self._last is None or self._last[0] < index:
            self._last = next(self._ahead, None)
            if self._last is None:
                break
        if self._last is None or self._last[0] != index:
            raise EpisodeError(f"'{self._topic}', frame {index}: its packet gives no image")
        return self._last[1]

    def _decoded(self, key: int) -> Iterator[tuple[int, ByteArray]]:
        """Yield number and image of the frames from a key frame on."""
        context = av.CodecContext.create(self._codec, 'r')
        assert isinstance(context, VideoCodecContext)
        # packets of some recorders do not say how large their pictures are
        context.options = {'max_pixels': str(limits().image_pixels)}
        try:
            for number in range(key, len(self._messages)):
                packet = av.Packet(bytes(self._messages[number].data))
                packet.pts = packet.dts = number
                yield from map(_numbered, context.decode(packet))
            yield from map(_numbered, context.decode(None))
        except av.FFmpegError as error:
            raise EpisodeError(f"'{self._topic}': a video packet is damaged ({error})") from error


def _numbered(frame: av.VideoFrame) -> tuple[int, ByteArray]:
    return int(frame.pts or 0), np.asarray(frame.to_ndarray(format='rgb24'), np.uint8)
