"""Checks camera poses: the arm's outline by its URDF against a picture.

The outline that joint states and a calibrated pose predict is laid over the picture's edges. A
shift is searched first; then the pose is the most likely one by edges that are met along the
outline's normals (Harris and Stennett, RAPID, 1990), given how far cameras usually are off.

Shape letters: V views, J joints, N points of an outline, S shifts, H W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import cv2
import numpy as np
from scipy.spatial import KDTree

from mtv_world_ros.cameras.camera import camera_poses, project, scaled, unproject
from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray, Observation
from mtv_world_ros.core.transforms import inverse
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import fill, LinkShape, RobotShape

Status = Literal['fits', 'corrected', 'refused', 'unchecked']


@dataclass(frozen=True, slots=True)
class CameraCheckSettings:
    """Settings of the check of a camera's pose against the outline of the arms.

    Attributes:
        image_width_px: width of the images for the pose.
        coarse_width_px: width of the images for the first shift.
        max_points: largest number of outline points that are used.
        min_points: number of outline points below which the arm is hardly visible.
        max_shift: largest first shift [fraction of image width].
        search_ranges: search range for edges in each round [fraction of image width].
        blur: blur before edge detection [fraction of image width].
        min_blur_px: smallest blur of the images [px].
        half_contrast: contrast of an edge with weight 1/2 [grey levels a pixel].
        edge_std: standard deviation of an edge's position [fraction of image width].
        min_edge_std_px: smallest standard deviation of an edge's position.
        points_per_sample: correlated neighbouring outline points that count as one sample.
        min_z_score: z-score of the best alignment against other alignments for a check.
        min_edge_strength: strength of an edge within a pixel of a matched outline point.
        accepted_fraction: fraction of matched outline points of an accepted pose.
        refused_fraction: fraction of matched points below which the arm is elsewhere.
        min_offset: offset below which a pose fits [fraction of image width].
        max_offset: offset from which a pose is not corrected [fraction of image width].
        max_pose_error: largest standard error of a projected pose [fraction of image width].
    """

    image_width_px: int = 384
    coarse_width_px: int = 128
    max_points: int = 300
    min_points: int = 50
    max_shift: float = 0.16
    search_ranges: tuple[float, ...] = (0.02, 0.012, 0.008)
    blur: float = 0.003
    min_blur_px: float = 0.8
    half_contrast: float = 6.0
    edge_std: float = 0.003
    min_edge_std_px: float = 0.4
    points_per_sample: float = 6.0
    min_z_score: float = 4.0
    min_edge_strength: float = 0.5
    accepted_fraction: float = 0.62
    refused_fraction: float = 0.5
    min_offset: float = 0.006
    max_offset: float = 0.07
    max_pose_error: float = 0.012


_CHECK = CameraCheckSettings()
#: prior standard deviations of the pose error: three turns [rad], three shifts [m]
_PRIOR_STD = np.array([0.02] * 3 + [0.015] * 3)


class _Edges(NamedTuple):
    """Structure of edges, each (H, W) float32: of a unit normal n the strength is n' E n, 0..1."""

    xx: np.ndarray
    xy: np.ndarray
    yy: np.ndarray


