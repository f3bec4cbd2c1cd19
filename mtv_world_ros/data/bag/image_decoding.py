"""Image messages as RGB arrays: raw encodings with padded rows, JPEG and PNG."""

from __future__ import annotations

import struct
from typing import Any
import zlib

import cv2
import numpy as np
from numpy.typing import NDArray
import simplejpeg

from mtv_world_ros.core.bounded_input import check_limit, LimitError
from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.core.errors import ObservationError
from mtv_world_ros.data.bag.jpeg_padding import is_only_padded

#: encodings of sensor_msgs/Image: bytes a pixel in a row, conversion to RGB (None = is RGB).
#: OpenCV names a Bayer pattern by its second row, and `yuv422` is ROS' older name of `uyvy`
ENCODINGS: dict[str, tuple[int, int | None]] = {
    'rgb8': (3, None),
    'bgr8': (3, cv2.COLOR_BGR2RGB),
    'rgba8': (4, cv2.COLOR_RGBA2RGB),
    'bgra8': (4, cv2.COLOR_BGRA2RGB),
    'mono8': (1, cv2.COLOR_GRAY2RGB),
    '8UC1': (1, cv2.COLOR_GRAY2RGB),
    '8UC3': (3, cv2.COLOR_BGR2RGB),
    'bayer_rggb8': (1, cv2.COLOR_BayerBG2RGB),
    'bayer_bggr8': (1, cv2.COLOR_BayerRG2RGB),
    'bayer_gbrg8': (1, cv2.COLOR_BayerGR2RGB),
    'bayer_grbg8': (1, cv2.COLOR_BayerGB2RGB),
    'mono16': (2, cv2.COLOR_GRAY2RGB),
    'rgb16': (6, None),
    'bgr16': (6, cv2.COLOR_BGR2RGB),
    'rgba16': (8, cv2.COLOR_RGBA2RGB),
    'bgra16': (8, cv2.COLOR_BGRA2RGB),
    'bayer_rggb16': (2, cv2.COLOR_BayerBG2RGB),
    'bayer_bggr16': (2, cv2.COLOR_BayerRG2RGB),
    'bayer_gbrg16': (2, cv2.COLOR_BayerGR2RGB),
    'bayer_grbg16': (2, cv2.COLOR_BayerGB2RGB),
    'uyvy': (2, cv2.COLOR_YUV2RGB_UYVY),
    'yuv422': (2, cv2.COLOR_YUV2RGB_UYVY),
    'yuyv': (2, cv2.COLOR_YUV2RGB_YUY2),
    'yuv422_yuy2': (2, cv2.COLOR_YUV2RGB_YUY2),
    'nv12': (1, cv2.COLOR_YUV2RGB_NV12),
    'nv21': (1, cv2.COLOR_YUV2RGB_NV21),
}
#: these have half as many rows again, of colours, below those of brightness
_PLANAR = ('nv12', 'nv21')
#: signatures at start and end of JPEG and PNG; decoders fill the rest of a cut file with grey
_PNG = b'\x89PNG'
_SIGNATURES = {b'\xff\xd8\xff': b'\xff\xd9', _PNG: b'IEND'}
#: JPEG marker of a scan
_SCAN = b'\xff\xda'
#: largest padding after the end: some cameras pad their files
_MAX_PADDING = 4096


def check_image(message: Any) -> None:
    """Check the fields of a sensor_msgs/Image or CompressedImage, without decoding it.

    Raises:
        ObservationError: see `check_raw` and `check_compressed`.
    """
    if _is_raw(message):
        check_raw(message)
    else:
        check_compressed(message.format, _bytes(message))


def check_decodable(message: Any) -> None:
    """Decode a JPEG of a sensor_msgs/CompressedImage, at an eighth of its size.

    Raises:
        ObservationError: the file is damaged.
    """
    if not _is_raw(message) and (data := _bytes(message))[:4].tobytes() != _PNG:
        _decode_jpeg(message.format, data, 'GRAY', min_height=1, min_width=1, min_factor=8)


