"""Cameras that stand still in several recordings: where a fit starts, and its residuals.

Recordings in which a camera stands at the same place share a pose, all recordings share the lens.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.transforms import looking_along
from mtv_world_ros.inspection.cameras.lens import with_lens
from mtv_world_ros.inspection.cameras.outlines import (
    coarse_changes,
    ImageStage,
    Outlines,
    READINGS,
)
from mtv_world_ros.inspection.cameras.seen_points import points_residual, SeenPoint
from mtv_world_ros.inspection.cameras.solver import CameraState, Residual, solve, Unknowns
from mtv_world_ros.inspection.places import CameraPlaces, turn_between

#: search without a guess: image size
_SEARCH_STAGE = ImageStage(64, 1.5)
#: search without a guess: first fit of the best candidates
_FIRST_STAGE = ImageStage(64, 3.0)
#: search without a guess: number of camera poses tried around the robot
_NUM_CANDIDATES = 2400
#: search without a guess: number of best candidates that are fitted
_NUM_FITTED = 6
#: search without a guess: number of recordings that are looked at
_NUM_SEARCHED = 4
#: search without a guess: candidates nearer to each other count as one [reach of the robot]
_APART = 0.15
#: background shift below which two recordings share one camera pose [fraction of image width]
_SAME_POSE_SHIFT = 0.06
#: number of cameras that a fit to points starts from, and where the lens is held
_NUM_POINT_STARTS, _NUM_POINT_STARTS_LENS_HELD = 24, 8
#: standard deviation and outlier threshold of points in their first fit, from any start
#: [fraction of image width], [standard deviations]
_POINT_START_STD, _POINT_START_OUTLIER = 0.012, 10.0
#: standard deviation of where somebody sees a tool point [fraction of image width]
_POINT_STD = 0.006
#: weight of points and priors against the mean loss of a recording's pixels
_STIFFNESS = 0.033
#: prior standard deviation of the lens where the intrinsics are known, in units of the lens
CALIBRATED_LENS_STD = np.array([0.003, 0.001, 0.001])
#: prior standard deviation of the lens where the intrinsics are a guess, in units of the lens
GUESSED_LENS_STD = np.array([0.35, 0.1, 0.1])
#: minimum number of clicked points from which the distortion k1 is estimated
LEAST_POINTS = 8
#: k1 is estimated if a tenth of the points are farther than this from the principal point
#: [fraction of image width]: k1 = -0.1 shifts such a point by 1 % of the width if fx is 0.4 of it
LEAST_REACH = 0.25

#: seen points of each view, by the number of the view
PointsOfViews = Mapping[int, Sequence[SeenPoint]]


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewRows:
    """Recordings of one view in a set.

    Attributes:
        first_row: number of its first recording in the set.
        first_place: number of its first place in the set.
        places: places of its recordings, numbered from 0.
    """

    first_row: int
    first_place: int
    places: CameraPlaces

    @property
    def rows(self) -> list[int]:
        """Numbers of its recordings in the set."""
        return [self.first_row + n for n in range(len(self.places.place))]

    def place(self, recording: int) -> int:
        """Return the number in the set of the place of one of its recordings."""
        return self.first_place + int(self.places.place[recording])


class CameraSet:
    """Cameras of one or more views, in one or more recordings.

    Args:
        outlines: outlines of each recording, view after view.
        places: places of each view; all have the same number of recordings.
        lens_std: (3,) prior standard deviation of the lens, which all views share (against that of
            each one's camera); None = the lens is held.
    """

    def __init__(
        self,
        outlines: Sequence[Outlines],
        places: Sequence[CameraPlaces],
        lens_std: FloatArray | None = None,
    ) -> None:
        self._outlines = list(outlines)
        self.views: list[ViewRows] = []
        row, number = 0, 0
        for one in places:
            self.views.append(ViewRows(first_row=row, first_place=number, places=one))
            row, number = row + len(one.place), number + 1 + int(one.place.max())
        self._place_of = [
            view.place(n) for view in self.views for n in range(len(view.places.place))
        ]
        self._lens_std = lens_std
        self._centre = np.mean([one.centre for one in outlines], axis=0)

    def refined(
        self,
        state: CameraState,
        stages: Iterable[ImageStage],
        evaluations: int,
        *,
        rows: Sequence[int] | None = None,
        points: PointsOfViews | None = None,
        scaled: bool = False,
        whiten: bool = False,
    ) -> tuple[CameraState, float]:
        """Return the state nearby at which drawn and seen differ least, and the loss there.

        Args:
            state: state to start from.
            stages: image sizes of one fit after the other.
            evaluations: maximum number of evaluations of each fit.
            rows: recordings that are fitted to; None = all.
            points: seen points of their views.
            scaled: see `Outlines.residual`.
            whiten: see `solve`.
        """
        points = points or {}
        view_of = {self._place_of[row]: number for number, view in enumerate(self.views)
                   for row in view.rows}  # fmt: skip
        unknowns = Unknowns(
            centre=self._centre,
            free_lens=() if self._lens_std is None else self._free_lens(points),
            lens_std=np.ones(3) if self._lens_std is None else self._lens_std,
            view_of=view_of,
            stiffness=_STIFFNESS,
        )
        cost = np.inf
        seen = self._point_residuals(points)
        for stage in stages:
            silhouettes = []
            for row in range(len(self._outlines)) if rows is None else rows:
                one, place = self._outlines[row], self._place_of[row]
                changes = one.read(stage, state.poses[place], state.lens)
                silhouettes.append(one.residual(place, changes, scaled=scaled))
            state, cost = solve(
                [*silhouettes, *seen], unknowns, state, evaluations=evaluations, whiten=whiten
            )
        return state, cost

    def _free_lens(self, points: PointsOfViews) -> list[int]:
        """Return what is free of the lens; k1 is if enough points are near the border."""
        assert self._lens_std is not None
        away, bends = [], True
        for number, of_view in points.items():
            for point in of_view:
                camera = self._camera(number, point)
                away.append(float(np.linalg.norm(point.pixel - camera.K[:2, 2])) / camera.width)
                bends &= camera.distortion_model != 'equidistant'
        shown = len(away) >= LEAST_POINTS and np.quantile(away, 0.9) >= LEAST_REACH
        guessed = self._lens_std[0] >= GUESSED_LENS_STD[0]
        return [0, 1, 2] if shown and bends and guessed else [0, 1]

    def _camera(self, view: int, point: SeenPoint) -> CameraModel:
        return self._outlines[self.views[view].first_row + point.recording].camera

    def _point_residuals(self, points: PointsOfViews) -> list[Residual]:
        """Return a residual for the points of each place."""
        by_place: dict[int, list[SeenPoint]] = {}
        cameras = {}
        for number, of_view in points.items():
            for point in of_view:
                place = self.views[number].place(point.recording)
                by_place.setdefault(place, []).append(point)
                cameras[place] = self._camera(number, point)
        return [
            points_residual(
                place, of_place, cameras[place], std_px=_POINT_STD * cameras[place].width,
                outlier=np.sqrt(2), weight=_STIFFNESS,
            )
            for place, of_place in by_place.items()
        ]  # fmt: skip

    def fits(
        self, state: CameraState, stage: ImageStage, rows: Sequence[int] | None = None
    ) -> FloatArray:
        """Return (R,) correlation of drawn and seen changes of recordings; None = of all."""
        found = []
        for row in range(len(self._outlines)) if rows is None else rows:
            one, T = self._outlines[row], state.poses[self._place_of[row]]
            found.append(one.fit(T, state.lens, one.read(stage, T, state.lens)))
        return np.array(found)

    def from_points(
        self,
        number: int,
        points: Sequence[SeenPoint],
        seed: int = 0,
        lens: FloatArray | None = None,
    ) -> CameraState:
        """Return the state that best explains tool points that were marked in images.

        Args:
            number: number of the view.
            points: marked points, of any recording of the view.
            seed: seed of the first guesses of the camera.
            lens: (3,) lens that is held; None = fx and fy are estimated.
        """
        first, camera = points[0].recording, self._camera(number, points[0])
        view = self.views[number]
        focal = camera.K[[0, 1], [0, 1]]
        turns = np.stack([_turn(view.places, first, p.recording, camera, focal) for p in points])
        residual = points_residual(
            view.place(first), points, camera, turns=turns,
            std_px=_POINT_START_STD * camera.width, outlier=_POINT_START_OUTLIER,
        )  # fmt: skip
        positions = np.stack([point.position for point in points])
        centre = positions.mean(axis=0)
        unknowns = Unknowns(
            centre=centre,
            free_lens=() if self._lens_std is None or lens is not None else (0, 1),
            lens_std=np.ones(3) if self._lens_std is None else np.minimum(self._lens_std, 0.3),
            stiffness=1.0,
        )
        generator = np.random.default_rng(seed)
        reach = float(np.linalg.norm(positions - centre, axis=1).max()) + 0.2
        ends = []
        for _ in range(_NUM_POINT_STARTS if lens is None else _NUM_POINT_STARTS_LENS_HELD):
            T = random_camera(centre, generator.uniform(0.3, 2.5), reach, generator)
            start = CameraState(
                poses={view.place(first): T}, lens=np.zeros(3) if lens is None else lens
            )
            ends.append(solve([residual], unknowns, start, evaluations=60, tolerance=1e-6))
        best = min(ends, key=lambda end: end[1])[0]
        return self.spread(number, first, best.poses[view.place(first)], best.lens)

    def spread(self, number: int, first: int, T: FloatArray, lens: FloatArray) -> CameraState:
        """Return the state with a recording's pose, the others turned as their backgrounds say.

        Args:
            number: number of the view.
            first: recording of the view with the pose.
            T: (4, 4) the pose.
            lens: (3,) the lens.
        """
        view = self.views[number]
        camera = self._outlines[view.first_row + first].camera
        focal = with_lens(camera, lens).K[[0, 1], [0, 1]]
        poses = {view.place(first): T}
        for other in range(len(view.places.place)):
            if view.place(other) not in poses:
                turned = T.copy()
                turned[:3, :3] = T[:3, :3] @ _turn(view.places, first, other, camera, focal).T
                poses[view.place(other)] = turned
        return CameraState(poses=poses, lens=lens)

    def around(
        self,
        number: int,
        seed: int = 0,
        progress: Callable[[Iterable[Any]], Iterable[Any]] = iter,
    ) -> list[CameraState]:
        """Return states from cameras all around that fit some recordings best, best first.

        Args:
            number: number of the view.
            seed: seed of the cameras tried.
            progress: wraps what is tried, e.g. in a progress bar.
        """
        view = self.views[number]
        near = view.places.near(_SAME_POSE_SHIFT)[:_NUM_SEARCHED]
        rows = [view.first_row + n for n in near]
        ends = []
        for T, lens in progress(self._best_around(rows, seed, progress)):
            start = self.spread(number, near[0], T, lens)
            state, _ = self.refined(start, [_FIRST_STAGE], 12, rows=rows)
            ends.append((float(self.fits(state, _FIRST_STAGE, rows).mean()), state))
        ends.sort(key=lambda end: -end[0])
        return [self.respread(number, state) for _, state in ends]

    def respread(self, number: int, state: CameraState) -> CameraState:
        """Return a state whose poses are turned from that of the most central recording."""
        near = self.views[number].places.near(_SAME_POSE_SHIFT)[0]
        return self.spread(number, near, state.poses[self.views[number].place(near)], state.lens)

    def _best_around(
        self, rows: Sequence[int], seed: int, progress: Callable[[Iterable[Any]], Iterable[Any]]
    ) -> list[tuple[FloatArray, FloatArray]]:
        """Return poses and lenses that fit best, the best first, apart from each other."""
        generator = np.random.default_rng(seed)
        chosen = [self._outlines[row] for row in rows]
        changes = [[one.changes(_SEARCH_STAGE, reading) for reading in READINGS] for one in chosen]
        rough = [[coarse_changes(found) for found in each] for each in changes]
        points = np.concatenate([one.points.reshape(-1, 3) for one in chosen])
        reach = float(np.linalg.norm(points - self._centre, axis=1).max())
        camera = changes[0][0].camera
        narrowest = min(camera.width / camera.K[0, 0], camera.height / camera.K[1, 1])
        guessed = self._lens_std is not None and self._lens_std[0] >= GUESSED_LENS_STD[0]
        tried = []
        for _ in progress(range(_NUM_CANDIDATES)):
            zoom = float(np.exp(generator.normal(0, 0.3))) if guessed else 1.0
            lens = np.array([np.log(zoom), 0.0, 0.0])
            away = reach / (narrowest / zoom) * generator.uniform(0.5, 3.5)
            T = random_camera(self._centre, away, reach, generator)
            fits = [
                max(one.rough_fits(T, replace(each[0], camera=with_lens(each[0].camera, lens)),
                                   cells))
                for one, each, cells in zip(chosen, changes, rough, strict=True)
            ]  # fmt: skip
            tried.append((float(np.mean(fits)), T, lens))
        best: list[tuple[FloatArray, FloatArray]] = []
        for _, T, lens in sorted(tried, key=lambda one: -one[0]):
            if all(np.linalg.norm(T[:3, 3] - b[:3, 3]) > _APART * reach for b, _ in best):
                best.append((T, lens))
            if len(best) == _NUM_FITTED:
                break
        return best


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


def _turn(
    places: CameraPlaces, a: int, b: int, camera: CameraModel, focal: FloatArray
) -> FloatArray:
    """Return (3, 3) that takes rays of recording a to those of b.

    By a third one where none match.
    """
    if places.place[a] == places.place[b]:
        return np.eye(3)
    for path in ((a, b), *((a, c, b) for c in np.argsort(places.apart[a]))):
        steps = list(zip(path, path[1:], strict=False))
        if all(tuple(sorted(step)) in places.matches for step in steps):
            R = np.eye(3)
            for x, y in steps:
                pairs = places.matches[min(x, y), max(x, y)]
                square = pairs * np.array([1.0, focal[0] / focal[1]])
                square = square if x < y else square[:, ::-1]
                R = turn_between(square, focal[0] / camera.width) @ R
            return R
    return np.eye(3)