class _Outline(NamedTuple):
    """Points of an outline in the picture.

    Attributes:
        pixels: (N, 2) pixels of the points.
        normals: (N, 2) unit normals of the outline, outwards.
        points: (N, 3) points that are seen there, in the optical frame [m].
    """

    pixels: FloatArray
    normals: FloatArray
    points: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFit:
    """Result of the check for one view.

    Attributes:
        view: name of the view.
        status: `fits`, `corrected` for this episode, `refused` as too far off, or `unchecked`.
        T_given_found: (4, 4) pose of the found optical frame in the calibrated one; identity where
            not found.
        offset_px: distance of the arm in the picture from where the calibration draws it, at the
            picture's size [px]; NaN = not known.
        text: the finding in words.
    """

    view: str
    status: Status
    T_given_found: FloatArray
    offset_px: float = float('nan')
    text: str = ''


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraCheck:
    """Results of the check for the cameras of an episode's first frame."""

    fits: tuple[CameraFit, ...] = ()

    @property
    def text(self) -> str:
        """The findings in words."""
        if not self.fits:
            return 'not checked'
        return '; '.join(self.notes) or 'the arm is where they should show it'

    @property
    def refusal(self) -> str:
        """The reason to give no verdict with these cameras; empty = none."""
        return '; '.join(fit.text for fit in self.fits if fit.status == 'refused')

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks about the cameras, one line each."""
        return tuple(fit.text for fit in self.fits if fit.status != 'fits')

    def corrected(self, cameras: Sequence[CameraModel]) -> tuple[CameraModel, ...]:
        """Return cameras of the same views, at any size, as they were found to be."""
        found = {fit.view: fit for fit in self.fits if fit.status == 'corrected'}
        return tuple(
            replace(c, T_mount_camera=c.T_mount_camera @ found[c.view].T_given_found)
            if c.view in found
            else c
            for c in cameras
        )

    def corrected_observation(self, observation: Observation) -> Observation:
        """Return an observation with its cameras as they were found to be."""
        if all(fit.status != 'corrected' for fit in self.fits):
            return observation
        return replace(observation, cameras=self.corrected(observation.cameras))


class CameraChecker:
    """Compares pictures with the outline of a robot.

    Args:
        robot: the one whose joint states are given.
        shape: shapes of the robot's links.
    """

    def __init__(self, robot: RobotModel, shape: RobotShape) -> None:
        self._robot, self._shape = robot, shape

    def with_robot(self, robot: RobotModel) -> CameraChecker:
        """Return the same for a robot of the same links, e.g. a calibrated one."""
        return CameraChecker(robot, self._shape)

    def check(self, observation: Observation) -> CameraCheck:
        """Check each camera of an observation."""
        views = zip(observation.cameras, observation.frames, strict=True)
        return CameraCheck(
            fits=tuple(self._fit(camera, frame, observation.positions) for camera, frame in views)
        )

    def shows_arm(self, observation: Observation) -> tuple[bool, ...]:
        """Return for each camera whether the arm's outline is met where the camera puts it.

        No other pose is searched: a fifth of the time of `check`. False where the shape of the
        robot is not known or the arm is hardly in view.
        """
        if not self._shape.is_known:
            return (False,) * len(observation.cameras)
        links = _links(self._robot, self._shape.parts, observation.positions)
        return tuple(
            self._is_met(camera, frame, observation.positions, links)
            for camera, frame in zip(observation.cameras, observation.frames, strict=True)
        )

    def _is_met(
        self,
        camera: CameraModel,
        frame: ByteArray,
        positions: FloatArray,
        links: Sequence[FloatArray],
    ) -> bool:
        camera = _checked_size(camera)
        pose = camera_poses(camera, self._robot, positions[None])[0]
        outline = _outline(camera, links, pose)
        is_in_view = len(outline.pixels) >= _CHECK.min_points
        return is_in_view and _met(_edges(frame, camera), outline) >= _CHECK.accepted_fraction

    def _fit(self, camera: CameraModel, frame: ByteArray, positions: FloatArray) -> CameraFit:
        if not self._shape.is_known:
            why = f'the shape of the robot is not known: {self._shape.source}'
            return _unchecked(camera.view, why)
        found = _search(camera, frame, self._robot, self._shape.parts, positions)
        if isinstance(found, str):
            return _unchecked(camera.view, found)
        return _judged(camera, found)


def _unchecked(view: str, why: str) -> CameraFit:
    text = f"camera '{view}' not checked against the arm: {why}"
    return CameraFit(view=view, status='unchecked', T_given_found=np.eye(4), text=text)


class _Found(NamedTuple):
    """A camera pose, and the shift in the image that it causes.

    Attributes:
        T: (4, 4) the found optical frame in the calibrated one.
        offset: mean shift of the outline, as a share of the width; NaN = it is met nowhere near.
    """

    T: FloatArray
    offset: float


def _judged(camera: CameraModel, found: _Found) -> CameraFit:
    if not np.isfinite(found.offset):
        text = (
            f"camera '{camera.view}' does not show the arm where joint states and calibration put "
            'it, nor near; calibrate it again (mtv-world fit camera), see mtv-world check'
        )
        return CameraFit(view=camera.view, status='refused', T_given_found=np.eye(4), text=text)
    off_m = float(np.linalg.norm(found.T[:3, 3]))
    off_deg = float(np.rad2deg(np.linalg.norm(cv2.Rodrigues(found.T[:3, :3])[0])))
    says = (
        f"camera '{camera.view}' shows the arm {found.offset * camera.width:.1f} px from where it "
        f'should be (about {off_m * 1e3:.0f} mm and {off_deg:.1f} degrees)'
    )
    if found.offset < _CHECK.min_offset:
        status, text = 'fits', says
    elif found.offset < _CHECK.max_offset:
        status, text = 'corrected', f'{says}; corrected for this episode'
    else:
        status, text = 'refused', f'{says}; calibrate it again (mtv-world fit camera)'
    return CameraFit(
        view=camera.view,
        status=status,
        T_given_found=found.T if status == 'corrected' else np.eye(4),
        offset_px=found.offset * camera.width,
        text=text,
    )


def _search(
    camera: CameraModel,
    frame: ByteArray,
    robot: RobotModel,
    parts: Sequence[LinkShape],
    positions: FloatArray,
) -> _Found | str:
    """Return the pose at which outline and picture agree, or why there is none."""
    camera = _checked_size(camera)
    edges, links = _edges(frame, camera), _links(robot, parts, positions)
    T_given = camera_poses(camera, robot, positions[None])[0]
    given = _outline(camera, links, T_given)
    if len(given.pixels) < _CHECK.min_points:
        return 'the arm is hardly in view'
    shift, clear = _shift(edges, given, camera.width)
    if clear < _CHECK.min_z_score:
        return 'its outline does not stand out in the picture'
    T, covariance = T_given @ _turned_by(camera, shift), np.diag(_PRIOR_STD**2)
    for window in _CHECK.search_ranges:
        outline = _outline(camera, links, T)
        T, covariance = _stepped(edges, outline, camera, T_given, T, window * camera.width)
    met = _met(edges, _outline(camera, links, T))
    T_given_found = inverse(T_given) @ T
    if met < _CHECK.refused_fraction:
        return _Found(T_given_found, np.nan)
    slopes = _slopes(camera, given.points)
    spread = np.einsum('nij,jk,nik->n', slopes, covariance, slopes).mean()
    if (
        met < _CHECK.accepted_fraction
        or float(np.sqrt(spread)) > _CHECK.max_pose_error * camera.width
    ):
        return f'only {met:.0%} of its outline is met in the picture, which is too little'
    moved, _ = project(camera, T_given_found, given.points)
    offset = float(np.nanmean(np.linalg.norm(moved - given.pixels, axis=-1)))
    return _Found(T_given_found, offset / camera.width)


def _checked_size(camera: CameraModel) -> CameraModel:
    """Return a camera at the size that pictures are checked at."""
    if camera.width <= _CHECK.image_width_px:
        return camera
    height = round(camera.height * _CHECK.image_width_px / camera.width)
    return scaled(camera, _CHECK.image_width_px, height)


def _edges(frame: ByteArray, camera: CameraModel) -> _Edges:
    size = (camera.width, camera.height)
    image = cv2.resize(frame, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    blur = max(_CHECK.blur * camera.width, _CHECK.min_blur_px)
    image = cv2.GaussianBlur(image, (0, 0), blur)
    x, y = (cv2.Sobel(image, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    xx, xy, yy = ((a * b).sum(-1) for a, b in ((x, x), (x, y), (y, y)))
    whole = xx + yy + 3 * _CHECK.half_contrast**2
    return _Edges(xx / whole, xy / whole, yy / whole)


def _links(
    robot: RobotModel, parts: Sequence[LinkShape], positions: FloatArray
) -> list[FloatArray]:
    """Return the corners (N, 3) of each part in the base frame [m]."""
    poses = robot.forward_kinematics(positions[None])
    return [
        part.points @ poses[part.link][0, :3, :3].T + poses[part.link][0, :3, 3] for part in parts
    ]


def _outline(
    camera: CameraModel, links: Sequence[FloatArray], T_base_camera: FloatArray
) -> _Outline:
    """Return the outline of the robot from a pose (4, 4).

    Without what the image's border cuts off.
    """
    corners, depths = project(camera, T_base_camera, np.concatenate(links))
    ends = np.cumsum([len(link) for link in links])[:-1]
    image = fill([part[None] for part in np.split(corners, ends)], camera)[0]
    lines, _ = cv2.findContours(image, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    if not lines:
        return _Outline(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 3)))
    at = np.concatenate(lines)[:, 0].astype(np.float64)
    inner = ((at > 1) & (at < np.array([camera.width - 2, camera.height - 2]))).all(-1)
    at = at[inner][:: max(1, int(inner.sum()) // _CHECK.max_points)]
    soft = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5)
    rows, columns = at[:, 1].astype(int), at[:, 0].astype(int)
    slope = np.stack(
        [cv2.Sobel(soft, cv2.CV_32F, *order)[rows, columns] for order in ((1, 0), (0, 1))], axis=-1
    ).astype(np.float64)
    normals = -slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-9)
    rays = unproject(camera, at)
    # as deep as the corners that are nearest in the picture
    known = np.isfinite(corners).all(-1)
    _, nearest = KDTree(corners[known]).query(at)
    scale = depths[known][nearest] / rays[:, 2]
    return _Outline(at, normals, rays * scale[:, None])


def _strength(edges: _Edges, at: FloatArray, normals: FloatArray) -> FloatArray:
    """Return (N, K) strength of edges at pixels (N, K, 2) across normals (N, 2)."""
    maps = at.astype(np.float32)
    xx, xy, yy = (
        cv2.remap(one, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderValue=0)
        for one in edges
    )
    x, y = normals[:, None, 0], normals[:, None, 1]
    return np.asarray(x * x * xx + 2 * x * y * xy + y * y * yy, np.float64)


def _shift(edges: _Edges, outline: _Outline, width: int) -> tuple[FloatArray, float]:
    """Return the shift (2,) [px] at which edges meet an outline, and how clearly it stands out."""
    step = max(1.0, width / _CHECK.coarse_width_px)
    blurred = _Edges(*(cv2.GaussianBlur(one, (0, 0), step) for one in edges))
    reach = (
        np.arange(
            -round(_CHECK.max_shift * width / step), round(_CHECK.max_shift * width / step) + 1
        )
        * step
    )
    shifts = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    thin = slice(None, None, max(1, len(outline.pixels) // 150))
    at = outline.pixels[thin, None] + shifts[None]
    score = _strength(blurred, at, outline.normals[thin]).mean(0)
    best = int(score.argmax())
    return shifts[best], float((score[best] - score.mean()) / max(float(score.std()), 1e-9))


def _met(edges: _Edges, outline: _Outline) -> float:
    """Return the share of an outline's points at which the picture has an edge."""
    near = np.array([-1.0, 0.0, 1.0])[None, :, None] * outline.normals[:, None]
    strength = _strength(edges, outline.pixels[:, None] + near, outline.normals)
    return (
        float((strength.max(axis=1) > _CHECK.min_edge_strength).mean()) if len(strength) else 0.0
    )


