"""Tracks of a still scene in the pictures of a camera that moves.

M tracks of L frames each, S stretches, J joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mtv_world_ros.cameras.camera import unproject
from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray
from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.data.episode import Track
from mtv_world_ros.inspection.camera_pose import covered_frames, grey_image, shrunk_camera
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.robot.model import RobotModel

#: width to which the frames are shrunk [px]
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


_TRACKING = TrackingSettings()
#: blocks of stretches that are left out in turn for the standard error
NUM_GROUPS = 8
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
    if count < _TRACKING.min_tracks or len(found) < NUM_GROUPS:
        raise CalibrationError(
            f"view '{camera.view}': only {count} points of a scene that moves past the camera "
            f'could be tracked, in {len(found)} stretches of frames ({_TRACKING.min_tracks} in '
            f'{NUM_GROUPS} are needed); record a scene with texture, in good light, and turn the '
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


def rotation_vector(R: FloatArray) -> FloatArray:
    """Return the rotation vector (3,) [rad] of a rotation matrix (3, 3)."""
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
    turns[: len(rotations)] = [rotation_vector(np.asarray(R, np.float64).T) for R in rotations]
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