def to_rgb(message: Any) -> ByteArray:
    """Return (H, W, 3) RGB of a sensor_msgs/Image or CompressedImage.

    Raises:
        ObservationError: see `raw_to_rgb` and `compressed_to_rgb`.
    """
    if _is_raw(message):
        return raw_to_rgb(message)
    return compressed_to_rgb(message.format, _bytes(message))


def to_ids(message: Any) -> ByteArray:
    """Return (H, W) object numbers of a sensor_msgs/Image (mono8) or CompressedImage.

    Raises:
        ObservationError: too little data, or see `compressed_to_ids`.
    """
    data = _bytes(message)
    if not _is_raw(message):
        return compressed_to_ids(message.format, data)
    if data.size != message.height * message.step:
        raise ObservationError(
            f'{data.size} bytes are no mask of {message.width}x{message.height}'
        )
    return data.reshape(message.height, message.step)[:, : message.width]


def _is_raw(message: Any) -> bool:
    return hasattr(message, 'step')


def _bytes(message: Any) -> NDArray[np.uint8]:
    return np.frombuffer(message.data, np.uint8)


def check_raw(message: Any) -> None:
    """Check the fields of a sensor_msgs/Image.

    Raises:
        ObservationError: unknown encoding, rows shorter than the width, or too little data.
    """
    encoding, step, num_bytes = message.encoding, message.step, len(message.data)
    height, width = message.height, message.width
    if encoding not in ENCODINGS:
        raise ObservationError(
            f"image encoding '{encoding}' is not supported; supported are {', '.join(ENCODINGS)}"
        )
    channels = ENCODINGS[encoding][0]
    try:
        check_limit('image_pixels', width * height, f'an image of {width}x{height}')
    except LimitError as error:
        raise ObservationError(str(error)) from error
    if height < 1 or width < 1 or step < channels * width:
        raise ObservationError(
            f'image of {width}x{height} {encoding} has a step of {step} bytes, expected at least '
            f'{channels * width}'
        )
    if encoding in (*_PLANAR, 'uyvy', 'yuv422', 'yuyv', 'yuv422_yuy2') and width % 2:
        raise ObservationError(f'image of {width}x{height} {encoding} needs an even width')
    needed = step * (_data_rows(encoding, height) - 1) + channels * width
    if num_bytes < needed:
        raise ObservationError(
            f'image of {width}x{height} {encoding} has {num_bytes} bytes, expected {needed}'
        )


def _data_rows(encoding: str, height: int) -> int:
    return height + (height + 1) // 2 if encoding in _PLANAR else height


def raw_to_rgb(message: Any) -> ByteArray:
    """Return (H, W, 3) RGB of a sensor_msgs/Image; of 16 bits the upper 8 are taken.

    Raises:
        ObservationError: an unknown encoding, or too little data; see `check_raw`.
    """
    check_raw(message)
    channels, conversion = ENCODINGS[message.encoding]
    num_rows, width = _data_rows(message.encoding, message.height), message.width
    rows = np.lib.stride_tricks.as_strided(
        _bytes(message), (num_rows, width * channels), (message.step, 1), writeable=False
    )
    if message.encoding.endswith('16'):
        rows = rows.reshape(num_rows, -1, 2)[..., 0 if message.is_bigendian else 1]
    image = np.array(rows).reshape(num_rows, width, -1)
    return image if conversion is None else np.asarray(cv2.cvtColor(image, conversion), np.uint8)


def check_compressed(layout: str, data: NDArray[np.uint8]) -> None:
    """Check the fields of a sensor_msgs/CompressedImage by the data's signature and header.

    Raises:
        ObservationError: neither a JPEG nor a PNG of 8 bits, whatever `format` says, or cut.
    """
    start = data[:4].tobytes()
    end = next((end for begin, end in _SIGNATURES.items() if start.startswith(begin)), None)
    if end is None:
        raise ObservationError(
            f"compressed image of format '{layout}' is not supported (it starts with "
            f'{start.hex() or "no data"}); supported are jpeg and png'
        )
    if end not in data[-_MAX_PADDING:].tobytes():
        raise ObservationError(
            f"compressed image of format '{layout}' ({len(data)} bytes) is cut off"
        )
    if '16UC1' in layout or '32FC1' in layout:
        raise ObservationError(
            f"compressed image of format '{layout}' holds depth; supported are 8-bit colours"
        )
    _check_size(layout, data)


