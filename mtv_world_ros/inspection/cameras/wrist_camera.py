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

import cv2
import numpy as np

from mtv_world_ros.cameras.camera import unproject
from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray
from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.core.transforms import inverse
from mtv_world_ros.data.episode import Track
from mtv_world_ros.inspection.camera_pose import (
    CameraEstimate,
    covered_frames,
    displaced_pose,
    grey_image,
    jackknife_errors,
    left_out,
    refine_pose,
    shrunk_camera,
    UNITS,
    with_pose,
)
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import moving_links

_WIDTH = 640


@dataclass(frozen=True, slots=True)
class TrackingSettings:
    """Settings of the point tracks that the pose is estimated from.

    Attributes:
        num_stretches: number of stretches of frames, spread over the recording.
        num_frames: number of frames of a stretch that the fit uses.
        max_points: maximum number of points tracked in a stretch.
        min_points: a stretch ends when fewer points are left.
        max_length: maximum number of frames of a stretch.
        min_still_points: minimum number of points of the still scene in a usable stretch.
        min_tracks: minimum number of points of the still scene in all stretches together.
    """

    num_stretches: int = 24
    num_frames: int = 6
    max_points: int = 120
    min_points: int = 20
    max_length: int = 15
    min_still_points: int = 8
    min_tracks: int = 80


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


_TRACKING = TrackingSettings()
_ROTATION = RotationSettings()
#: blocks of stretches that are left out in turn for the standard error
_NUM_GROUPS = 8
#: maximum error of a track after tracking it forwards and backwards [px]
_LOST_PX = 0.7
#: maximum distance between a tracked point and the corner that corrects its drift [px]
_LEAST_DRIFT_PX = 1.0
_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 10, 0.02)
#: points that move less are on the hand [px]
_LEAST_MOTION_PX = 6.0
#: distance from the epipolar line beyond which a point is not of the still scene [px]
_EPIPOLAR_PX = 1.5
#: ways to turn that explain a stretch: by its essential matrix, and by its homography
_NUM_TURNS = 5
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


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneTracks:
    """Points of the still scene that were tracked over stretches of frames.

    Attributes:
        rays: (M, L, 3) unit rays in the optical frame.
        stretch: (M,) number of the stretch of each track, 0 to S - 1, by time.
        positions: (S, L, J) positions of the joints.
        turns: (S, K, 3) ways in which the camera may have turned over a stretch, in its first
            optical frame [rad]; NaN where there are fewer than K.
        focal_px: focal of the images that they were tracked in.
    """

    rays: FloatArray
    stretch: np.ndarray
    positions: FloatArray
    turns: FloatArray
    focal_px: float


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
        links = [_vector(T[:3, :3]) for T in carried]
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

    def _refined(self, T: FloatArray) -> tuple[FloatArray, float]:
        """Return the pose nearby at which the points fit best, and their median distance [px]."""
        for outlier in (10.0, 2.0, 0.7):
            T = refine_pose(T, lambda pose: self._errors(pose).clip(-1e3, 1e3).ravel(),
                        outlier=outlier, iterations=15)  # fmt: skip
        return T, float(np.median(np.linalg.norm(self._errors(T), axis=-1)))

    def _standard_errors(self, T: FloatArray, scale_px: float) -> tuple[float, float]:
        """Return standard errors [mm, degrees] by leaving out neighbouring stretches in turn."""
        step = 1e-2
        slopes = np.stack(
            [
                (self._errors(displaced_pose(T, step * row, T[:3, 3]))
                 - self._errors(displaced_pose(T, -step * row, T[:3, 3]))) / (2 * step)
                for row in np.diag(UNITS)
            ],
            axis=-1,
        )  # fmt: skip
        errors = self._errors(T)
        weights = 1 / (1 + (errors / max(scale_px, 0.1)) ** 2)
        normal = np.einsum('mlki,mlk,mlkj->mij', slopes, weights, slopes)
        gradient = np.einsum('mlki,mlk,mlk->mi', slopes, weights, errors)
        block = self._tracks.stretch * _NUM_GROUPS // len(self._poses)
        total = normal.sum(axis=0)
        without = [
            left_out(total, normal[block == n].sum(axis=0), gradient[block == n].sum(axis=0))
            for n in range(_NUM_GROUPS)
        ]
        variance = float((weights[..., None] * errors[..., None] ** 2).sum()) / _NUM_INDEPENDENT
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


def follow_scene(
    track: Track, camera: CameraModel, robot: RobotModel, joints: JointTrack
) -> SceneTracks:
    """Track corners of the scene over stretches of frames in which the camera moves.

    Args:
        track: frames of the camera.
        camera: intrinsics of the camera.
        robot: whose joints are meant.
        joints: measured joint positions.

    Raises:
        CalibrationError: too little moves, or too few points can be tracked.
    """
    indices = covered_frames(track, joints)
    small = shrunk_camera(camera, _WIDTH)
    starts = np.unique(np.linspace(0, len(indices) - 3, _TRACKING.num_stretches).astype(int))
    found = [
        stretch
        for start in starts
        if (stretch := _stretch(track, indices[start : start + _TRACKING.max_length], small))
        is not None
    ]
    count = sum(len(rays) for rays, _, _ in found)
    if count < _TRACKING.min_tracks or len(found) < _NUM_GROUPS:
        raise CalibrationError(
            f"view '{camera.view}': only {count} points of a scene that moves past the camera "
            f'could be tracked, in {len(found)} stretches of frames ({_TRACKING.min_tracks} in '
            f'{_NUM_GROUPS} are needed); record a scene with texture, in good light, and turn the '
            'wrist slowly about several axes'
        )
    stamps = np.stack([track.stamps_ns[chosen] for _, chosen, _ in found])
    return SceneTracks(
        rays=np.concatenate([rays for rays, _, _ in found]),
        stretch=np.repeat(np.arange(len(found)), [len(rays) for rays, _, _ in found]),
        positions=joints.at(stamps.ravel()).reshape(*stamps.shape, len(robot.joint_names)),
        turns=np.stack([turns for _, _, turns in found]),
        focal_px=float(small.K[0, 0]),
    )


