"""Image messages as RGB arrays: raw encodings with padded rows, JPEG and PNG."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.errors import ObservationError

#: encodings of sensor_msgs/Image: number of channels, conversion to RGB (None = is RGB)
ENCODINGS: dict[str, tuple[int, int | None]] = {
    'rgb8': (3, None),
    'bgr8': (3, cv2.COLOR_BGR2RGB),
    'rgba8': (4, cv2.COLOR_RGBA2RGB),
    'bgra8': (4, cv2.COLOR_BGRA2RGB),
    'mono8': (1, cv2.COLOR_GRAY2RGB),
}
#: signatures at start and end of JPEG and PNG; decoders fill the rest of a cut file with grey
_SIGNATURES = {b'\xff\xd8\xff': b'\xff\xd9', b'\x89PNG': b'IEND'}
#: largest padding after the end: some cameras pad their files
_MAX_PADDING = 4096


def check_raw(*, encoding: str, height: int, width: int, step: int, num_bytes: int) -> None:
    """Checks the fields of a sensor_msgs/Image.

    Raises:
        ObservationError: unknown encoding, rows shorter than the width, or too little data.
    """
    if encoding not in ENCODINGS:
        raise ObservationError(
            f"image encoding '{encoding}' is not supported; supported are {', '.join(ENCODINGS)}"
        )
    channels = ENCODINGS[encoding][0]
    if height < 1 or width < 1 or step < channels * width:
        raise ObservationError(
            f'image of {width}x{height} {encoding} has a step of {step} bytes, expected at least '
            f'{channels * width}'
        )
    needed = step * (height - 1) + channels * width
    if num_bytes < needed:
        raise ObservationError(
            f'image of {width}x{height} {encoding} has {num_bytes} bytes, expected {needed}'
        )


def raw_to_rgb(
    data: NDArray[np.uint8], *, encoding: str, height: int, width: int, step: int
) -> ByteArray:
    """(H, W, 3) RGB of the fields of a sensor_msgs/Image; `data` is flat uint8.

    Raises:
        ObservationError: as `check_raw`.
    """
    check_raw(encoding=encoding, height=height, width=width, step=step, num_bytes=len(data))
    channels, conversion = ENCODINGS[encoding]
    rows = np.lib.stride_tricks.as_strided(
        data, (height, width * channels), (step, 1), writeable=False
    )
    image = np.array(rows).reshape(height, width, channels)
    return image if conversion is None else np.asarray(cv2.cvtColor(image, conversion), np.uint8)


def check_compressed(layout: str, data: NDArray[np.uint8]) -> None:
    """Checks the fields of a sensor_msgs/CompressedImage by the data's signature.

    Args:
        layout: the message's `format`, e.g. `rgb8; jpeg compressed bgr8`.
        data: flat uint8.

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


def compressed_to_rgb(layout: str, data: NDArray[np.uint8]) -> ByteArray:
    """(H, W, 3) RGB of a sensor_msgs/CompressedImage.

    Raises:
        ObservationError: as `check_compressed`, or the file is damaged.
    """
    bgr = _decode(layout, data, cv2.IMREAD_COLOR)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def compressed_to_ids(layout: str, data: NDArray[np.uint8]) -> ByteArray:
    """(H, W) values of a one-channel sensor_msgs/CompressedImage (object masks).

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
    image = cv2.imdecode(data, mode | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise ObservationError(
            f"compressed image of format '{layout}' ({len(data)} bytes) is damaged"
        )
    return image