def compressed_to_rgb(layout: str, data: NDArray[np.uint8]) -> ByteArray:
    """Return (H, W, 3) RGB of a sensor_msgs/CompressedImage.

    Raises:
        ObservationError: as `check_compressed`, or the file is damaged.
    """
    mosaic = layout.partition(';')[0].strip()
    if mosaic.startswith('bayer_') and mosaic in ENCODINGS:
        image = _decode(layout, data, cv2.IMREAD_UNCHANGED)
        if image.ndim == 2:  # image_transport compresses the mosaic as it is
            return np.asarray(cv2.cvtColor(image, ENCODINGS[mosaic][1] or 0), np.uint8)
    if data[:4].tobytes() != _PNG:
        check_compressed(layout, data)
        return _decode_jpeg(layout, data, 'RGB')
    bgr = _decode(layout, data, cv2.IMREAD_COLOR)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def compressed_to_ids(layout: str, data: NDArray[np.uint8]) -> ByteArray:
    """Return (H, W) values of a one-channel sensor_msgs/CompressedImage (object masks).

    Raises:
        ObservationError: as `compressed_to_rgb`, or it has another number of channels.
    """
    ids = _decode(layout, data, cv2.IMREAD_UNCHANGED)
    if ids.ndim != 2 or ids.dtype != np.uint8:
        raise ObservationError(
            f"mask of format '{layout}' is {ids.shape} {ids.dtype}, expected (H, W) uint8"
        )
    return np.asarray(ids, np.uint8)


def _decode(layout: str, data: NDArray[np.uint8], mode: int) -> NDArray[Any]:
    check_compressed(layout, data)
    if data[:4].tobytes() != _PNG:
        _decode_jpeg(layout, data, 'RGB')
    image = cv2.imdecode(data, mode | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise _damaged(layout, data)
    return image


def _decode_jpeg(layout: str, data: NDArray[np.uint8], colours: str, **size: Any) -> ByteArray:
    """Return (H, W, C) pixels; a decoder's warning that data are missing counts as damage."""
    content = data.tobytes()
    try:
        return simplejpeg.decode_jpeg(content, colours, **size)
    except ValueError as error:
        if is_only_padded(content, str(error)):
            return simplejpeg.decode_jpeg(content, colours, strict=False, **size)
        raise _damaged(layout, data, f': {error}') from error


def _damaged(layout: str, data: NDArray[np.uint8], why: str = '') -> ObservationError:
    return ObservationError(
        f"compressed image of format '{layout}' ({len(data)} bytes) is damaged{why}"
    )


def _check_size(layout: str, data: NDArray[np.uint8]) -> None:
    """Read width and height from the file's header, before anything is decoded."""
    try:
        check_limit('image_bytes', len(data), 'the file')
        content = data.tobytes()
        if content.startswith(_PNG):
            width, height = _png_size(content)
        else:
            height, width = map(int, simplejpeg.decode_jpeg_header(content)[:2])
        check_limit('image_pixels', width * height, f'an image of {width}x{height}')
        if not content.startswith(_PNG):
            check_limit('jpeg_scans', content.count(_SCAN), 'the file')
    except LimitError as error:
        raise ObservationError(f"compressed image of format '{layout}': {error}") from error
    except (struct.error, IndexError, ValueError) as error:
        raise _damaged(layout, data, ': it has no header') from error


def _png_size(content: bytes) -> tuple[int, int]:
    """Return the width and height [px].

    IndexError where a part of the file does not match its checksum.
    """
    position, kind = 8, b''
    while kind != b'IEND':
        length, kind = struct.unpack_from('>I4s', content, position)
        end = position + 8 + length
        (crc,) = struct.unpack_from('>I', content, end)
        if zlib.crc32(content[position + 4 : end]) != crc:
            raise IndexError(kind)
        position = end + 4
    return struct.unpack_from('>II', content, 16)
