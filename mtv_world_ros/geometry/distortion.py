"""Lens distortion in normalised coordinates: `plumb_bob` and `rational_polynomial`.

The formula of OpenCV's calib3d page, which sensor_msgs/CameraInfo refers to; its 14 coefficients
are k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y, those left out are 0.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from mtv_world_ros.data_types import FloatArray

#: no lens of these models sees farther from its axis than this at depth 1: 76 degrees
_WIDEST = 4.0
_NEWTON_STEPS = 12
#: largest error of an undistorted point, in normalised coordinates
_SOLVED = 1e-9


def distort(coefficients: FloatArray, xy: FloatArray) -> FloatArray:
    """Returns where ideal points (..., 2) appear; NaN beyond the model's reach.

    A polynomial turns back at some radius, and points farther out would fold into the image.
    """
    k = _padded(coefficients)
    within = (xy**2).sum(-1) < _largest_r2(tuple(k))
    return np.where(within[..., None], _apply(k, xy), np.nan)


def undistort(coefficients: FloatArray, distorted: FloatArray) -> FloatArray:
    """Returns the ideal points (..., 2) that appear at the distorted ones; NaN where none does.

    Newton's method; the derivatives come from complex steps, which lose no digits.
    """
    k, xy, step = _padded(coefficients), distorted.copy(), 1e-30
    with np.errstate(all='ignore'):
        for _ in range(_NEWTON_STEPS):
            u, v = np.moveaxis(_apply(k, xy) - distorted, -1, 0)
            a, c = np.moveaxis(np.imag(_apply(k, xy + np.array([step * 1j, 0]))) / step, -1, 0)
            b, d = np.moveaxis(np.imag(_apply(k, xy + np.array([0, step * 1j]))) / step, -1, 0)
            change = np.stack([d * u - b * v, a * v - c * u], axis=-1)
            xy = xy - change / (a * d - b * c)[..., None]
        solved = np.abs(_apply(k, xy) - distorted).max(axis=-1) < _SOLVED
        solved &= (xy**2).sum(-1) < _largest_r2(tuple(k))
    return np.where(solved[..., None], xy, np.nan)


def _padded(coefficients: FloatArray) -> FloatArray:
    k = np.zeros(14)
    k[: len(coefficients)] = coefficients
    return k


def _apply(k: FloatArray, xy: np.ndarray) -> np.ndarray:
    """Distorted from ideal coordinates (..., 2), real or complex."""
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = _radial(k, r2)
    distorted = np.stack(
        [
            x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x) + (k[8] + k[9] * r2) * r2,
            y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y + (k[10] + k[11] * r2) * r2,
        ],
        axis=-1,
    )
    return _tilt(distorted, k[12], k[13]) if k[12:].any() else distorted


def _radial(k: FloatArray, r2: np.ndarray) -> np.ndarray:
    top = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    return top / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))


@lru_cache(maxsize=64)
def _largest_r2(coefficients: tuple[float, ...]) -> float:
    """Squared radius up to which the distorted radius grows with the true one."""
    r = np.linspace(0.0, _WIDEST, 4001)
    with np.errstate(all='ignore'):
        grows = np.diff(r * _radial(np.array(coefficients), r * r)) > 0
    return float(r[np.argmin(grows)] ** 2) if not grows.all() else _WIDEST**2


def _tilt(xy: np.ndarray, tau_x: float, tau_y: float) -> np.ndarray:
    """The tilted sensor of OpenCV's 14-coefficient model."""
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    rotation = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array(
        [[1, 0, 0], [0, cx, sx], [0, -sx, cx]]
    )
    shift = np.array(
        [
            [rotation[2, 2], 0, -rotation[0, 2]],
            [0, rotation[2, 2], -rotation[1, 2]],
            [0, 0, 1],
        ]
    )
    homogeneous = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
    tilted = homogeneous @ (shift @ rotation).T
    return tilted[..., :2] / tilted[..., 2:]