def _turned_by(camera: CameraModel, shift: FloatArray) -> FloatArray:
    """Return (4, 4) the turn of a camera that shifts its picture by (2,) [px]."""
    T = np.eye(4)
    turn = np.array([shift[1] / camera.K[1, 1], -shift[0] / camera.K[0, 0], 0.0])
    T[:3, :3] = cv2.Rodrigues(turn)[0]
    return T


def _slopes(camera: CameraModel, points: FloatArray) -> FloatArray:
    """(N, 2, 6) how pixels of points (N, 3) move as a camera turns [1/rad] and shifts [1/m]."""
    small, columns = 1e-4, []
    for axis in range(6):
        ends = []
        for sign in (1.0, -1.0):
            change = np.zeros(6)
            change[axis] = sign * small
            ends.append(project(camera, _changed(change), points)[0])
        columns.append((ends[0] - ends[1]) / (2 * small))
    return np.nan_to_num(np.stack(columns, axis=-1))


def _changed(change: FloatArray) -> FloatArray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(change[:3])[0], change[3:]
    return T


def _stepped(
    edges: _Edges,
    outline: _Outline,
    camera: CameraModel,
    T_given: FloatArray,
    T: FloatArray,
    window: float,
) -> tuple[FloatArray, FloatArray]:
    """Return pose after a step towards edges within a window [px], and its covariance (6, 6)."""
    reach = np.arange(-np.ceil(2 * window), np.ceil(2 * window) + 1) / 2
    at = outline.pixels[:, None] + reach[None, :, None] * outline.normals[:, None]
    strength = _strength(edges, at, outline.normals)
    peaks = strength.argmax(axis=1)
    ways, weights = reach[peaks], strength[np.arange(len(peaks)), peaks]
    rows = np.einsum('ni,nij->nj', outline.normals, _slopes(camera, outline.points))
    sigma = max(_CHECK.edge_std * camera.width, _CHECK.min_edge_std_px)
    so_far = inverse(T_given) @ T
    prior = np.concatenate([cv2.Rodrigues(so_far[:3, :3])[0][:, 0], so_far[:3, 3]])
    change = np.zeros(6)
    normal = np.eye(6)
    for _ in range(8):  # reweighted: what is far off is another edge
        off = (ways - rows @ change) / sigma
        weight = weights / (1 + off**2) / _CHECK.points_per_sample / sigma**2
        normal = (rows * weight[:, None]).T @ rows + np.diag(1 / _PRIOR_STD**2)
        gradient = (rows * weight[:, None]).T @ ways - prior / _PRIOR_STD**2
        change = np.linalg.solve(normal, gradient)
    return T @ _changed(change), np.asarray(np.linalg.inv(normal), np.float64)
