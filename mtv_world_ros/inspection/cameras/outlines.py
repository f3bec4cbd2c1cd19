"""Silhouettes of a robot that moves, as residuals of the pose of a camera that stands still.

Between two frames the picture changes where the robot was and where it is. The robot's
silhouettes, drawn by joint states and a pose, say where that should be; the pose is the one at
which drawn and seen changes agree most. It needs no markers and no feature on the robot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.cameras.silhouettes import project_points
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.data.episode import Track
from mtv_world_ros.inspection.camera_pose import covered_frames, shrunk_camera, with_pose
from mtv_world_ros.inspection.cameras.lens import with_lens
from mtv_world_ros.inspection.cameras.solver import Residual
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.robot.mesh_pieces import outermost
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import fill, LinkShape, moving_links


class ImageStage(NamedTuple):
    """Image size of one step of a fit.

    Attributes:
        width: width to which the images are shrunk [px].
        blur: standard deviation of the blur [px]. With a wide one, distant silhouettes still
            attract each other.
    """

    width: int
    blur: float


#: outlier threshold: a pixel counts less where drawn and seen change differ by more than this
_OUTLIER = 0.3
#: drawn change of a pixel that the robot covers in both frames, where the image may change or not
_INSIDE = 0.3
#: outlier threshold of scaled changes: none is one, as in a correlation
_SCALED_OUTLIER = 10.0
#: distance of the pixels that a fit compares; blurred images hold no more [px]
_STRIDE = 2
#: links that move less are left out, because an arm at rest does not constrain the pose [m]
_STILL_M = 0.02
#: shrink factor of the images that candidate poses are compared on
_ROUGH = 4


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


class Outlines:
    """Outlines of the robot in the frames of one view of one recording.

    Args:
        track: frames of the view.
        camera: camera in the robot's base link; its lens is the one that others differ from.
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
        num_frames: int,
        num_corners: int,
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
        self._changes: dict[tuple[ImageStage, Reading], Changes] = {}

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

    def changes(self, stage: ImageStage, reading: Reading) -> Changes:
        """Return the changed pixels of all pairs, at the size of a stage."""
        key = stage, reading
        if key not in self._changes:
            self._changes[key] = self._read(stage, reading)
        return self._changes[key]

    def read(self, stage: ImageStage, T: FloatArray, lens: FloatArray) -> Changes:
        """Return the changes in the reading that fits a pose better."""
        found = [self.changes(stage, reading) for reading in READINGS]
        return max(found, key=lambda one: self.fit(T, lens, one))

    def _read(self, stage: ImageStage, reading: Reading) -> Changes:
        small = shrunk_camera(self.camera, stage.width)
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
            found.append(cv2.GaussianBlur(changed, (0, 0), stage.blur))
        seen = np.stack(found)
        deviation = float(seen.std(dtype=np.float64) * np.sqrt(seen.size))
        return Changes(
            camera=small, pairs=self.pairs, seen=seen, blur=stage.blur, deviation=deviation
        )

    def fit(self, T: FloatArray, lens: FloatArray, changes: Changes) -> float:
        """Return the correlation of drawn and seen changes, -1 .. 1."""
        drawn = self._drawn(T, _through(changes, lens)).ravel().astype(np.float64)
        drawn -= drawn.mean()
        along = np.dot(drawn, changes.seen.ravel().astype(np.float64))
        return float(along / (np.linalg.norm(drawn) * changes.deviation))

    def residual(self, place: int, changes: Changes, *, scaled: bool = False) -> Residual:
        """Return drawn minus seen changes as a residual of the pose at a place.

        Pixels that differ much, e.g. shadows and parts of the background's colour, count less.

        Args:
            place: number of the place.
            changes: changed pixels.
            scaled: give the drawn changes the mean and the deviation of the seen ones. The sum of
                the squared errors is least then where the correlation is largest.
        """

        def errors(T: FloatArray, lens: FloatArray) -> NDArray[np.floating]:
            drawn = self._drawn(T, _through(changes, lens))[:, ::_STRIDE, ::_STRIDE]
            seen = changes.seen[:, ::_STRIDE, ::_STRIDE]
            if scaled:
                drawn = drawn - drawn.mean()
                drawn *= seen.std() / max(float(drawn.std()), 1e-9)
                seen = seen - seen.mean()
            return (drawn - seen).ravel()

        outlier = _SCALED_OUTLIER if scaled else _OUTLIER
        return Residual(place=place, errors=errors, outlier=outlier)

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

    def pixels_of_links(self, T: FloatArray, changes: Changes) -> list[np.ndarray]:
        """Return the indices of the errors at which each link is drawn, each at one link."""
        owner = np.full(changes.seen[:, ::_STRIDE, ::_STRIDE].size, -1)
        links = list(dict.fromkeys(part.link for part in self._parts))
        kernel = np.ones((2 * round(2 * changes.blur) + 1,) * 2, np.uint8)
        for number, link in enumerate(links):
            parts = [part for part in self._parts if part.link == link]
            before, after = self._silhouettes(T, changes, parts)
            around = np.stack([cv2.dilate(one, kernel) for one in before | after])
            owner[np.flatnonzero(around[:, ::_STRIDE, ::_STRIDE])] = number
        found = [np.flatnonzero(owner == number) for number in range(len(links))]
        return [pixels for pixels in found if len(pixels)]

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


def _through(changes: Changes, lens: FloatArray) -> Changes:
    return replace(changes, camera=with_lens(changes.camera, lens)) if lens.any() else changes


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
