"""Estimated camera poses: how they are changed, compared, and how uncertain they are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from mtv_world_ros.cameras.camera import scaled
from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray
from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.data.episode import Track
from mtv_world_ros.inspection.clocks import JointTrack

#: turns [rad] and shifts [m] that change the picture about alike
UNITS = np.array([0.01] * 3 + [0.005] * 3)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraEstimate:
    """An estimated pose.

    Attributes:
        camera: camera with the estimated pose, at the size of the recorded images.
        std_mm: standard error of the camera's place [mm].
        std_deg: standard error of its direction and roll [degrees].
        evidence: data of the estimate and its residuals, as text.
        residual_px: median distance of points from where they should be; NaN of silhouettes.
        match: correlation of drawn and seen motion, -1 .. 1; NaN of points.
    """

    camera: CameraModel
    std_mm: float
    std_deg: float
    evidence: str
    residual_px: float = float('nan')
    match: float = float('nan')


def displaced_pose(T: FloatArray, parameters: FloatArray, centre: FloatArray) -> FloatArray:
    """Return a pose (4, 4) turned about a point by (3,) [rad] and shifted by (3,) [m].

    Turns and shifts are along the pose's own axes. Turned about what a camera looks at, its
    picture hardly shifts, so that the parameters act on their own.
    """
    middle = T.copy()
    middle[:3, 3] = centre
    change = np.eye(4)
    change[:3, :3] = cv2.Rodrigues(np.asarray(parameters[:3], float))[0]
    change[:3, 3] = parameters[3:]
    return middle @ change @ np.linalg.inv(middle) @ T


def with_pose(camera: CameraModel, T_mount_camera: FloatArray) -> CameraModel:
    """Return the camera elsewhere."""
    return replace(camera, T_mount_camera=T_mount_camera)


def shrunk_camera(camera: CameraModel, width: int) -> CameraModel:
    """Return the camera for images of at most a width."""
    if camera.width <= width:
        return camera
    return scaled(camera, width, max(1, round(camera.height * width / camera.width)))


def grey_image(frame: ByteArray, camera: CameraModel) -> ByteArray:
    """Return the grey image (H, W) uint8 at the camera's size."""
    size = (camera.width, camera.height)
    return np.asarray(
        cv2.cvtColor(cv2.resize(frame, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY),
        np.uint8,
    )


def covered_frames(track: Track, joints: JointTrack) -> np.ndarray:
    """Return the indices of the frames within the joint states.

    Raises:
        CalibrationError: there are fewer than ten.
    """
    indices = np.flatnonzero(joints.covers(track.stamps_ns))
    if len(indices) < 10:
        raise CalibrationError(
            f'only {len(indices)} frames are within the joint states; at least 10 are needed'
        )
    return indices


def left_out(total: FloatArray, normal: FloatArray, gradient: FloatArray) -> FloatArray:
    """Return (6,) how a pose changes without some measurements: turns [rad], shifts [m].

    One step of Gauss and Newton from the pose that was estimated from all.

    Args:
        total: (6, 6) normal matrix of all measurements, in `UNITS`.
        normal: (6, 6) normal matrix of those left out.
        gradient: (6,) gradient of those left out.
    """
    ridge = 1e-6 * np.trace(total) * np.eye(6)
    return np.asarray(np.linalg.solve(total - normal + ridge, gradient) * UNITS, np.float64)


def jackknife_errors(changes: FloatArray) -> tuple[float, float]:
    """Jackknife standard errors [mm, degrees] of changes (G, 6): turns [rad], shifts [m].

    Each change is by leaving out one of G groups.
    """
    factor = (len(changes) - 1) / len(changes)
    variances = factor * ((changes - changes.mean(axis=0)) ** 2).sum(axis=0)
    turn, shift = (float(np.sqrt(part.sum())) for part in np.split(variances, 2))
    return 1000 * shift, float(np.degrees(turn))


def difference(a: FloatArray, b: FloatArray) -> tuple[float, float]:
    """Return the distance of two poses [mm, degrees]."""
    turn = cv2.Rodrigues(a[:3, :3].T @ b[:3, :3])[0]
    apart = float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
    return 1000 * apart, float(np.degrees(np.linalg.norm(turn)))
