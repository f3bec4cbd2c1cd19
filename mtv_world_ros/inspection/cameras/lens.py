"""A lens that differs from that of a given camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mtv_world_ros.core.data_types import CameraModel, FloatArray


def with_lens(camera: CameraModel, lens: FloatArray) -> CameraModel:
    """Return the camera with another lens.

    Args:
        camera: camera with the lens that `lens` changes.
        lens: (3,) logarithms of factors of fx and of fy / fx, and what is added to k1.
    """
    K = camera.K.copy()
    K[:2, :2] *= np.exp([lens[0], lens[0] + lens[1]])[:, None]
    if not lens[2]:
        return replace(camera, K=K)
    distortion = np.zeros(max(5, len(camera.distortion)))
    distortion[: len(camera.distortion)] = camera.distortion
    distortion[0] += lens[2]
    model = 'plumb_bob' if camera.distortion_model == 'none' else camera.distortion_model
    return replace(camera, K=K, distortion_model=model, distortion=distortion)
