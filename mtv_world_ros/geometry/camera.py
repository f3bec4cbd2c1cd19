"""Calibrated cameras: projection with distortion, rescaling, triangulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mtv_world_ros.data_types import CameraModel, FloatArray
from mtv_world_ros.errors import CalibrationError
from mtv_world_ros.geometry.distortion import distort, undistort
from mtv_world_ros.geometry.robot import RobotModel
from mtv_world_ros.geometry.transforms import inverse

#: nearest depth that is projected [m]
MIN_DEPTH_M = 0.01
#: condition number from which rays count as parallel
_PARALLEL = 1e9


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
        Pixels (..., 2), pixel centres at integers, and depths (...) [m] along the optical axis.
        Pixels are NaN where the point is not in front of the camera, or so far off its axis
        that the distortion model would fold it back into the image.
    """
    T_camera_base = inverse(np.asarray(T_base_camera, dtype=float))
    local = (T_camera_base[..., :3, :3] @ np.asarray(points, dtype=float)[..., None])[..., 0]
    local = local + T_camera_base[..., :3, 3]
    depth = local[..., 2]
    xy = local[..., :2] / np.where(depth > MIN_DEPTH_M, depth, np.nan)[..., None]
    if camera.distortion.any():
        xy = distort(camera.distortion, xy)
    return xy @ camera.K[:2, :2].T + camera.K[:2, 2], depth


def unproject(camera: CameraModel, pixels: FloatArray) -> FloatArray:
    """Returns unit rays (..., 3) in the optical frame of pixels (..., 2).

    Rays are NaN where no point in front of the camera projects to the pixel.
    """
    offset = np.asarray(pixels, dtype=float) - camera.K[:2, 2]
    xy = offset @ np.linalg.inv(camera.K[:2, :2]).T
    if camera.distortion.any():
        xy = undistort(camera.distortion, xy)
    rays = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


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

    Args:
        camera: the calibrated view.
        width: of the images that the CameraInfo is for [px].
        height: of the images [px].
        K: (3, 3) [px].
        distortion_model: as in CameraInfo; any name goes if all coefficients are zero.
        distortion: coefficients.

    Raises:
        CalibrationError: the CameraInfo is not calibrated, is of an unknown model, or contradicts
            itself (principal point outside the image).
    """
    coefficients = np.asarray(distortion, dtype=float)
    if not coefficients.any():
        distortion_model, coefficients = 'none', np.zeros(0)
    informed = replace(
        camera,
        width=width,
        height=height,
        K=np.asarray(K, dtype=float).reshape(3, 3),
        distortion_model=distortion_model,
        distortion=coefficients,
    )
    _check_consistent(informed)
    return informed


def _check_consistent(informed: CameraModel) -> None:
    size = np.array([informed.width, informed.height])
    centre = informed.K[:2, 2]
    if not np.array_equal(informed.K[2], (0, 0, 1)) or ((centre < 0) | (centre > size)).any():
        raise CalibrationError(
            f"camera_info of view '{informed.view}' contradicts itself: K = "
            f'{informed.K.tolist()} for images of {size[0]}x{size[1]} (is it for another image '
            'size?); its last row must be 0 0 1 and cx, cy inside the image'
        )


def triangulate(
    cameras: Sequence[CameraModel], T_base_camera: Sequence[FloatArray], pixels: FloatArray
) -> tuple[FloatArray, float]:
    """Returns the point (3,) [m] nearest to all views' rays, and the mean residual [px].

    Both are NaN where the rays are parallel or meet behind a camera.

    Args:
        cameras: V >= 2 cameras.
        T_base_camera: their poses (4, 4).
        pixels: (V, 2), the same point in each view.

    Raises:
        CalibrationError: fewer than two views.
    """
    if len(cameras) < 2:
        raise CalibrationError(f'a point needs two views to be triangulated, {len(cameras)} given')
    normal, target = np.zeros((3, 3)), np.zeros(3)
    for camera, T, pixel in zip(cameras, T_base_camera, pixels, strict=True):
        ray = T[:3, :3] @ unproject(camera, pixel)
        across = np.eye(3) - np.outer(ray, ray)
        normal += across
        target += across @ T[:3, 3]
    if not np.isfinite(normal).all() or np.linalg.cond(normal) > _PARALLEL:
        return np.full(3, np.nan), float('nan')
    point: FloatArray = np.linalg.solve(normal, target).astype(np.float64)
    residuals = [
        np.linalg.norm(project(camera, T, point)[0] - pixel)
        for camera, T, pixel in zip(cameras, T_base_camera, pixels, strict=True)
    ]
    residual = float(np.mean(residuals))
    if not np.isfinite(residual):
        point[:] = np.nan
    return point, residual
