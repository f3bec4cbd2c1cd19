"""The arms' links as lines from joint to joint, projected into a view.

Trails show where the tools are; how the arm stands behind them is left to the model, which in a
view that it does not know has nothing to go by. A arms, N points along one, T frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from mtv_world_ros.data_types import ByteArray, CameraModel, FloatArray
from mtv_world_ros.geometry.camera import project

#: a link is drawn in so many pieces, so that it bends with the lens and ends behind the camera
_PIECES = 4
#: fractional bits of pixel positions
_SHIFT = 4
#: lines nearer than this are as wide as at this depth [m]
_NEAREST_SIZE_M = 0.05
#: pieces that end further than this many image sizes away are left out
_FARTHEST = 4.0


class ArmLinks:
    """Lines along the arms in one view.

    Args:
        camera: the view.
        poses: (T, 4, 4) T_base_camera.
        arms: for each arm (N, T, 3) points along it, in the base frame [m].
        width_m: of the lines [m].
    """

    def __init__(
        self, camera: CameraModel, poses: FloatArray, arms: Sequence[FloatArray], width_m: float
    ) -> None:
        focal = (camera.K[0, 0] + camera.K[1, 1]) / 2
        size = np.array([camera.width, camera.height])
        self._pixels, self._widths = [], []
        for points in arms:
            pixels, depths = project(camera, poses, _in_pieces(points))
            far = np.any(np.abs(pixels - size / 2) > _FARTHEST * size, axis=-1, keepdims=True)
            self._pixels.append(np.where(far, np.nan, pixels))
            self._widths.append(width_m * focal / np.maximum(depths, _NEAREST_SIZE_M))

    def draw(self, image: ByteArray, arm: int, frame: int, colour: FloatArray) -> None:
        """Draws one arm onto an (H, W, 3) image; what is behind the camera is left out.

        Args:
            image: drawn upon.
            arm: which.
            frame: of the T.
            colour: (3,) RGB in 0 .. 1.
        """
        pixels, widths = self._pixels[arm][:, frame], self._widths[arm][:, frame]
        seen = np.isfinite(pixels).all(axis=-1)
        paint = [float(value) for value in np.rint(255 * colour)]
        ends = np.rint(np.where(seen[:, None], pixels, 0) * 2**_SHIFT).astype(int).tolist()
        for n in np.flatnonzero(seen[:-1] & seen[1:]):
            width = max(1, round(float(widths[n])))
            cv2.line(image, ends[n], ends[n + 1], paint, width, cv2.LINE_AA, _SHIFT)


def _in_pieces(points: FloatArray) -> FloatArray:
    """Points (N, T, 3) with those between them: (_PIECES * (N - 1) + 1, T, 3)."""
    shares = np.arange(_PIECES)[None, :, None, None] / _PIECES
    between = points[:-1, None] * (1 - shares) + points[1:, None] * shares
    return np.concatenate([between.reshape(-1, *points.shape[1:]), points[-1:]])