def _stretch(
    track: Track, chosen: np.ndarray, camera: CameraModel
) -> tuple[FloatArray, np.ndarray, FloatArray] | None:
    """Rays (M, L, 3) tracked from the first frame on, the L frames, and the camera's turns."""
    pixels = _tracked(track, chosen, camera)
    if len(pixels) < _TRACKING.min_still_points or pixels.shape[1] < 3:
        return None
    steps = np.linspace(0, pixels.shape[1] - 1, _TRACKING.num_frames).round().astype(int)
    rays = unproject(camera, pixels[:, steps])
    rays = rays[np.isfinite(rays).all(axis=(1, 2))]
    still, turns = _still_scene(rays, camera)
    if still.sum() < _TRACKING.min_still_points:
        return None
    return rays[still], chosen[steps], turns


def _alike(link: FloatArray, seen: FloatArray) -> bool:
    a, b = float(np.linalg.norm(link)), float(np.linalg.norm(seen))
    return (
        min(a, b) > _ROTATION.min_angle_rad
        and abs(a - b) < _ROTATION.relative_tolerance * max(a, b) + _ROTATION.tolerance_rad
    )


def _vector(R: FloatArray) -> FloatArray:
    return np.asarray(cv2.Rodrigues(R)[0].ravel(), np.float64)


def _still_scene(rays: FloatArray, camera: CameraModel) -> tuple[np.ndarray, FloatArray]:
    """Return True for each track (N,) of the still scene, and the rotations (K, 3) that fit.

    Of a flat scene the essential matrix is not unique; its homography has up to four solutions.
    """
    focal = float(camera.K[0, 0])
    first, last = (rays[:, k, :2] / rays[:, k, 2:] for k in (0, -1))
    moves = np.linalg.norm((rays[..., :2] / rays[..., 2:]) - first[:, None], axis=-1).max(axis=1)
    moving = moves * focal > _LEAST_MOTION_PX
    nothing = np.zeros(len(rays), bool), np.full((_NUM_TURNS, 3), np.nan)
    if moving.sum() < _TRACKING.min_still_points:
        return nothing
    first, last = first[moving], last[moving]
    E, inside = cv2.findEssentialMat(
        first, last, np.eye(3), cv2.RANSAC, 0.999, _EPIPOLAR_PX / focal
    )
    if E is None or E.shape != (3, 3):
        return nothing
    rotations = [cv2.recoverPose(E, first, last, np.eye(3), mask=inside.copy())[1]]
    H, _ = cv2.findHomography(first, last, cv2.RANSAC, 2 * _EPIPOLAR_PX / focal)
    if H is not None:
        rotations += list(cv2.decomposeHomographyMat(H, np.eye(3))[1])
    turns = nothing[1]
    turns[: len(rotations)] = [_vector(np.asarray(R, np.float64).T) for R in rotations]
    still = np.zeros(len(rays), bool)
    still[np.flatnonzero(moving)[inside.ravel() > 0]] = True
    return still, turns


def _tracked(track: Track, chosen: np.ndarray, camera: CameraModel) -> FloatArray:
    """Return (M, frames, 2) pixels of corners that are found again forwards and backwards.

    It ends where too few are left.
    """
    before = grey_image(np.asarray(track.frames[int(chosen[0])]), camera)
    corners = cv2.goodFeaturesToTrack(before, _TRACKING.max_points, 0.01, 8)
    if corners is None:
        return np.zeros((0, 1, 2))
    paths = _on_corner(before, corners).reshape(-1, 1, 2).astype(np.float64)
    for index in chosen[1:]:
        after = grey_image(np.asarray(track.frames[int(index)]), camera)
        start = paths[:, -1].astype(np.float32).reshape(-1, 1, 2)
        ahead, back, ok = _there_and_back(before, after, start)
        kept = ok & (np.linalg.norm((back - start).reshape(-1, 2), axis=1) < _LOST_PX)
        inside = (ahead >= 4) & (ahead < np.array([camera.width, camera.height]) - 4)
        kept &= inside.reshape(-1, 2).all(axis=1)
        if kept.sum() < _TRACKING.min_points:
            break
        there = _on_corner(after, ahead[kept]).reshape(-1, 1, 2)
        paths = np.concatenate([paths[kept], there], axis=1)
        before = after
    return paths


def _on_corner(image: ByteArray, points: np.ndarray) -> np.ndarray:
    """Points (N, 1, 2) moved to the corner they are at, so that they do not drift off it."""
    found = cv2.cornerSubPix(image, points.copy(), (3, 3), (-1, -1), _STOP)
    near = np.linalg.norm(found - points, axis=-1, keepdims=True) < _LEAST_DRIFT_PX
    return np.where(near, found, points)


def _there_and_back(
    before: ByteArray, after: ByteArray, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    ahead, ok, _ = cv2.calcOpticalFlowPyrLK(
        before, after, start, np.zeros_like(start), winSize=(15, 15), maxLevel=3
    )
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(
        after, before, ahead, np.zeros_like(start), winSize=(15, 15), maxLevel=3
    )
    return np.asarray(ahead), np.asarray(back), (ok.ravel() == 1) & (ok_back.ravel() == 1)
