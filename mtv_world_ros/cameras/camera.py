"""Calibrated cameras: projection with lens distortion, rescaling, triangulation.

Distortion models `plumb_bob` and `rational_polynomial` by the formula of OpenCV's calib3d page,
which sensor_msgs/CameraInfo refers to; its 14 coefficients are k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4
tau_x tau_y; missing ones are 0. `equidistant` is OpenCV's fisheye model, k1 k2 k3 k4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from mtv_world_ros.core.data_types import CameraModel, DISTORTION_MODELS, FloatArray
from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.core.transforms import inverse
from mtv_world_ros.robot.model import RobotModel

#: nearest depth that is projected [m]
MIN_DEPTH_M = 0.01
#: focal lengths of real lenses, in lengths of the image's longer side
_FOCAL_RANGE = (0.05, 100.0)
_MOST_PIXELS = 20_000
#: cameras are nearer to what carries them [m]
_FARTHEST_M = 100.0
_LARGEST_COEFFICIENT = 1e4
#: condition number above which rays count as parallel
_PARALLEL = 1e9


def check_mount(camera: CameraModel, robot: RobotModel) -> None:
    """Check that the robot's joints determine the pose of the link that carries a camera.

    Raises:
        CalibrationError: a joint carries it that is not among the robot's joints.
    """
    if camera.mount_link == robot.base_link:
        return
    unknown = robot.unknown_joints(camera.mount_link)
    if unknown:
        raise CalibrationError(
            f"the camera of view '{camera.view}' is on link '{camera.mount_link}', which joint "
            f"'{unknown[0]}' moves, and that is not among the joints of robot '{robot.name}': add "
            "it to 'joints' of the robot's YAML, take the pose from /tf, or give it in a link "
            'that the joint does not move'
        )


def camera_poses(camera: CameraModel, robot: RobotModel, positions: FloatArray) -> FloatArray:
    """Return T_base_camera (T, 4, 4) for positions (T, J); constant for a fixed camera.

    Raises:
        CalibrationError: a joint carries it that is not among the robot's joints.
    """
    if camera.mount_link == robot.base_link:
        return np.repeat(camera.T_mount_camera[None], len(positions), axis=0)
    check_mount(camera, robot)
    return robot.link_poses(camera.mount_link, positions) @ camera.T_mount_camera


def project(
    camera: CameraModel, T_base_camera: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Project points of the base frame into the image.

    Args:
        camera: intrinsics and distortion.
        T_base_camera: (4, 4), or (..., 4, 4) that broadcasts with the points.
        points: (..., 3) [m].

    Returns:
        Pixels (..., 2), pixel centres at integers, and depths (...) [m] along the optical axis.
        Pixels are NaN where the point is not in front of the camera, or at an angle to its axis
        where the distortion model would fold it back into the image.
    """
    return project_from(camera, inverse(np.asarray(T_base_camera, dtype=float)), points)


