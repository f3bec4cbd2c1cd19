"""Estimates one fixed camera from several recordings: its places, and its lens.

Recordings in which it stands at the same place share a pose, all share the lens. What is
compared is what `FixedCamera` compares: where drawn silhouettes say that pictures change.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.inspection.camera_pose import displaced_pose, UNITS
from mtv_world_ros.inspection.cameras.fixed_camera import (
    best_apart,
    Changes,
    coarse_changes,
    FixedCamera,
    random_camera,
    Reading,
    READINGS,
)
from mtv_world_ros.inspection.places import CameraPlaces, turn_between

#: image width and blur of the search without a guess [px]
_SEARCH_STAGE = (64, 1.5)
#: image width and blur of the first fit of its candidates [px]
_FIRST_STAGE = (64, 3.0)
#: image width and blur of the fits that follow, from coarse to fine [px]
_STAGES = ((80, 3.0), (120, 2.0), (160, 1.2))
#: background shift below which two recordings share one camera pose [fraction of image width]
_SAME_POSE_SHIFT = 0.06
#: outlier threshold: a pixel counts less where drawn and seen change differ by more than this
_OUTLIER = 0.3
#: search without a guess: number of camera poses tried
_NUM_CANDIDATES = 2400
#: search without a guess: number of best candidates that are refined
_NUM_REFINED = 2
#: recordings that the search without a guess looks at
_NUM_SEARCHED = 4
#: cameras that points are fitted from
_NUM_POINT_STARTS = 24
#: standard deviation of where a place is, against where the background says [`UNITS`]
_OWN_STD = np.array([3.0] * 3 + [2.0] * 3)
#: standard deviation of where somebody sees a tool point [share of the image width]
_POINT_STD = 0.006
#: weight of these against the mean squared errors of a recording's pixels
_STIFFNESS = 0.003
#: error of a point that the camera does not see [standard deviations]
_BEHIND = 30.0
#: units of a lens: logarithms of fx and of fy / fx, and k1; images that were resized to another
#: aspect have pixels that are not square
_LENS_UNITS = np.array([0.02, 0.02, 0.02])
#: prior standard deviation of the lens where the intrinsics are known, in units of the lens
_CALIBRATED_LENS_STD = np.array([0.003, 0.001, 0.001])
#: prior standard deviation of the lens where the intrinsics are a guess, in units of the lens
_GUESSED_LENS_STD = np.array([0.35, 0.1, 0.1])
#: minimum number of clicked points from which the distortion k1 is estimated
LEAST_POINTS = 8
#: k1 is estimated if a tenth of the points are farther than this from the principal point
#: [fraction of image width]: k1 = -0.1 shifts such a point by 1 % of the width if fx is 0.4 of it
LEAST_REACH = 0.25


def with_lens(camera: CameraModel, lens: FloatArray) -> CameraModel:
    """Return the camera with another lens.

    Args:
        camera: camera with the lens that `lens` changes.
        lens: (3,) logarithms of factors of fx and of fy / fx, and what is added to k1.
    """
    K = camera.K.copy()
    K[:2, :2] *= np.exp([lens[0], lens[0] + lens[1]])[:, None]
    if not lens[2]:
        return replace(camera, K=K)
    distortion = np.zeros(max(5, len(camera.distortion)))
    distortion[: len(camera.distortion)] = camera.distortion
    distortion[0] += lens[2]
    model = 'plumb_bob' if camera.distortion_model == 'none' else camera.distortion_model
    return replace(camera, K=K, distortion_model=model, distortion=distortion)


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenPoint:
    """A tool point that somebody saw in a frame.

    Attributes:
        recording: number of the recording.
        seconds: time after the recording's first joint state [s].
        position: (3,) position of the tool point, by the joint states, in the base link [m].
        pixel: (2,) pixel at which it was seen [px].
    """

    recording: int
    seconds: float
    position: FloatArray
    pixel: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class JointState:
    """Poses and lens of a camera in several recordings.

    Attributes:
        poses: (4, 4) T_base_camera [m] by place.
        lens: (3,) change of the lens against the given camera, for `through`.
        own_steps: (6,) change of the pose apart from the common one, by place, in `UNITS`.
    """

    poses: Mapping[int, FloatArray]
    lens: FloatArray = field(default_factory=lambda: np.zeros(3))
    own_steps: Mapping[int, FloatArray] = field(default_factory=dict)

    def own(self, place: int) -> FloatArray:
        """Return the own steps of a place, (6,)."""
        return self.own_steps.get(place, np.zeros(6))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Step:
    """Normal equations of a place: six of its pose, and those of the lens."""

    normal: FloatArray
    gradient: FloatArray


class JointCamera:
    """Estimator of the camera poses of all places, and of one lens.

    Args:
        recordings: estimators of the single recordings, one of each recording and view.
        places: number of the place of each; views have places of their own.
        intrinsics_known: whether the lens is that of a calibration.
        views: number of the view of each; None = all are of one. Views share the lens (against
            that of each one's camera) and nothing else.
    """

    def __init__(
        self,
        recordings: Sequence[FixedCamera],
        places: Sequence[int],
        *,
        intrinsics_known: bool,
        views: Sequence[int] | None = None,
    ) -> None:
        self._recordings, self._places = list(recordings), list(places)
        self._view_of = dict(zip(self._places, views or [0] * len(places), strict=True))
        self._known = intrinsics_known
        self._lens_std = _CALIBRATED_LENS_STD if intrinsics_known else _GUESSED_LENS_STD
        self._free = [0, 1]
        self._centre = np.mean([one.centre for one in recordings], axis=0)
        self._points: dict[int, list[SeenPoint]] = {}
        self._seen: dict[tuple[int, int, float, Reading], Changes] = {}

    def estimate(
        self,
        places: CameraPlaces,
        guess: JointState | None = None,
        points: Sequence[SeenPoint] = (),
        seed: int = 0,
        *,
        rough: bool = False,
    ) -> JointState:
        """Estimate all poses and the lens.

        Args:
            places: places of the recordings.
            guess: guess to start from; None = from points, or from cameras all around.
            points: seen tool points, of any of the recordings.
            seed: seed of the search.
            rough: leave out the finer images.
        """
        self._take(points)
        if guess is not None:
            starts = [guess]
        elif points:
            starts = [self.from_points(places, points, seed)]
        else:
            near = [n for n in places.near(_SAME_POSE_SHIFT) if n < len(self._recordings)][
                :_NUM_SEARCHED
            ]
            found = [
                self.refined(self._spread(near[0], T, lens, places), (_FIRST_STAGE,), 10, near)
                for T, lens in self.search(near, seed)
            ]
            found.sort(key=lambda state: -float(self.fits(state, _FIRST_STAGE, near).mean()))
            starts = found[:_NUM_REFINED]
            starts = [self._respread(near[0], state, places) for state in starts]
        ends = [self.refined(start, _STAGES[:1], 14) for start in starts]
        best = max(ends, key=lambda state: float(self.fits(state, _STAGES[0]).mean()))
        if guess is None:
            best = self._respread(places.near(_SAME_POSE_SHIFT)[0], best, places)
        return best if rough else self.refined(best, _STAGES[1:], 9)

    def together(
        self, starts: Sequence[JointState], points: Sequence[SeenPoint] = ()
    ) -> JointState:
        """Return the best state near some that were found view by view.

        Args:
            starts: starts with the poses of all places. A camera farther away with a longer lens
                looks much alike, so that one start does not lead to all focal lengths.
            points: seen tool points, of any of the recordings.
        """
        self._take(points)
        ends = [self.refined(start, _STAGES[:1], 14) for start in starts]
        return self.refined(min(ends, key=self._cost_of), _STAGES[1:], 14)

    def _cost_of(self, state: JointState) -> float:
        stage, numbers = _STAGES[0], range(len(self._recordings))
        return self._cost(state, {n: self._read(n, state, stage) for n in numbers})

    def _take(self, points: Sequence[SeenPoint]) -> None:
        """Store the clicked points; k1 is also estimated if enough points are near the border."""
        self._points = {}
        for point in points:
            self._points.setdefault(self._places[point.recording], []).append(point)
        cameras = [self._recordings[point.recording].camera for point in points]
        away = [
            float(np.linalg.norm(point.pixel - camera.K[:2, 2])) / camera.width
            for point, camera in zip(points, cameras, strict=True)
        ]
        bends = all(camera.distortion_model != 'equidistant' for camera in cameras)
        shown = len(away) >= LEAST_POINTS and np.quantile(away, 0.9) >= LEAST_REACH
        self._free = [0, 1, 2] if shown and bends and not self._known else [0, 1]

    def from_points(
        self,
        places: CameraPlaces,
        points: Sequence[SeenPoint],
        seed: int = 0,
        lens: FloatArray | None = None,
    ) -> JointState:
        """Return the state at which tool points are seen where somebody saw them.

        Args:
            places: places of the recordings.
            points: points of any of the recordings.
            seed: seed of the cameras that are tried.
            lens: (3,), held there; None = fx and fy are estimated.
        """
        camera = self._recordings[0].camera
        focal = camera.K[[0, 1], [0, 1]]
        first = points[0].recording
        turns = np.stack([self._turn(first, p.recording, places, focal) for p in points])
        X = np.stack([point.position for point in points])
        seen = np.stack([point.pixel for point in points])
        generator = np.random.default_rng(seed)
        std = (np.minimum(self._lens_std, 0.3) if lens is None else _CALIBRATED_LENS_STD)[:2]
        middle = np.zeros(3) if lens is None else lens

        def errors(p: FloatArray) -> FloatArray:
            local = (X - p[3:6]) @ cv2.Rodrigues(p[:3])[0]
            local = np.einsum('nij,nj->ni', turns, local)
            depth = np.maximum(local[:, 2:], 0.05)
            pixels = local[:, :2] / depth * focal * np.exp([p[6], p[6] + p[7]])
            apart = (pixels + camera.K[:2, 2] - seen) / (0.012 * camera.width)
            return np.concatenate([apart.ravel(), (p[6:] - middle[:2]) / std])

        best = None
        reach = float(np.linalg.norm(X - X.mean(axis=0), axis=1).max()) + 0.2
        for _ in range(_NUM_POINT_STARTS if lens is None else _NUM_POINT_STARTS // 3):
            T = random_camera(X.mean(axis=0), generator.uniform(0.3, 2.5), reach, generator)
            start = np.concatenate([cv2.Rodrigues(T[:3, :3])[0].ravel(), T[:3, 3], middle[:2]])
            found = least_squares(errors, start, loss='soft_l1', max_nfev=60)
            if best is None or found.cost < best.cost:
                best = found
        assert best is not None
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(best.x[:3])[0], best.x[3:6]
        return self._spread(first, T, np.append(best.x[6:], middle[2]), places)

    def _turn(self, a: int, b: int, places: CameraPlaces, focal: FloatArray) -> FloatArray:
        """Return (3, 3) that takes rays of recording a to those of b.

        By a third one where none match.
        """
        if places.place[a] == places.place[b]:
            return np.eye(3)
        width = self._recordings[0].camera.width
        for path in ((a, b), *((a, c, b) for c in np.argsort(places.apart[a]))):
            steps = list(zip(path, path[1:], strict=False))
            if all(tuple(sorted(step)) in places.matches for step in steps):
                R = np.eye(3)
                for x, y in steps:
                    pairs = places.matches[min(x, y), max(x, y)]
                    square = pairs * np.array([1.0, focal[0] / focal[1]])
                    R = turn_between(square if x < y else square[:, ::-1], focal[0] / width) @ R
                return R
        return np.eye(3)

    def _spread(
        self, number: int, T: FloatArray, lens: FloatArray, places: CameraPlaces
    ) -> JointState:
        """Return the state with a recording's pose, the others turned as their backgrounds say."""
        focal = with_lens(self._recordings[0].camera, lens).K[[0, 1], [0, 1]]
        poses = {}
        for other, place in enumerate(self._places):
            if place not in poses:
                turned = T.copy()
                turned[:3, :3] = T[:3, :3] @ self._turn(number, other, places, focal).T
                poses[place] = turned
        return JointState(poses=poses, lens=lens)

    def _respread(self, number: int, state: JointState, places: CameraPlaces) -> JointState:
        T = state.poses[self._places[number]]
        spread = self._spread(number, T, state.lens, places)
        return replace(spread, poses={**spread.poses, self._places[number]: T})

    def _changes(self, number: int, stage: tuple[int, float], reading: Reading) -> Changes:
        key = (number, *stage, reading)
        if key not in self._seen:
            self._seen[key] = self._recordings[number].changes(*stage, reading)
        return self._seen[key]

    def search(self, members: Sequence[int], seed: int = 0) -> list[tuple[FloatArray, FloatArray]]:
        """Poses and lenses from cameras all around that fit some recordings best, best first.

        Args:
            members: numbers of recordings in which the camera stands at about the same place.
            seed: seed of the cameras tried.
        """
        generator = np.random.default_rng(seed)
        members = members[:_NUM_SEARCHED]
        chosen = [self._recordings[n] for n in members]
        changes = [{r: self._changes(n, _SEARCH_STAGE, r) for r in READINGS} for n in members]
        rough = [[coarse_changes(found) for found in each.values()] for each in changes]
        points = np.concatenate([one.points.reshape(-1, 3) for one in chosen])
        reach = float(np.linalg.norm(points - self._centre, axis=1).max())
        camera = changes[0][READINGS[0]].camera
        tried = []
        for _ in range(_NUM_CANDIDATES):
            zoom = 1.0 if self._known else float(np.exp(generator.normal(0, 0.3)))
            lens = np.array([np.log(zoom), 0.0, 0.0])
            narrowest = min(camera.width / camera.K[0, 0], camera.height / camera.K[1, 1]) / zoom
            away = reach / narrowest * generator.uniform(0.5, 3.5)
            T = random_camera(self._centre, away, reach, generator)
            fits = [
                max(one.rough_fits(T, _through(each[READINGS[0]], lens), cells))
                for one, each, cells in zip(chosen, changes, rough, strict=True)
            ]
            tried.append((float(np.mean(fits)), len(tried), T, lens))
        return best_apart(tried, reach)

    def fits(
        self,
        state: JointState,
        stage: tuple[int, float] = _STAGES[1],
        members: Sequence[int] | None = None,
    ) -> FloatArray:
        """Return (R,) correlation of drawn and seen changes of recordings; None = of all."""
        found = []
        for number in range(len(self._recordings)) if members is None else members:
            one, T = self._recordings[number], state.poses[self._places[number]]
            read = [_through(self._changes(number, stage, r), state.lens) for r in READINGS]
            found.append(max(one.fit(T, changes) for changes in read))
        return np.array(found)

    def refined(
        self,
        state: JointState,
        stages: Sequence[tuple[int, float]] = _STAGES,
        iterations: int = 8,
        members: Sequence[int] | None = None,
    ) -> JointState:
        """Return the state nearby at which drawn and seen changes differ least."""
        numbers = range(len(self._recordings)) if members is None else members
        for stage in stages:
            changes = {n: self._read(n, state, stage) for n in numbers}
            state = self._aligned(state, changes, iterations)
        return state

    def _read(self, number: int, state: JointState, stage: tuple[int, float]) -> Changes:
        """Return the changes of a recording, read in the way that fits better."""
        one, T = self._recordings[number], state.poses[self._places[number]]
        read = [self._changes(number, stage, reading) for reading in READINGS]
        return max(read, key=lambda found: one.fit(T, _through(found, state.lens)))

    def _aligned(
        self, state: JointState, changes: Mapping[int, Changes], iterations: int
    ) -> JointState:
        damping, cost, steps = 1e-3, self._cost(state, changes), None
        for _ in range(iterations):
            steps = steps or self._steps(state, changes)  # a step that was refused changes nothing
            tried = self._moved(state, steps, damping)
            there = self._cost(tried, changes)
            if there < cost:
                gain = (cost - there) / cost
                state, cost, damping, steps = tried, there, damping / 4, None
                if gain < 1e-4:
                    break
            else:
                damping *= 12
                if damping > 1e4:
                    break
        return state

    def _errors(
        self, number: int, T: FloatArray, lens: FloatArray, changes: Mapping[int, Changes]
    ) -> NDArray[np.floating]:
        one = self._recordings[number]
        return one.errors(T, _through(changes[number], lens)).ravel()

    def _cost(self, state: JointState, changes: Mapping[int, Changes]) -> float:
        pulls = [(state.own(place) / _OWN_STD) ** 2 for place in state.poses]
        prior = float(((state.lens / self._lens_std) ** 2).sum() + np.sum(pulls))
        for place in self._points.keys() & state.poses.keys():
            apart = self._point_errors(place, state.poses[place], state.lens)
            prior += 2 * float(np.log1p((apart**2).sum(axis=1) / 2).sum())
        total = _STIFFNESS / _OUTLIER**2 * prior
        for number in changes:
            T = state.poses[self._places[number]]
            errors = self._errors(number, T, state.lens, changes)
            total += float(np.log1p((errors / _OUTLIER) ** 2).mean())
        return total

    def _point_errors(self, place: int, T: FloatArray, lens: FloatArray) -> FloatArray:
        """(N, 2) how far points are drawn from where they were seen [standard deviations]."""
        points = self._points[place]
        camera = with_lens(self._recordings[points[0].recording].camera, lens)
        positions = np.stack([point.position for point in points])
        apart = project(camera, T, positions)[0] - np.stack([point.pixel for point in points])
        return np.nan_to_num(apart / (_POINT_STD * camera.width), nan=_BEHIND)

    def _add_points(self, state: JointState, found: dict[int, _Step]) -> None:
        """Add the seen points to the normal equations of their places."""
        for place in self._points.keys() & found.keys():
            T, lens = state.poses[place], state.lens
            now = self._point_errors(place, T, lens)
            table = self._slopes(
                T, lens, lambda T, lens, at=place: self._point_errors(at, T, lens).ravel()
            )
            weight = _STIFFNESS / (1 + (now**2).sum(axis=1).repeat(2) / 2)
            step = found[place]
            found[place] = _Step(
                normal=step.normal + (weight * table) @ table.T,
                gradient=step.gradient + (weight * table) @ now.ravel(),
            )

    def _slopes(
        self,
        T: FloatArray,
        lens: FloatArray,
        errors: Callable[[FloatArray, FloatArray], NDArray[np.floating]],
    ) -> NDArray[np.floating]:
        """(6 + L, N) change of errors by a unit of the pose and of what is free of the lens."""
        turns = [
            errors(displaced_pose(T, row, self._centre), lens)
            - errors(displaced_pose(T, -row, self._centre), lens)
            for row in np.diag(UNITS)
        ]
        bends = [
            errors(T, lens + step) - errors(T, lens - step)
            for step in np.diag(_LENS_UNITS)[self._free]
        ]
        return np.stack([*turns, *bends]) / 2

    def _steps(self, state: JointState, changes: Mapping[int, Changes]) -> dict[int, _Step]:
        """Return the normal equations by place."""
        found: dict[int, _Step] = {}
        for number in changes:
            place = self._places[number]
            T, lens = state.poses[place], state.lens
            now = self._errors(number, T, lens, changes)
            table = self._slopes(
                T, lens, lambda T, lens, at=number: self._errors(at, T, lens, changes)
            )
            weighted = table / (1 + (now / _OUTLIER) ** 2) / now.size
            step = _Step(
                normal=np.asarray(weighted @ table.T, np.float64),
                gradient=np.asarray(weighted @ now, np.float64),
            )
            before = found.get(place)
            found[place] = step if before is None else _Step(
                normal=before.normal + step.normal, gradient=before.gradient + step.gradient
            )  # fmt: skip
        self._add_points(state, found)
        return found

    def _moved(self, state: JointState, steps: Mapping[int, _Step], damping: float) -> JointState:
        """Return the state after a damped step of what is shared and of each place's own.

        All share the lens, the places of a view a pose. A place's own six numbers are eliminated
        first (Schur complement).
        """
        free, num = self._free, len(self._free)
        size = 6 * (1 + max(self._view_of.values())) + num
        shared, slope = np.zeros((size, size)), np.zeros(size)
        stiff = (_STIFFNESS * (_LENS_UNITS / self._lens_std) ** 2)[free]
        shared[-num:, -num:] = np.diag(stiff)
        slope[-num:] = stiff * (state.lens / _LENS_UNITS)[free]
        solved = {}
        for place, step in steps.items():
            normal = step.normal + damping * np.diag(np.diag(step.normal))
            own = normal[:6, :6] + np.diag(_STIFFNESS / _OWN_STD**2)
            pull = step.gradient[:6] + _STIFFNESS / _OWN_STD**2 * state.own(place)
            gain = np.linalg.solve(own, np.column_stack([normal[:6], pull]))
            at = self._shared_rows(place, size)
            shared[np.ix_(at, at)] += normal - normal[:, :6] @ gain[:, :-1]
            slope[at] += step.gradient - normal[:, :6] @ gain[:, -1]
            solved[place] = gain
        step_of_all = -np.linalg.solve(shared + 1e-12 * np.eye(size), slope)
        step_of_all *= min(1.0, 4.0 / max(float(np.abs(step_of_all).max()), 1e-9))
        poses, own_steps = dict(state.poses), dict(state.own_steps)
        for place, gain in solved.items():
            of_view = step_of_all[self._shared_rows(place, size)]
            own_step = (-gain[:, :-1] @ of_view - gain[:, -1]).clip(-4, 4)
            change = of_view[:6] + own_step
            poses[place] = displaced_pose(poses[place], change * UNITS, self._centre)
            own_steps[place] = state.own(place) + own_step
        lens = state.lens.copy()
        lens[free] += step_of_all[-num:] * _LENS_UNITS[free]
        return JointState(poses=poses, lens=lens, own_steps=own_steps)

    def _shared_rows(self, place: int, size: int) -> list[int]:
        """Return the rows of what a place shares: its view's pose, and the lens."""
        first = 6 * self._view_of[place]
        return [*range(first, first + 6), *range(size - len(self._free), size)]


def _through(changes: Changes, lens: FloatArray) -> Changes:
    return replace(changes, camera=with_lens(changes.camera, lens))
