"""Resizing of frames, the same in serving, training and evaluation."""

from __future__ import annotations

import cv2
import numpy as np

from mtv_world_ros.data_types import ByteArray


def resize_frames(frames: ByteArray, width: int, height: int) -> ByteArray:
    """Returns (N, height, width, 3) frames; shrinking averages over areas."""
    if frames.shape[1:3] == (height, width):
        return frames
    shrinks = height <= frames.shape[1] and width <= frames.shape[2]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.stack([cv2.resize(f, (width, height), interpolation=method) for f in frames])


def resize_labels(labels: ByteArray, width: int, height: int) -> ByteArray:
    """Returns (N, height, width) label images, nearest pixel."""
    if labels.shape[1:] == (height, width):
        return labels
    return np.stack(
        [cv2.resize(x, (width, height), interpolation=cv2.INTER_NEAREST_EXACT) for x in labels]
    )
