"""Marks of the trajectory video that a model paints into imagined frames, and their removal."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mtv_world_ros.control.trajectory_video import arm_colour, FINGER_COLOURS
from mtv_world_ros.core.data_types import BoolArray, ByteArray, FloatArray


@dataclass(frozen=True)
class LeakSettings:
    """Thresholds of the colour of a mark, measured with random plans on the bundled checkpoint.

    Attributes:
        min_chroma: smallest distance of a colour from its grey [grey levels].
        min_cosine: smallest cosine between the chromas of a pixel and a mark.
        reach_px: distance from a drawn mark within which its colour is a leak, and from a colour
            of the start frames within which it is the scene's [px].
        max_own: number of pixels of the start frames up to which a colour is not the scene's.
        min_said: number of pixels of a chunk from which a remark is made.
    """

    min_chroma: float = 24.0
    min_cosine: float = 0.85
    reach_px: int = 3
    max_own: int = 3
    min_said: int = 50


_SETTINGS = LeakSettings()


def find_leaks(
    frames: ByteArray,
    marks: ByteArray,
    start_frames: ByteArray,
    objects: ByteArray | None,
    num_arms: int,
) -> BoolArray:
    """Return (V, T, H, W) which pixels of imagined frames have a mark's colour.

    Pixels near a drawn mark of that colour, where no object is drawn. A colour that the start
    frames have there belongs to the scene and is no leak: what is no object stands still.

    Args:
        frames: (V, T, H, W, 3) uint8 RGB imagined.
        marks: (V, T, H, W, 3) trajectory video of the same times.
        start_frames: (V, H, W, 3) frames that imagination starts from.
        objects: (V, 1 + T, H, W, 4) RGB and cover of the objects as they were drawn, the start
            first; None = none were drawn, and any colour of the start frames is the scene's.
        num_arms: number of arms, each with a colour of its own.
    """
    kernel = np.ones((2 * _SETTINGS.reach_px + 1,) * 2, np.uint8)
    covers = np.zeros((*frames.shape[:1], frames.shape[1] + 1, *frames.shape[2:4]), np.bool_)
    if objects is not None:
        covers = _dilated(objects[..., 3] > 0, np.ones((3, 3), np.uint8))
    leaks = np.zeros(frames.shape[:-1], np.bool_)
    fingers = FINGER_COLOURS[1:]  # the other one is white, which has no hue
    for colour in (*(arm_colour(arm, num_arms) for arm in range(num_arms)), *fingers):
        is_own = has_colour(start_frames, colour) & ~covers[:, 0]
        near = _dilated(has_colour(marks, colour), kernel)
        if is_own.sum() > _SETTINGS.max_own:
            if objects is None:
                continue
            near &= ~_dilated(is_own, kernel)[:, None]
        leaks |= has_colour(frames, colour) & near
    return leaks & ~covers[:, 1:]


def without_leaks(frames: ByteArray, leaks: BoolArray) -> ByteArray:
    """Return frames whose leaks have the grey of their brightness, as hands and fingers do."""
    if not leaks.any():
        return frames
    cleaned = frames.copy()
    cleaned[leaks] = np.rint(frames[leaks].mean(axis=-1, keepdims=True))
    return cleaned


def leak_remarks(leaks: BoolArray) -> tuple[str, ...]:
    """Return a remark on leaks (V, T, H, W) of a chunk; empty where there are few."""
    count = int(leaks.sum())
    if count < _SETTINGS.min_said:
        return ()
    text = (
        f'commands are unlike those of training: {count} pixels of the imagined frames had '
        'colours of the drawn marks, and are grey now'
    )
    return (text,)


def has_colour(pictures: ByteArray, colour: FloatArray) -> BoolArray:
    """Return which pixels (..., 3) have a colour's hue, whatever their brightness."""
    chroma = pictures.astype(np.float32)
    chroma -= chroma.mean(axis=-1, keepdims=True)
    size = np.linalg.norm(chroma, axis=-1)
    wanted = colour - colour.mean()
    along = chroma @ (wanted / np.linalg.norm(wanted)).astype(np.float32)
    return (size > _SETTINGS.min_chroma) & (along > _SETTINGS.min_cosine * size)


def _dilated(masks: BoolArray, kernel: ByteArray) -> BoolArray:
    """Return masks (..., H, W), each grown by a kernel."""
    flat = masks.reshape(-1, *masks.shape[-2:]).astype(np.uint8)
    return np.stack([cv2.dilate(mask, kernel) for mask in flat]).reshape(masks.shape) > 0
