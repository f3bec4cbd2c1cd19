"""Rigid poses (4, 4): from quaternions, directions and Denavit-Hartenberg rows, inverted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from mtv_world_ros.core.data_types import FloatArray


def rotation(quaternion_xyzw: Sequence[float] | FloatArray) -> FloatArray:
    """Return the (3, 3) rotation of a quaternion (x, y, z, w) of any length but zero.

    Raises:
        ValueError: not four finite numbers, or all zero.
    """
    quaternion = np.array(quaternion_xyzw, dtype=float)
    length = np.linalg.norm(quaternion)
    if quaternion.shape != (4,) or not np.isfinite(length) or length < 1e-9:
        raise ValueError(f'{quaternion_xyzw!r} is no quaternion: give x, y, z, w, not all zero')
    return np.asarray(pin.Quaternion(quaternion / length).toRotationMatrix())


def quaternion(R: FloatArray) -> FloatArray:
    """Return the unit quaternion (x, y, z, w) of a rotation (3, 3)."""
    return np.asarray(pin.Quaternion(np.asarray(R, dtype=float)).coeffs())


def about_z(angle: float) -> FloatArray:
    """Return the (3, 3) rotation by an angle [rad] about z."""
    return np.asarray(pin.utils.rotate('z', angle))


def pose(
    position: Sequence[float] | FloatArray, quaternion_xyzw: Sequence[float] | FloatArray
) -> FloatArray:
    """Return the (4, 4) pose of a position [m] and a quaternion (x, y, z, w).

    Raises:
        ValueError: not three finite numbers, or no quaternion.
    """
    place = np.array(position, dtype=float)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise ValueError(f'{position!r} is no position: give x, y, z [m]')
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation(quaternion_xyzw), place
    return T


def looking_along(ahead: FloatArray) -> FloatArray:
    """Return the (3, 3) rotation of an upright camera: x right, y down, z along `ahead`."""
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead], axis=1)


def denavit_hartenberg(a: float, alpha: float, d: float, theta: float) -> FloatArray:
    """Return Rz(theta) Tz(d) Tx(a) Rx(alpha), the standard convention's (4, 4) [m, rad].

    Source: B. Siciliano et al., Robotics, 2.8.2.
    """
    (ca, ct), (sa, st) = np.cos((alpha, theta)), np.sin((alpha, theta))
    return np.array(
        [
            [ct, -st * ca, st * sa, a * ct],
            [st, ct * ca, -ct * sa, a * st],
            [0.0, sa, ca, d],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def inverse(T: FloatArray) -> FloatArray:
    """Return the inverses (..., 4, 4) of rigid poses (..., 4, 4)."""
    transposed = np.swapaxes(T[..., :3, :3], -1, -2)
    result = np.zeros_like(T)
    result[..., :3, :3] = transposed
    result[..., :3, 3] = -(transposed @ T[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def is_rigid(T: FloatArray) -> bool:
    """Return whether a (4, 4) matrix is a right-handed rotation (to 1e-4) and a translation."""
    turn = T[:3, :3]
    return bool(
        np.isfinite(T).all()
        and np.allclose(turn @ turn.T, np.eye(3), atol=1e-4)
        and np.linalg.det(turn) > 0
        and np.allclose(T[3], (0, 0, 0, 1))
    )
