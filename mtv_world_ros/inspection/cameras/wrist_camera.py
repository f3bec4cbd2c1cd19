"""Pose of a camera on the arm, from how the scene moves through its pictures.

Points of the scene are tracked over stretches of frames. The joint states say how the carrying
link moved meanwhile, so that with the right pose of the camera on it all rays of a point meet
(bundle adjustment with known motion). Without a guess, the camera's turns between frames, by
their essential matrices, give its direction first (hand-eye calibration: Tsai and Lenz, 1989).

M tracks of L frames each, S stretches, J joints.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.core.transforms import inverse
from mtv_world_ros.inspection.camera_pose import (
    CameraEstimate,
    jackknife_errors,
    left_out,
    UNITS,
    with_pose,
)
from mtv_world_ros.inspection.cameras.scene_tracks import (
    NUM_GROUPS,
    rotation_vector,
    SceneTracks,
)
from mtv_world_ros.inspection.cameras.solver import (
    CameraState,
    linearize,
    Residual,
    solve,
    Unknowns,
)
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import moving_links


@dataclass(frozen=True, slots=True)
class RotationSettings:
    """Settings that select the stretches whose rotation shows the camera's direction.

    Attributes:
        min_angle_rad: minimum rotation of link and camera.
        relative_tolerance: tolerated difference of both angles, as a fraction of the larger one.
        tolerance_rad: tolerated difference of both angles in addition.
    """

    min_angle_rad: float = 0.06
    relative_tolerance: float = 0.15
    tolerance_rad: float = 0.02


_ROTATION = RotationSettings()
#: axes of turns within this of each other agree [rad]
_AGREE = 0.12
#: points are farther from the camera than the inverse of this [1/m]
_NEAREST = 50.0
#: measurements that all points are worth: some errors are the same in all stretches, e.g. of
#: points that slide along edges
_NUM_INDEPENDENT = 100
#: maximum position error of a pose that counts as found, twice the standard error [mm]
_MAX_ERROR_MM = 100.0
#: maximum direction error of a pose that counts as found, twice the standard error [degrees]
_MAX_ERROR_DEG = 10.0
#: outlier thresholds of one fit after the other [px]
_OUTLIERS_PX = (10.0, 2.0, 0.7)
#: step of the finite differences of the errors, in `UNITS`
_STEP = 0.01


class WristCamera:
    """Estimator of the pose of a camera on the link that carries it.

    Args:
        tracks: points seen by it.
        camera: intrinsics and `mount_link`; the pose is the guess, if there is one.
        robot: robot that has the camera's link.
    """

    def __init__(self, tracks: SceneTracks, camera: CameraModel, robot: RobotModel) -> None:
        self._camera = camera
        self._tracks = tracks
        shape = tracks.positions.shape
        poses = robot.link_poses(camera.mount_link, tracks.positions.reshape(-1, shape[-1]))
        self._poses = poses.reshape(*shape[:2], 4, 4)

    def estimate(self, *, guess: bool = True) -> CameraEstimate:
        """Estimate the pose in the carrying link.

        Args:
            guess: start from the camera's pose; False = find its direction first.

        Raises:
            CalibrationError: the recording does not determine the pose.
        """
        start = self._camera.T_mount_camera if guess else self._direction()
        T, scale_px = self._refined(start)
        std_mm, std_deg = self._standard_errors(T, scale_px)
        if not 2 * std_mm < _MAX_ERROR_MM or not 2 * std_deg < _MAX_ERROR_DEG:
            raise CalibrationError(
                f"view '{self._camera.view}': the recording does not determine the pose "
                f'(standard error {std_mm:.0f} mm and {std_deg:.1f} degrees); record one in which '
                'the wrist turns about at least two axes, near a scene with texture'
            )
        px = scale_px * self._camera.K[0, 0] / self._tracks.focal_px
        return CameraEstimate(
            camera=with_pose(self._camera, T),
            std_mm=std_mm,
            std_deg=std_deg,
            evidence=f'{len(self._tracks.rays)} points of the scene tracked over '
            f'{len(self._poses)} stretches of frames, median distance from '
            f'where they should be {px:.2f} px',
            residual_px=px,
        )

    def _direction(self) -> FloatArray:
        """Return the pose at the link's origin whose turns are the link's.

        A turn of the link by a vector is one of the camera by the same vector, seen in its frame.
        """
        carried = inverse(self._poses[:, 0]) @ self._poses[:, -1]
        links = [rotation_vector(T[:3, :3]) for T in carried]
        pairs = [(n, link, seen) for n, link in enumerate(links) for seen in self._tracks.turns[n]
                 if _alike(link, seen)]  # fmt: skip
        stretch = np.array([n for n, _, _ in pairs])
        turns = np.array([pair[1:] for pair in pairs]).reshape(-1, 2, 3)
        best: tuple[int, FloatArray] = (0, np.eye(3))
        for pair in combinations(range(len(turns)), 2):
            R = _rotation_between(turns[list(pair)])
            if R is not None:
                agree = _agree(R, turns)
                count = len(np.unique(stretch[agree]))
                if count > best[0]:
                    better = _rotation_between(turns[agree])
                    best = (count, R if better is None else better)
        if best[0] < max(4, len(carried) // 3):
            raise CalibrationError(
                f"view '{self._camera.view}': the camera's direction was not found: its turns "
                f'agree with those of the link in {best[0]} of {len(carried)} stretches of '
                'frames. Record one in which the wrist turns about at least two axes, or give a '
                'guess; are link, K and clock right?'
            )
        T = np.eye(4)
        T[:3, :3] = best[1]
        return T

    def _errors(self, T_mount_camera: FloatArray) -> FloatArray:
        """Return the reprojection errors (M, L - 1, 2) of the tracked points [px].

        A point lies on its first ray, at the distance that fits its other observations best.
        """
        tracks = self._tracks
        T = self._poses @ T_mount_camera
        relative = (inverse(T[:, 1:]) @ T[:, :1])[tracks.stretch]
        ahead = np.einsum('mlij,mj->mli', relative[..., :3, :3], tracks.rays[:, 0])
        aside = relative[..., :3, 3]
        seen = tracks.rays[:, 1:, :2] / tracks.rays[:, 1:, 2:]
        slope = aside[..., :2] - seen * aside[..., 2:]
        offset = seen * ahead[..., 2:] - ahead[..., :2]
        nearness = ((slope * offset).sum((1, 2)) / ((slope**2).sum((1, 2)) + 1e-12))[:, None]
        for _ in range(2):
            nearness = nearness.clip(0, _NEAREST)
            depth = np.maximum(ahead[..., 2] + nearness * aside[..., 2], 1e-2)[..., None]
            there = (ahead[..., :2] + nearness[..., None] * aside[..., :2]) / depth
            slope = (aside[..., :2] - there * aside[..., 2:]) / depth
            step = (slope * (seen - there)).sum((1, 2)) / ((slope**2).sum((1, 2)) + 1e-12)
            nearness = nearness + step[:, None]
        nearness = nearness.clip(0, _NEAREST)
        depth = np.maximum(ahead[..., 2] + nearness * aside[..., 2], 1e-2)[..., None]
        there = (ahead[..., :2] + nearness[..., None] * aside[..., :2]) / depth
        return np.asarray((there - seen) * tracks.focal_px, np.float64)

    def _residual(self, outlier: float) -> Residual:
        return Residual(
            place=0,
            errors=lambda T, _: self._errors(T).clip(-1e3, 1e3).ravel(),
            outlier=outlier,
            step=_STEP,
        )

    def _refined(self, T: FloatArray) -> tuple[FloatArray, float]:
        """Return the pose nearby at which the points fit best, and their median distance [px]."""
        state = CameraState(poses={0: T})
        for outlier in _OUTLIERS_PX:
            state, _ = solve(
                [self._residual(outlier)], Unknowns(), state, evaluations=40, tolerance=1e-8
            )
        T = state.poses[0]
        return T, float(np.median(np.linalg.norm(self._errors(T), axis=-1)))

    def _standard_errors(self, T: FloatArray, scale_px: float) -> tuple[float, float]:
        """Return standard errors [mm, degrees] by leaving out neighbouring stretches in turn."""
        residual = self._residual(max(scale_px, 0.1))
        errors, weights, slopes = linearize(residual, T, np.zeros(3), Unknowns())
        per_track = len(errors) // len(self._tracks.rays)
        block = (self._tracks.stretch * NUM_GROUPS // len(self._poses)).repeat(per_track)
        weighted = weights * slopes
        total = weighted @ slopes.T
        without = [
            left_out(total, weighted[:, one] @ slopes[:, one].T, weighted[:, one] @ errors[one])
            for one in (block == n for n in range(NUM_GROUPS))
        ]
        variance = float((weights * errors**2).sum()) / _NUM_INDEPENDENT
        shared = np.sqrt(variance * np.diag(np.linalg.pinv(total))) * UNITS
        mm, degrees = jackknife_errors(np.stack(without))
        return (
            float(np.hypot(mm, 1000 * np.linalg.norm(shared[3:]))),
            float(np.hypot(degrees, np.degrees(np.linalg.norm(shared[:3])))),
        )


def find_mount(tracks: SceneTracks, camera: CameraModel, robot: RobotModel) -> CameraEstimate:
    """Return the estimate on the moving link whose motion fits the camera's best, without guess.

    Of links that move alike in the recording, the first one from the base.

    Raises:
        CalibrationError: none fits.
    """
    moving = moving_links(robot)
    found, why = [], ''
    for link in robot.link_names:
        if link in moving:
            try:
                wrist = WristCamera(tracks, replace(camera, mount_link=link), robot)
                found.append(wrist.estimate(guess=False))
            except CalibrationError as error:
                why = str(error)
    if not found:
        raise CalibrationError(f"no link moves like view '{camera.view}': {why}")
    best = min(estimate.residual_px for estimate in found)
    return next(estimate for estimate in found if estimate.residual_px <= 1.02 * best)


def _rotation_between(turns: FloatArray) -> FloatArray | None:
    """Return (3, 3) that takes the second vectors of (N, 2, 3) to the first.

    None where not unique.
    """
    u, s, vt = np.linalg.svd(np.einsum('ni,nj->ij', turns[:, 0], turns[:, 1]))
    if s[1] < 0.02 * s[0]:
        return None
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    return np.asarray(u @ sign @ vt, np.float64)


def _agree(R: FloatArray, turns: FloatArray) -> np.ndarray:
    """Return True for each pair (N,) whose rotated second vector points like the first."""
    apart = np.linalg.norm(turns[:, 0] - turns[:, 1] @ R.T, axis=-1)
    return apart < _AGREE * np.linalg.norm(turns[:, 0], axis=-1) + _ROTATION.tolerance_rad


def _alike(link: FloatArray, seen: FloatArray) -> bool:
    a, b = float(np.linalg.norm(link)), float(np.linalg.norm(seen))
    return (
        min(a, b) > _ROTATION.min_angle_rad
        and abs(a - b) < _ROTATION.relative_tolerance * max(a, b) + _ROTATION.tolerance_rad
    )
