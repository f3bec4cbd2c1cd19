"""Estimates the pose of a fixed camera from the motion of the robot in its images.

Between two frames the picture changes where the robot was and where it is. The robot's
silhouettes, drawn by joint states and a pose, say where that should be; the pose is the one at
which drawn and seen changes correlate most. It needs no markers and no feature on the robot.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.cameras.silhouettes import project_points
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.core.transforms import looking_along
from mtv_world_ros.data.episode import Track
from mtv_world_ros.inspection.camera_pose import (
    CameraEstimate,
    covered_frames,
    displaced_pose,
    jackknife_errors,
    left_out,
    refine_pose,
    shrunk_camera,
    UNITS,
    with_pose,
)
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.robot.mesh_pieces import outermost
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import fill, LinkShape, moving_links


class ImageStage(NamedTuple):
    """Image size of one step of the search.

    Attributes:
        width: width to which the images are shrunk [px].
        blur: standard deviation of the blur [px].
    """

    width: int
    blur: float


#: search without a guess: cameras all around the robot
_SEARCH_STAGE = ImageStage(64, 1.5)
#: first fit from a guess: a wide blur, so that distant silhouettes still attract each other
_WIDE_STAGE = ImageStage(120, 5.0)
#: second fit from a guess
_MIDDLE_STAGE = ImageStage(120, 2.0)
#: first fit of a pose that is nearly right
_NEAR_STAGE = ImageStage(160, 1.0)
#: last fit, whose residuals give the standard error
_FINE_STAGE = ImageStage(240, 1.5)
#: outlier threshold: a pixel counts less where drawn and seen change differ by more than this
_OUTLIER = 0.3
#: drawn change of a pixel that the robot covers in both frames, where the image may change or not
_INSIDE = 0.3
_NUM_FRAMES = 24
#: directions in which a part's outermost points are drawn
_NUM_CORNERS = 48
#: links that move less are left out, because an arm at rest does not constrain the pose [m]
_STILL_M = 0.02
#: shrink factor of the images that candidate poses are compared on
_ROUGH = 4
#: search without a guess: number of camera poses tried around the robot
_NUM_CANDIDATES = 1500
#: search without a guess: number of best candidates that are refined
_NUM_REFINED = 6
_Item = TypeVar('_Item')
#: measurements that the pixels of all frames are worth
_NUM_INDEPENDENT = 12
#: first step of the search along poses that look alike, in `UNITS`
_STEP = 5.0
#: correlation below which a found pose explains the pictures no better than chance
_LEAST_FIT = 0.45


class Reading(NamedTuple):
    """Settings that turn a change of colour into a probability of motion.

    Attributes:
        brightness: weight of the brightness of a colour, 0 to 1.
        may: distance of two colours (root mean square of their channels) from which a pixel may
            have changed.
        surely: distance of two colours from which a pixel has certainly changed.
    """

    brightness: float
    may: float
    surely: float


#: grey levels do not tell a grey arm from a brown table; but an arm's shadow on a table is all
#: brightness. The reading is kept in which drawn and seen changes fit better
READINGS = (Reading(1.0, 4.0, 16.0), Reading(0.3, 6.0, 20.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Changes:
    """Changed pixels of pairs of frames, at one image size.

    Attributes:
        camera: intrinsics of the camera at that size.
        pairs: (P, 2) rows of the frames.
        seen: (P, H, W) change of each pixel, 0 to 1.
        blur: standard deviation [px].
        deviation: length of `seen` without its mean.
    """

    camera: CameraModel
    pairs: np.ndarray
    seen: NDArray[np.float32]
    blur: float
    deviation: float


class FixedCamera:
    """Estimator of the camera pose of one view.

    Args:
        track: frames of the view.
        camera: intrinsics of the camera; its pose is the guess, if there is one.
        robot: robot whose link poses are drawn.
        shapes: shapes of the links.
        joints: measured joint positions.
        num_frames: number of frames that are compared, spread over the recording.
        num_corners: directions in which a part's outermost points are drawn.

    Raises:
        CalibrationError: the arm does not move, or too few frames are within the joint states.
    """

    def __init__(
        self,
        track: Track,
        camera: CameraModel,
        robot: RobotModel,
        shapes: Sequence[LinkShape],
        joints: JointTrack,
        *,
        num_frames: int = _NUM_FRAMES,
        num_corners: int = _NUM_CORNERS,
    ) -> None:
        indices = covered_frames(track, joints)
        chosen = indices[np.unique(np.linspace(0, len(indices) - 1, num_frames).astype(int))]
        self._positions = joints.at(track.stamps_ns[chosen])
        self._frames = [np.asarray(track.frames[int(i)]) for i in chosen]
        self.camera = camera
        poses = robot.forward_kinematics(self._positions)
        moving = moving_links(robot)
        self._parts = [
            part
            for part in shapes
            if part.link in moving and _way(part, poses[part.link]) > _STILL_M
        ]
        if not self._parts:
            raise _hardly_moves(camera.view)
        self._poses = {part.link: poses[part.link] for part in self._parts}
        self._corners = [
            _in_base(outermost(part.points, num_corners), poses[part.link]) for part in self._parts
        ]
        self.points = np.concatenate(
            [_sample(part.points) @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
             for part in self._parts for T in [self._poses[part.link]]],
            axis=1,
        )  # fmt: skip
        self.centre = self.points.reshape(-1, 3).mean(axis=0)
        self.pairs = self._far_pairs()

    def estimate(
        self,
        *,
        guess: bool = True,
        seed: int = 0,
        progress: Callable[[Sequence[Any]], Iterable[Any]] = iter,
    ) -> CameraEstimate:
        """Estimate the pose, in the robot's base link.

        Args:
            guess: start from the camera's pose; False = from cameras all around the robot.
            seed: seed of the cameras that are tried.
            progress: wraps what is tried, e.g. in a progress bar.

        Raises:
            CalibrationError: no pose explains the pictures.
        """
        T = self.camera.T_mount_camera
        starts = [(T, reading) for reading in READINGS] if guess else self._search(seed, progress)
        found = []
        sizes = {
            reading: (self.changes(*_WIDE_STAGE, reading), self.changes(*_MIDDLE_STAGE, reading))
            for reading in dict.fromkeys(reading for _, reading in starts)
        }
        for start, reading in progress(starts):
            wide, middle = sizes[reading]
            pose = self._aligned(self._aligned(start, wide), middle)
            found.append((self.fit(pose, middle), pose, reading))
        _, T, reading = max(found, key=lambda one: one[0])
        near, fine = self.changes(*_NEAR_STAGE, reading), self.changes(*_FINE_STAGE, reading)
        for sign in (1.0, -1.0):
            T = self._refined(T, near, sign * self._alike_steps(T, near))
        T = self._aligned(T, fine)
        fit = self.fit(T, fine)
        if fit < _LEAST_FIT:
            raise CalibrationError(
                f"view '{self.camera.view}': no pose was found at which the drawn robot moves "
                f'like the pictures (correlation {fit:.2f}); is it the right robot, K and clock, '
                'and does the arm move through the view? A guess nearer to the truth may help'
            )

        std_mm, std_deg = self._standard_errors(T, fine)
        return CameraEstimate(
            camera=with_pose(self.camera, T),
            std_mm=std_mm,
            std_deg=std_deg,
            evidence=f'correlation of drawn and seen motion {fit:.2f} over {len(fine.pairs)} '
            'pairs of frames',
            match=fit,
        )

    def _far_pairs(self) -> np.ndarray:
        """Return (P, 2) pairs of frames between which the robot moves most."""
        count = len(self._positions)
        rows, columns = np.triu_indices(count, 1)
        apart = np.linalg.norm(self.points[rows] - self.points[columns], axis=-1).mean(axis=1)
        order = np.argsort(apart)[::-1]
        used = np.zeros(count, int)
        pairs = []
        for index in order:
            pair = rows[index], columns[index]
            if apart[index] > 0.02 and used[list(pair)].max() < 3:
                used[list(pair)] += 1
                pairs.append(pair)
        if len(pairs) < 8:
            raise _hardly_moves(self.camera.view)
        return np.array(pairs)

    def changes(self, width: int, blur: float, reading: Reading) -> Changes:
        """Return the changed pixels of all pairs, in images of a width and blur [px]."""
        small = shrunk_camera(self.camera, width)
        size = small.width, small.height
        colours = [
            cv2.resize(frame, size, interpolation=cv2.INTER_AREA).astype(np.float32)
            for frame in self._frames
        ]
        found = []
        for i, j in self.pairs:
            apart = _colour_distance(colours[i], colours[j], reading.brightness)
            changed = np.interp(apart, (reading.may, reading.surely), (0.0, 1.0))
            changed = cv2.medianBlur(changed.astype(np.float32), 3)  # noise is single pixels
            found.append(cv2.GaussianBlur(changed, (0, 0), blur))
        seen = np.stack(found)
        deviation = float(seen.std(dtype=np.float64) * np.sqrt(seen.size))
        return Changes(camera=small, pairs=self.pairs, seen=seen, blur=blur, deviation=deviation)

    def fit(self, T: FloatArray, changes: Changes) -> float:
        """Return the correlation of drawn and seen changes, -1 .. 1."""
        drawn = self._drawn(T, changes).ravel().astype(np.float64)
        drawn -= drawn.mean()
        along = np.dot(drawn, changes.seen.ravel().astype(np.float64))
        return float(along / (np.linalg.norm(drawn) * changes.deviation))

    def _drawn(self, T: FloatArray, changes: Changes) -> NDArray[np.float32]:
        """Return the expected change (P, H, W) between the images of each pair, 0 .. 1."""
        before, after = self._silhouettes(T, changes, self._parts)
        differs = (before ^ after) + np.float32(_INSIDE) * (before & after)
        return np.stack([cv2.GaussianBlur(one, (0, 0), changes.blur) for one in differs])

    def _silhouettes(
        self, T: FloatArray, changes: Changes, parts: Sequence[LinkShape]
    ) -> NDArray[np.uint8]:
        """Return the silhouettes (2, P, H, W) of the links in the frames of each pair, 0 or 1."""
        rows = np.unique(changes.pairs)
        wanted = {id(part) for part in parts}
        corners = [
            corners[rows]
            for part, corners in zip(self._parts, self._corners, strict=True)
            if id(part) in wanted
        ]
        pixels = project_points(corners, with_pose(changes.camera, T))
        return fill(pixels, changes.camera)[np.searchsorted(rows, changes.pairs.T)]

    def _aligned(self, T: FloatArray, changes: Changes) -> FloatArray:
        """Return the pose nearby at which drawn and seen changes differ least.

        Pixels that differ much, e.g. shadows and parts of the background's colour, count less.
        """
        return refine_pose(T, lambda pose: self.errors(pose, changes).ravel(), self.centre,
                       outlier=_OUTLIER)  # fmt: skip

    def errors(self, T: FloatArray, changes: Changes) -> NDArray[np.float32]:
        """Return (P, H W) drawn minus seen changes."""
        return (self._drawn(T, changes) - changes.seen).reshape(len(changes.pairs), -1)

    def _standard_errors(self, T: FloatArray, changes: Changes) -> tuple[float, float]:
        """Return the standard errors of the camera's position [mm] and direction [degrees].

        Errors of the shapes, shadows and the robot's own pattern are the same for a whole link
        in all frames, so that pixels say much less than their number: they are counted as few
        independent measurements, and the pose's changes without one link at a time are added.
        """
        errors, weights, slopes = self._linearized(T, changes)
        normal = np.asarray((weights * slopes) @ slopes.T, np.float64)
        variance = float((weights * errors**2).sum()) / _NUM_INDEPENDENT
        at_centre = np.diag(UNITS) @ np.linalg.pinv(normal) @ np.diag(UNITS) * variance
        moves = np.eye(6)  # turns about the centre shift the camera
        away = T[:3, :3].T @ (T[:3, 3] - self.centre)
        x, y, z = away
        moves[3:, :3] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
        at_camera = moves @ at_centre @ moves.T
        shift, turn = np.trace(at_camera[3:, 3:]), np.trace(at_camera[:3, :3])
        without = []
        for part in self._pixels_of_links(T, changes):
            weighted = weights[part] * slopes[:, part]
            less = np.asarray(weighted @ slopes[:, part].T, np.float64)
            gradient = np.asarray(weighted @ errors[part], np.float64)
            without.append(moves @ left_out(normal, less, gradient))
        mm, degrees = jackknife_errors(np.array(without)) if len(without) > 1 else (0.0, 0.0)
        return (
            float(np.hypot(1000 * np.sqrt(shift), mm)),
            float(np.hypot(np.degrees(np.sqrt(turn)), degrees)),
        )

    def _linearized(
        self, T: FloatArray, changes: Changes
    ) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
        """Return errors (N,), their weights (N,), and their change by each of `UNITS` (6, N)."""
        errors = self.errors(T, changes).ravel()
        slopes = np.stack(
            [(self.errors(displaced_pose(T, row, self.centre), changes)
              - self.errors(displaced_pose(T, -row, self.centre), changes)).ravel() / 2
             for row in np.diag(UNITS)]
        )  # fmt: skip
        return errors, 1 / (1 + (errors / _OUTLIER) ** 2), slopes

    def _alike_steps(self, T: FloatArray, changes: Changes) -> FloatArray:
        """Return steps (6, 6), one per row, that change the drawn pixels by equal amounts.

        The largest step has length `_STEP`. A camera that circles the robot while it looks at it
        hardly changes the pixels: there, least squares stop far from the best pose, and a simplex
        search continues from these steps.
        """
        _, weights, slopes = self._linearized(T, changes)
        values, vectors = np.linalg.eigh(np.asarray((weights * slopes) @ slopes.T, np.float64))
        steps = _STEP * vectors * np.sqrt(values[0] / values)
        return np.asarray(steps.T * UNITS, np.float64)

    def _pixels_of_links(self, T: FloatArray, changes: Changes) -> list[np.ndarray]:
        """Return the indices of the pixels at which each link is drawn, each pixel at one link."""
        owner = np.full(changes.seen.size, -1)
        links = list(dict.fromkeys(part.link for part in self._parts))
        kernel = np.ones((2 * round(2 * changes.blur) + 1,) * 2, np.uint8)
        for number, link in enumerate(links):
            parts = [part for part in self._parts if part.link == link]
            before, after = self._silhouettes(T, changes, parts)
            around = np.stack([cv2.dilate(one, kernel) for one in before | after])
            owner[np.flatnonzero(around)] = number
        found = [np.flatnonzero(owner == number) for number in range(len(links))]
        return [pixels for pixels in found if len(pixels)]

    def _refined(
        self, T: FloatArray, changes: Changes, steps: FloatArray, evaluations: int = 220
    ) -> FloatArray:
        """Return the pose nearby that fits best.

        `steps` (6, 6) are the first ones, in rows [rad, m].
        """
        result = minimize(
            lambda p: -self.fit(displaced_pose(T, p @ steps, self.centre), changes),
            np.zeros(6),
            method='Nelder-Mead',
            options={
                'initial_simplex': np.vstack([np.zeros(6), np.eye(6)]),
                'maxfev': evaluations,
                'xatol': 1e-3,
                'fatol': 1e-5,
                'adaptive': True,
            },
        )
        return displaced_pose(T, np.asarray(result.x) @ steps, self.centre)

    def _search(
        self, seed: int, progress: Callable[[Sequence[Any]], Iterable[Any]] = iter
    ) -> list[tuple[FloatArray, Reading]]:
        """The best of many upright cameras around the robot, and how each reads changes best."""
        generator = np.random.default_rng(seed)
        changes = {reading: self.changes(*_SEARCH_STAGE, reading) for reading in READINGS}
        reach = float(np.linalg.norm(self.points.reshape(-1, 3) - self.centre, axis=1).max())
        narrowest = min(self.camera.width / self.camera.K[0, 0],
                        self.camera.height / self.camera.K[1, 1])  # fmt: skip
        rough = [coarse_changes(one) for one in changes.values()]
        tried = []
        for _ in progress(range(_NUM_CANDIDATES)):
            away = reach / narrowest * generator.uniform(0.7, 3.5)
            T = random_camera(self.centre, away, reach, generator)
            fits = self.rough_fits(T, changes[READINGS[0]], rough)
            tried.append((max(fits), len(tried), T, READINGS[int(np.argmax(fits))]))
        best = best_apart(tried, reach)
        steps = np.diag([0.25] * 3 + [0.1] * 3)
        improved = [
            (self._refined(T, changes[reading], steps, evaluations=70), reading)
            for T, reading in progress(best)
        ]
        improved.sort(key=lambda one: -self.fit(one[0], changes[one[1]]))
        return improved[:3]

    def rough_fits(
        self, T: FloatArray, like: Changes, rough: Sequence[NDArray[np.float32]]
    ) -> list[float]:
        """Return the correlation of drawn and seen motion of each reading, drawn with mesh points.

        Points in place of silhouettes are fast enough to try thousands of poses.
        """
        width, height = like.camera.width // _ROUGH, like.camera.height // _ROUGH
        pixels, _ = project(with_pose(like.camera, T), T, self.points)
        cells = np.floor(np.nan_to_num(pixels, nan=-99.0) / _ROUGH).astype(int)
        inside = ((cells >= 0) & (cells < (width, height))).all(axis=-1)
        flat = np.where(inside, cells[..., 1] * width + cells[..., 0], width * height)
        there = np.zeros((len(flat), width * height + 1), np.float32)
        there[np.arange(len(flat))[:, None], flat] = 1
        differs = np.abs(np.diff(there[like.pairs, :-1], axis=1)[:, 0])
        differs -= differs.mean(axis=1, keepdims=True)
        norm = np.linalg.norm(differs) + 1e-9
        return [float((differs * seen).sum() / norm) for seen in rough]


def coarse_changes(changes: Changes) -> NDArray[np.float32]:
    """Return (P, cells) seen changes of a part of the size, without their means, of length 1."""
    pairs, height, width = changes.seen.shape
    height, width = height // _ROUGH, width // _ROUGH
    cropped = changes.seen[:, : height * _ROUGH, : width * _ROUGH]
    cells = cropped.reshape(pairs, height, _ROUGH, width, _ROUGH).mean(axis=(2, 4))
    seen = cells.reshape(pairs, -1)
    seen = seen - seen.mean(axis=1, keepdims=True)
    return seen / (np.linalg.norm(seen) + 1e-9)


def random_camera(
    centre: FloatArray, away: float, reach: float, generator: np.random.Generator
) -> FloatArray:
    """Return a random upright camera around and above a point that looks near it."""
    turn, up = generator.uniform(0, 2 * np.pi), np.arcsin(generator.uniform(-0.15, 0.98))
    ahead = -np.array([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)])
    T = np.eye(4)
    T[:3, :3] = looking_along(ahead)
    aside = generator.normal(0, 0.25 * reach, 2)
    T[:3, 3] = centre - away * ahead + T[:3, :2] @ aside
    return T


def best_apart(
    tried: Sequence[tuple[float, int, FloatArray, _Item]], reach: float
) -> list[tuple[FloatArray, _Item]]:
    """Return the best of some poses that stand apart, with what each was tried with.

    Args:
        tried: fit, number, T_base_camera (4, 4) and what it was tried with.
        reach: reach of the robot [m]; poses nearer than 15 % of it count as one.
    """
    best: list[tuple[FloatArray, _Item]] = []
    for _, _, T, item in sorted(tried, key=lambda one: one[:2], reverse=True):
        if all(np.linalg.norm(T[:3, 3] - other[:3, 3]) > 0.15 * reach for other, _ in best):
            best.append((T, item))
        if len(best) == _NUM_REFINED:
            break
    return best


def _hardly_moves(view: str) -> CalibrationError:
    return CalibrationError(
        f"view '{view}': the arm hardly moves in this recording; record one in which all joints "
        'move'
    )


def _colour_distance(
    a: NDArray[np.float32], b: NDArray[np.float32], brightness: float
) -> NDArray[np.floating]:
    """(H, W) root mean square of the channels' differences, with a share of the brightness's."""
    apart, both = a - b, a + b
    along = (apart * both).sum(axis=-1) / np.maximum(np.linalg.norm(both, axis=-1), 1.0)
    total = (apart**2).sum(axis=-1) - (1 - brightness**2) * along**2
    return np.sqrt(np.maximum(total, 0.0) / apart.shape[-1])


def _way(part: LinkShape, poses: FloatArray) -> float:
    """Return the largest distance of a part's points from their first position [m]."""
    points = _sample(part.points) @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    return float(np.linalg.norm(points - points[0], axis=-1).max())


def _in_base(points: FloatArray, poses: FloatArray) -> FloatArray:
    """Return the points (F, N, 3) of a link, transformed by its poses (F, 4, 4)."""
    return points @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]


def _sample(points: FloatArray, count: int = 12) -> FloatArray:
    """(count, 3) points inside a convex part: some of its corners, moved towards its centre."""
    chosen = points[np.linspace(0, len(points) - 1, count).astype(int)]
    shares = np.linspace(0.2, 0.9, count)[:, None]
    return points.mean(axis=0) + shares * (chosen - points.mean(axis=0))
