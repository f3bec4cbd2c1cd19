"""Images: resized the same everywhere, encoded as JPEG and PNG, written as files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.files import write_whole


def resize_frames(frames: ByteArray, width: int, height: int) -> ByteArray:
    """Return (N, height, width, 3) frames; shrinking averages over areas."""
    if frames.shape[1:3] == (height, width):
        return frames
    shrinks = height <= frames.shape[1] and width <= frames.shape[2]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.stack([cv2.resize(f, (width, height), interpolation=method) for f in frames])


def resize_labels(labels: ByteArray, width: int, height: int) -> ByteArray:
    """Return (N, height, width) label images, nearest pixel."""
    if labels.shape[1:] == (height, width):
        return labels
    return np.stack(
        [cv2.resize(x, (width, height), interpolation=cv2.INTER_NEAREST_EXACT) for x in labels]
    )


def read_rgb(path: Path) -> ByteArray:
    """Return an image file as (H, W, 3) uint8 RGB.

    Raises:
        EpisodeError: there is no such file, or it is no image.
    """
    image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if image is None:
        what = 'is no image (PNG or JPEG)' if path.is_file() else 'is no file'
        raise EpisodeError(f"'{path}' {what}")
    return image[..., ::-1].astype(np.uint8)


def encode_jpeg(rgb: ByteArray, quality: int) -> bytes:
    """Return the JPEG file of an (H, W, 3) RGB image.

    Raises:
        EpisodeError: the image is too large.
    """
    return _encode('.jpg', rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])


def encode_png(image: ByteArray) -> bytes:
    """Return the PNG file of an (H, W, 3) RGB or (H, W) image.

    Raises:
        EpisodeError: the image has no pixels.
    """
    return _encode('.png', image[..., ::-1] if image.ndim == 3 else image, [])


def write_png(path: Path, image: ByteArray) -> None:
    """Write an (H, W, 3) RGB picture under a temporary name and rename it."""
    write_whole(path, encode_png(image))


def _encode(extension: str, image: ByteArray, options: list[int]) -> bytes:
    encoded, data = cv2.imencode(extension, np.ascontiguousarray(image), options)
    if not encoded:
        raise EpisodeError(f'an image of shape {image.shape} cannot be encoded as {extension}')
    return data.tobytes()
