"""Shape features of objects, from their masks in calibrated views.

V views, O objects, H W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mtv_world_ros.data_types import BoolArray, CameraModel, FloatArray
from mtv_world_ros.geometry.camera import unproject

#: numbers that describe an object in a view
NUM_FEATURES = 9
#: directions in the plane along which widths are measured
_ANGLES = np.arange(4) * np.pi / 4
#: share of a mask's pixels left out at either end of a width
_TAIL = 0.04
#: largest number of pixels of a mask that are used
_MAX_PIXELS = 600


def object_shapes(
    masks: BoolArray,
    points: FloatArray,
    cameras: Sequence[CameraModel],
    poses: Sequence[FloatArray],
) -> FloatArray:
    """Returns the (O, V, `NUM_FEATURES`) apparent shapes of objects whose centres are known.

    They are widths of the mask in the horizontal plane through the centre, along x, the diagonal,
    y and the other diagonal; its lowest and highest point in the vertical plane that faces the
    camera, from the centre [m]; unit vector to the camera. Zeros where the view does not see it.

    Args:
        masks: (V, O, H, W) of one frame.
        points: (O, 3) centres [m], NaN where not known.
        cameras: V cameras at the masks' size.
        poses: V of T_base_camera (4, 4).
    """
    num_views, num_objects = masks.shape[:2]
    features = np.zeros((num_objects, num_views, NUM_FEATURES))
    for view, (camera, pose) in enumerate(zip(cameras, poses, strict=True)):
        for item in range(num_objects):
            if np.isfinite(points[item]).all() and masks[view, item].any():
                features[item, view] = _features(masks[view, item], points[item], camera, pose)
    return features


def _features(
    mask: BoolArray, point: FloatArray, camera: CameraModel, pose: FloatArray
) -> FloatArray:
    rows, columns = np.nonzero(mask)
    every = max(1, len(rows) // _MAX_PIXELS)
    pixels = np.stack([columns[::every], rows[::every]], axis=1).astype(float)
    rays = unproject(camera, pixels) @ pose[:3, :3].T
    origin = pose[:3, 3]
    to_camera = origin - point
    out = np.zeros(NUM_FEATURES)
    out[6:] = to_camera / np.linalg.norm(to_camera)
    with np.errstate(divide='ignore', invalid='ignore'):
        flat = origin + rays * ((point[2] - origin[2]) / rays[:, 2])[:, None] - point
        facing = np.array([to_camera[0], to_camera[1], 0.0])
        upright = origin + rays * (-(facing @ to_camera) / (rays @ facing))[:, None] - point
    for number, angle in enumerate(_ANGLES):
        out[number] = _width(flat[:, :2] @ np.array([np.cos(angle), np.sin(angle)]))
    heights = upright[:, 2][np.isfinite(upright[:, 2])]
    if len(heights):
        out[4:6] = np.quantile(heights, (_TAIL, 1 - _TAIL))
    return np.clip(np.nan_to_num(out), -0.5, 1.0)


def _width(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    if not len(known):
        return 0.0
    low, high = np.quantile(known, (_TAIL, 1 - _TAIL))
    return float(high - low)