def project_from(
    camera: CameraModel, T_camera_base: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Project points as `project` does, by the inverse of the camera's pose.

    Args:
        camera: see `project`.
        T_camera_base: (4, 4), or (..., 4, 4) that broadcasts with the points.
        points: (..., 3) [m].
    """
    local = (T_camera_base[..., :3, :3] @ np.asarray(points, dtype=float)[..., None])[..., 0]
    local = local + T_camera_base[..., :3, 3]
    depth = local[..., 2]
    xy = local[..., :2] / np.where(depth > MIN_DEPTH_M, depth, np.nan)[..., None]
    if camera.distortion_model == 'equidistant':
        xy = fisheye(camera.distortion, xy)
    elif camera.distortion.any():
        xy = distort(camera.distortion, xy)
    return xy @ camera.K[:2, :2].T + camera.K[:2, 2], depth


def unproject(camera: CameraModel, pixels: FloatArray) -> FloatArray:
    """Return unit rays (..., 3) in the optical frame of pixels (..., 2).

    Rays are NaN where no point in front of the camera projects to the pixel.
    """
    offset = np.asarray(pixels, dtype=float) - camera.K[:2, 2]
    xy = offset @ np.linalg.inv(camera.K[:2, :2]).T
    if camera.distortion_model == 'equidistant':
        xy = unfisheye(camera.distortion, xy)
    elif camera.distortion.any():
        xy = undistort(camera.distortion, xy)
    rays = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def unknown_camera(view: str, width: int, height: int, mount_link: str) -> CameraModel:
    """Return a placeholder for an uncalibrated camera: a field of view of 80 degrees."""
    focal = 0.6 * width
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return CameraModel(
        view=view, width=width, height=height, K=K, mount_link=mount_link, T_mount_camera=np.eye(4)
    )


def scaled(camera: CameraModel, width: int, height: int) -> CameraModel:
    """Return the camera for its image resized to another size.

    fx, fy, cx, cy scale with the size as in ROS' image_proc resize, shifted by the half pixel
    that keeps pixel centres at integers. Scaling to the same size changes nothing.
    """
    if (camera.width, camera.height) == (width, height):
        return camera
    sx, sy = width / camera.width, height / camera.height
    S = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1.0]])
    error = None if camera.error_px is None else camera.error_px * sx
    return replace(camera, width=width, height=height, K=S @ camera.K, error_px=error)


def with_camera_info(
    camera: CameraModel,
    *,
    width: int,
    height: int,
    K: FloatArray,
    distortion_model: str,
    distortion: Sequence[float],
) -> CameraModel:
    """Return the camera with the intrinsics of a CameraInfo; its pose stays.

    Args:
        camera: the calibrated view.
        width: width of the images that the CameraInfo is for [px].
        height: height of the images [px].
        K: (3, 3) [px].
        distortion_model: name of the distortion model as in CameraInfo; ignored if all
            coefficients are zero, unless it is `equidistant`.
        distortion: coefficients; zeros beyond those of the model are ignored.

    Raises:
        CalibrationError: the CameraInfo is not calibrated, is of an unknown model, or contradicts
            itself (principal point outside the image).
    """
    coefficients = np.asarray(distortion, dtype=float)
    distortion_model = _SAME_MODEL.get(distortion_model, distortion_model)
    if not coefficients.any() and distortion_model != 'equidistant':
        distortion_model, coefficients = 'none', np.zeros(0)
    longest = max(DISTORTION_MODELS.get(distortion_model, (len(coefficients),)))
    if not coefficients[longest:].any():  # further zeros do not change the lens
        coefficients = coefficients[:longest]
    informed = replace(
        camera,
        width=width,
        height=height,
        K=np.asarray(K, dtype=float).reshape(3, 3),
        distortion_model=distortion_model,
        distortion=coefficients,
        error_px=None if camera.error_px is None else camera.error_px * width / camera.width,
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
    check_plausible(informed)
    _check_lens(informed)


def check_plausible(camera: CameraModel) -> None:
    """Check that intrinsics and pose can be those of a real camera.

    Raises:
        CalibrationError: focal lengths, a distortion or a mount that no camera has.
    """
    where = f"camera '{camera.view}'"
    size = np.array([camera.width, camera.height])
    focal = camera.K[[0, 1], [0, 1]]
    if (camera.width > _MOST_PIXELS) or (camera.height > _MOST_PIXELS):
        raise CalibrationError(f'{where} has a size of {size} px; at most {_MOST_PIXELS}')
    low, high = _FOCAL_RANGE
    if ((focal < low * size.max()) | (focal > high * size.max())).any():
        raise CalibrationError(
            f'{where} has focal lengths {focal.tolist()} px for images of {size[0]}x{size[1]}; '
            f'{low * size.max():g} to {high * size.max():g} px are those of real lenses'
        )
    if np.abs(camera.T_mount_camera[:3, 3]).max() > _FARTHEST_M:
        raise CalibrationError(
            f'{where} is {camera.T_mount_camera[:3, 3].tolist()} m from its mount; at most '
            f'{_FARTHEST_M:g} m (is the unit metres?)'
        )
    if (np.abs(camera.distortion) > _LARGEST_COEFFICIENT).any():
        raise CalibrationError(
            f'{where} has distortion coefficients {camera.distortion.tolist()}; no lens has any '
            f'above {_LARGEST_COEFFICIENT:g}'
        )


def _check_lens(camera: CameraModel) -> None:
    """Refuse a distortion that does not even show what lies around the middle of the image."""
    size = np.array([camera.width, camera.height])
    corners = (size - 1) * np.array([[x, y] for x in (0.25, 0.75) for y in (0.25, 0.75)])
    with np.errstate(all='ignore'):
        rays = unproject(camera, corners)
    if not np.isfinite(rays).all():
        raise CalibrationError(
            f"camera '{camera.view}' has distortion coefficients {camera.distortion.tolist()} of "
            f"'{camera.distortion_model}', which fold the middle of the image; calibrate again"
        )


def triangulate(
    cameras: Sequence[CameraModel], T_base_camera: Sequence[FloatArray], pixels: FloatArray
) -> tuple[FloatArray, float]:
    """Return the point (3,) [m] nearest to all views' rays, and the mean residual [px].

    Both are NaN where the rays are parallel or meet behind a camera.

    Args:
        cameras: two or more cameras (V).
        T_base_camera: poses (4, 4) of the cameras.
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


#: other names of distortion models in CameraInfo
_SAME_MODEL = {'fisheye': 'equidistant', 'kannala_brandt4': 'equidistant'}
#: no lens of these models sees farther from its axis than this at depth 1: 76 degrees
_WIDEST = 4.0
_NEWTON_STEPS = 12
#: largest error of an undistorted point, in normalised coordinates
_SOLVED = 1e-9


def distort(coefficients: FloatArray, xy: FloatArray) -> FloatArray:
    """Return where ideal points (..., 2) appear; NaN beyond the model's reach.

    A polynomial turns back at some radius, and points farther out would fold into the image.
    """
    k = _padded(coefficients)
    within = (xy**2).sum(-1) < _largest_r2(tuple(k))
    return np.where(within[..., None], _apply(k, xy), np.nan)


def fisheye(coefficients: FloatArray, xy: FloatArray) -> FloatArray:
    """Return where ideal points (..., 2) appear by the equidistant model; NaN beyond its reach.

    The distance from the axis is theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).
    """
    radius = np.linalg.norm(xy, axis=-1)
    theta = np.arctan(radius)
    within = theta < _largest_angle(tuple(coefficients))
    scale = np.where(radius > 1e-12, _bent(coefficients, theta) / np.maximum(radius, 1e-12), 1.0)
    return np.where(within[..., None], xy * scale[..., None], np.nan)


def unfisheye(coefficients: FloatArray, distorted: FloatArray) -> FloatArray:
    """Return the ideal points (..., 2) that appear at the distorted ones; NaN where none does."""
    radius = np.linalg.norm(distorted, axis=-1)
    angles = np.linspace(0.0, _largest_angle(tuple(coefficients)), 4001)
    theta = np.interp(radius, _bent(coefficients, angles), angles, right=np.nan)
    for _ in range(_NEWTON_STEPS):
        rise = np.polynomial.Polynomial(_odd(coefficients)).deriv()(theta)
        theta = theta - (_bent(coefficients, theta) - radius) / rise
    seen = theta < min(np.pi / 2 - 1e-3, angles[-1] + 1e-9)
    scale = np.where(radius > 1e-12, np.tan(theta) / np.maximum(radius, 1e-12), 1.0)
    return np.where(seen[..., None], distorted * scale[..., None], np.nan)


def _odd(coefficients: Sequence[float] | FloatArray) -> FloatArray:
    k1, k2, k3, k4 = coefficients
    return np.array([0, 1, 0, k1, 0, k2, 0, k3, 0, k4], float)


def _bent(coefficients: FloatArray, theta: FloatArray) -> FloatArray:
    return np.asarray(np.polynomial.Polynomial(_odd(coefficients))(theta), np.float64)


@lru_cache(maxsize=64)
def _largest_angle(coefficients: tuple[float, ...]) -> float:
    """Return the angle up to which the distorted radius grows with it [rad]."""
    theta = np.linspace(0.0, np.pi / 2, 4001)
    grows = np.diff(np.polynomial.Polynomial(_odd(coefficients))(theta)) > 0
    return float(theta[-1] if grows.all() else theta[np.argmin(grows)])


def undistort(coefficients: FloatArray, distorted: FloatArray) -> FloatArray:
    """Return the ideal points (..., 2) that appear at the distorted ones; NaN where none does.

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
    """Return the distorted coordinates of ideal ones (..., 2), real or complex."""
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
    """Return the squared radius up to which the distorted radius grows with the true one."""
    r = np.linspace(0.0, _WIDEST, 4001)
    with np.errstate(all='ignore'):
        grows = np.diff(r * _radial(np.array(coefficients), r * r)) > 0
    return float(r[np.argmin(grows)] ** 2) if not grows.all() else _WIDEST**2


def _tilt(xy: np.ndarray, tau_x: float, tau_y: float) -> np.ndarray:
    """Return the tilt of the sensor in OpenCV's 14-coefficient model."""
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
