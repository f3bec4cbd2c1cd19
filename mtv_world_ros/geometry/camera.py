"""Calibrated cameras: projection with distortion, rescaling, triangulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from mtv_world_ros.data_types import CameraModel, FloatArray
from mtv_world_ros.errors import CalibrationError
from mtv_world_ros.geometry.robot import RobotModel
from mtv_world_ros.geometry.transforms import inverse

#: nearest depth that is projected [m]
MIN_DEPTH_M = 0.01


def camera_poses(camera: CameraModel, robot: RobotModel, positions: FloatArray) -> FloatArray:
    """Returns T_base_camera (T, 4, 4) for positions (T, J); constant for a fixed camera."""
    if camera.mount_link == robot.base_link:
        return np.repeat(camera.T_mount_camera[None], len(positions), axis=0)
    return robot.link_poses(camera.mount_link, positions) @ camera.T_mount_camera


def project(
    camera: CameraModel, T_base_camera: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Projects points of the base frame into the image.

    Args:
        camera: intrinsics and distortion.
        T_base_camera: (4, 4), or (..., 4, 4) that broadcasts with the points.
        points: (..., 3) [m].

    Returns:
        Pixels (..., 2), pixel centres at integers, NaN where the point is not in front of the
        camera, and depths (...) [m] along the optical axis.
    """
    T_camera_base = inverse(np.asarray(T_base_camera, dtype=float))
    local = np.einsum('...ij,...j->...i', T_camera_base[..., :3, :3], points)
    local = local + T_camera_base[..., :3, 3]
    depth = local[..., 2]
    front = depth > MIN_DEPTH_M
    safe = np.where(front, depth, 1.0)
    xy = _distort(camera, local[..., :2] / safe[..., None])
    pixels = xy @ camera.K[:2, :2].T + camera.K[:2, 2]
    return np.where(front[..., None], pixels, np.nan), depth


def _distort(camera: CameraModel, xy: FloatArray) -> FloatArray:
    """Normalised image coordinates with `plumb_bob` or `rational_polynomial` distortion.

    Outside the radius up to which the model is monotonic a far point would fold back into the
    image; such points are pushed out to infinity.
    """
    if camera.distortion_model == 'none' or not np.any(camera.distortion):
        return xy
    k = np.zeros(14)
    k[: len(camera.distortion)] = camera.distortion
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = _radial(k, r2)
    out = np.empty_like(xy)
    prism = (k[8] + k[9] * r2) * r2, (k[10] + k[11] * r2) * r2
    out[..., 0] = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x) + prism[0]
    out[..., 1] = y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y + prism[1]
    if np.any(k[12:14]):
        out = _tilt(out, k[12], k[13])
    folded = r2 > _largest_r2(k)
    out[folded] = xy[folded] * 1e3
    return out


def _radial(k: FloatArray, r2: FloatArray) -> FloatArray:
    top = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    return top / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))


def _largest_r2(k: FloatArray) -> float:
    """Squared radius up to which the distorted radius grows with the true one."""
    r = np.linspace(0.0, 4.0, 2001)
    distorted = r * _radial(k, r * r)
    falls = np.diff(distorted) <= 0
    return float(r[np.argmax(falls)] ** 2) if falls.any() else np.inf


def _tilt(xy: FloatArray, tau_x: float, tau_y: float) -> FloatArray:
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


def scaled(camera: CameraModel, width: int, height: int) -> CameraModel:
    """Returns the camera for its image resized to another size.

    fx, fy, cx, cy scale with the size as in ROS' image_proc resize, shifted by the half pixel
    that keeps pixel centres at integers. Scaling to the size it has changes nothing.
    """
    if (camera.width, camera.height) == (width, height):
        return camera
    sx, sy = width / camera.width, height / camera.height
    S = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1.0]])
    return replace(camera, width=width, height=height, K=S @ camera.K)


def with_camera_info(
    camera: CameraModel,
    *,
    width: int,
    height: int,
    K: FloatArray,
    distortion_model: str,
    distortion: Sequence[float],
) -> CameraModel:
    """Returns the camera with the intrinsics of a CameraInfo; its pose stays.

    Raises:
        CalibrationError: the CameraInfo is not calibrated or of an unknown model.
    """
    coefficients = np.asarray(distortion, dtype=float)
    if not coefficients.any():
        distortion_model, coefficients = 'none', np.zeros(0)
    return replace(
        camera,
        width=width,
        height=height,
        K=np.asarray(K, dtype=float).reshape(3, 3),
        distortion_model=distortion_model,
        distortion=coefficients,
    )


def unproject(camera: CameraModel, pixels: FloatArray) -> FloatArray:
    """Returns unit rays (..., 3) in the optical frame of pixels (..., 2)."""
    flat = np.asarray(pixels, dtype=float).reshape(-1, 1, 2)
    coefficients = camera.distortion if len(camera.distortion) else None
    xy = cv2.undistortPoints(flat, camera.K, coefficients).reshape(-1, 2)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays.reshape(*np.shape(pixels)[:-1], 3)


def triangulate(
    cameras: Sequence[CameraModel], T_base_camera: Sequence[FloatArray], pixels: FloatArray
) -> tuple[FloatArray, float]:
    """Returns the point (3,) [m] nearest to all views' rays, and the mean residual [px].

    Args:
        cameras: V >= 2 cameras.
        T_base_camera: their poses (4, 4).
        pixels: (V, 2), the same point in each view.

    Raises:
        CalibrationError: fewer than two views, or all rays are parallel.
    """
    if len(cameras) < 2:
        raise CalibrationError('a point needs two views to be triangulated')
    A, b = np.zeros((3, 3)), np.zeros(3)
    for camera, T, pixel in zip(cameras, T_base_camera, pixels, strict=True):
        ray = T[:3, :3] @ unproject(camera, pixel)
        across = np.eye(3) - np.outer(ray, ray)
        A += across
        b += across @ T[:3, 3]
    if np.linalg.cond(A) > 1e9:
        raise CalibrationError('the views look along parallel rays; they give no depth')
    point = np.linalg.solve(A, b)
    errors = [
        np.linalg.norm(project(camera, T, point)[0] - pixel)
        for camera, T, pixel in zip(cameras, T_base_camera, pixels, strict=True)
    ]
    return point, float(np.mean(errors))
