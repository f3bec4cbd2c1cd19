"""Camera poses and focal length of the views of several recordings, compared with a guess."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2
from scipy.stats import f as f_distribution

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.core.config import read_yaml
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import CalibrationError, ConfigError, nearest
from mtv_world_ros.data.episode import Episode
from mtv_world_ros.inspection.cameras.finger_tips import tip_middles
from mtv_world_ros.inspection.cameras.fixed_camera import FixedCamera
from mtv_world_ros.inspection.cameras.joint_camera import (
    JointCamera,
    JointState,
    SeenPoint,
    with_lens,
)
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.inspection.motion_residual import (
    measure_residual,
    MotionResidual,
    ResidualSearch,
)
from mtv_world_ros.inspection.places import background, CameraPlaces, find_places
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import LinkShape, moving_links

#: number of frames of a recording that are compared
_NUM_FRAMES = 10
#: number of directions in which the outermost mesh points of a link are drawn
_NUM_CORNERS = 20
#: settings of the motion residual of `mtv-world check` without a search for better settings
_MEASURE = ResidualSearch(max_pairs=24, lags_s=(0.0,), rolls_deg=(), zooms=())
#: distance of drawn and seen robot above which a pose is reported as doubtful [fraction of image
#: width]
_DOUBTED = 0.02
#: minimum correlation of drawn and seen motion of a pose that is not doubtful: on ten real
#: recordings a view with the right focal length had .35 to .47, and .23 to .32 with one a
#: third too long; another view had .37 to .56 with any of three focal lengths
_LEAST_MATCH = 0.335
#: of the points of a recording each third is left out of a first fit, and tells how good it is: on
#: ten real recordings points that poses were fitted to are .5 and .9 px away, others 1.3 and 3.2
_LEFT_OUT = 3
#: minimum number of clicked points of a view
_LEAST_POINTS = 4
#: outlier threshold of clicked points, as a factor of the median error; of 80 hasty clicks on real
#: video two are outliers (4 and 10 px of 320: a finger was hidden), of 87 careful ones none
_OUTLIER_MEDIANS = 3.5
#: clicked points with a smaller error are never outliers [fraction of image width]
_OUTLIER_MIN_ERROR = 0.01


def expected_within(apart_px: FloatArray) -> float:
    """Return the distance from where it is within which 95 % of tool points are drawn [px].

    NaN = not known.

    Args:
        apart_px: (N,) distances of points that were not fitted to, taken for normal in x and y
            [px].
    """
    count = len(apart_px)
    if not count:
        return np.nan
    return float(np.sqrt(np.mean(apart_px**2) * f_distribution.ppf(0.95, 2, 2 * count)))


def stated_error(apart_px: FloatArray) -> float | None:
    """Return the standard error in x and in y of where points are drawn [px]; None = not known.

    95 % of points are within `expected_within` with this error.
    """
    within = expected_within(apart_px)
    return float(within / np.sqrt(chi2.ppf(0.95, 2))) if within > 0 else None


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedEstimate:
    """Estimated camera poses of one view in several recordings.

    Attributes:
        cameras: cameras of each recording, (R,).
        places: numbers of the places, for recordings that share one.
        measures: offset of the moving pixels from the robot in each recording, as `check` measures
            it.
        guess_measures: such offsets under the camera poses that the user guessed; empty without a
            guess.
        kept_guess: whether the guess fits better and is what `cameras` has.
        focal_px: focal length, estimated or given [px].
        bent: whether the lens' k1 was estimated, too.
        fits: (R,) correlation of drawn and seen changes of each recording.
        apart_px: (N,) distances between drawn and seen tool points [px]: those left out of a first
            fit, from that fit; the last one from the fit to all points.
        strays: seen points that contradict the others, and their distances from where they are
            drawn [px].
    """

    cameras: tuple[CameraModel, ...]
    places: CameraPlaces
    measures: tuple[MotionResidual, ...]
    guess_measures: tuple[MotionResidual, ...]
    kept_guess: bool
    focal_px: float
    bent: bool
    fits: FloatArray
    apart_px: FloatArray
    strays: tuple[tuple[SeenPoint, float], ...]

    @property
    def within_px(self) -> float:
        """`expected_within` of the seen points that were left out [px]."""
        return expected_within(self.apart_px)

    def doubts(self, number: int) -> str:
        """Return the reason why the pose of a recording may be wrong; empty if there is none."""
        measure = self.measures[number]
        if measure.reason:
            return f'not checked: {measure.reason}'
        if measure.match_here < _LEAST_MATCH:
            return (
                f'drawn and seen motion correlate by {measure.match_here:.2f}, below '
                f'{_LEAST_MATCH:g}: pose or focal length may be wrong'
            )
        if self._is_beside(number):
            apart = float(np.hypot(*measure.shift_px)) / self.cameras[number].width
            return f'the robot moves {apart:.1%} of the width beside where it is drawn'
        return ''

    def objection(self, number: int) -> str:
        """Return the reason why the pose of a recording is not to be relied on; empty = it is.

        A pose that a recording could not check, or with too little correlation to rely on, is
        good if another recording of the same place confirms it; not where the robot is seen to
        move beside where it is drawn.
        """
        doubt = self.doubts(number)
        if doubt and self.confirming(number):
            return ''
        return doubt

    def confirming(self, number: int) -> tuple[int, ...]:
        """Return the recordings that confirm the pose of another recording of their place.

        None do where that recording contradicts them.
        """
        if self._is_beside(number):
            return ()
        same = np.flatnonzero(self.places.place == self.places.place[number])
        return tuple(int(n) for n in same if n != number and not self.doubts(int(n)))

    def _is_beside(self, number: int) -> bool:
        """Return whether the robot moves beside where it is drawn."""
        measure = self.measures[number]
        if measure.reason:
            return False
        apart = float(np.hypot(*measure.shift_px)) / self.cameras[number].width
        return apart > _DOUBTED and measure.match > 1.05 * measure.match_here


@dataclass(frozen=True, slots=True, kw_only=True)
class _View:
    """A view in several recordings, before it is estimated."""

    name: str
    cameras: list[CameraModel]
    recordings: list[FixedCamera]
    places: CameraPlaces
    points: list[SeenPoint]
    left_out: list[SeenPoint]
    joint: JointCamera

    @property
    def numbers(self) -> list[int]:
        """Place of each recording."""
        return [int(n) for n in self.places.place]

    @property
    def given(self) -> JointState:
        """The poses of the recordings."""
        rows = reversed(list(zip(self.numbers, self.cameras, strict=True)))
        return JointState(poses={place: camera.T_mount_camera for place, camera in rows})


def estimate_shared(
    episodes: Sequence[Episode],
    views: Sequence[str],
    robot: RobotModel,
    shapes: Sequence[LinkShape],
    *,
    guess: bool,
    points: Mapping[str, Mapping[str, Sequence[Any]]] | None = None,
    focal_known: bool = True,
    seed: int = 0,
) -> tuple[SharedEstimate, ...]:
    """Estimate fixed cameras of one make, each from several recordings.

    Args:
        episodes: episodes with cameras of the views, whose intrinsics and, with `guess`, poses are
            starts.
        views: names of the V views that share their focal length.
        robot: robot of the recordings.
        shapes: shapes of its links.
        guess: start from the poses of the recordings.
        points: seen tool points by view and by the name of the episode: (time [s], x, y [px]).
        focal_known: whether the focal length is right as it is.
        seed: seed of the search.

    Returns:
        One of each view.

    Raises:
        CalibrationError: a camera is on the arm, or the arm stands still.
        ConfigError: a point is of no episode or of no frame.
    """
    tracks = [_joints(episode, robot) for episode in episodes]
    each = [
        _view(episodes, view, robot, shapes, tracks, (points or {}).get(view, {}), focal_known)
        for view in views
    ]
    together = _Together(each, focal_known)
    tested = together.found(guess, seed)
    states = tested
    if any(view.left_out for view in each):
        states = together.fitted([tested], [[*view.points, *view.left_out] for view in each])
    return tuple(
        _judged(view, state, without, episodes, robot, shapes, tracks, guess=guess)
        for view, state, without in zip(each, states, tested, strict=True)
    )


def _view(
    episodes: Sequence[Episode],
    view: str,
    robot: RobotModel,
    shapes: Sequence[LinkShape],
    tracks: Sequence[JointTrack],
    points: Mapping[str, Sequence[Any]],
    focal_known: bool,
) -> _View:
    cameras = [_on_base(episode.cameras[view], robot) for episode in episodes]
    focal = float(np.median([camera.K[0, 0] for camera in cameras]))
    cameras = [
        with_lens(camera, np.array([np.log(focal / camera.K[0, 0]), 0.0, 0.0]))
        for camera in cameras
    ]
    recordings = [
        FixedCamera(
            episode.images[view], camera, robot, shapes, joints,
            num_frames=_NUM_FRAMES, num_corners=_NUM_CORNERS,
        )
        for episode, camera, joints in zip(episodes, cameras, tracks, strict=True)
    ]  # fmt: skip
    places = find_places([background(episode.images[view]) for episode in episodes])
    numbers = [int(n) for n in places.place]
    fitted, left_out = (
        seen_points(part, episodes, tracks, robot, shapes) for part in _parted(points)
    )
    return _View(
        name=view,
        cameras=cameras,
        recordings=recordings,
        places=places,
        points=fitted,
        left_out=left_out,
        joint=JointCamera(recordings, numbers, intrinsics_known=focal_known),
    )


class _Together:
    """Views that share their lens.

    Args:
        each: estimators of the single views.
        focal_known: whether the lens is that of a calibration.
    """

    def __init__(self, each: Sequence[_View], focal_known: bool) -> None:
        self._each, self._focal_known = each, focal_known
        self._places = np.cumsum([0, *(1 + max(view.numbers) for view in each)]).tolist()
        self._rows = np.cumsum([0, *(len(view.numbers) for view in each)]).tolist()
        self._joint = each[0].joint
        if len(each) > 1:
            self._joint = JointCamera(
                [one for view in each for one in view.recordings],
                [first + n for view, first in self._with_places() for n in view.numbers],
                intrinsics_known=focal_known,
                views=[number for number, view in enumerate(each) for _ in view.numbers],
            )

    def _with_places(self) -> Iterator[tuple[_View, int]]:
        """Return each view with the number of its first place."""
        return zip(self._each, self._places, strict=False)

    def found(self, guess: bool, seed: int) -> list[JointState]:
        """Return the state of each view, by the points that are not left out."""
        if len(self._each) == 1:
            view = self._each[0]
            start = view.given if guess else None
            return [view.joint.estimate(view.places, start, view.points, seed)]
        own = [_start(view, guess, seed) for view in self._each]
        lenses = [state.lens for state in own]
        lenses = [*lenses, np.mean(lenses, axis=0)]
        candidates = [
            [
                view.joint.from_points(view.places, view.points, seed, lens)
                if view.points and not guess
                else replace(state, lens=lens)
                for view, state in zip(self._each, own, strict=True)
            ]
            for lens in lenses[: 1 if self._focal_known else None]
        ]
        return self.fitted(candidates, [view.points for view in self._each])

    def fitted(
        self,
        candidates: Sequence[Sequence[JointState]],
        points: Sequence[Sequence[SeenPoint]],
    ) -> list[JointState]:
        """The state of each view, fitted together from the best of some starts, to its points."""
        seen = [
            replace(point, recording=point.recording + row)
            for of_one, row in zip(points, self._rows, strict=False)
            for point in of_one
        ]
        starts = [
            JointState(
                poses={
                    first + place: T
                    for state, first in zip(states, self._places, strict=False)
                    for place, T in state.poses.items()
                },
                lens=states[0].lens,
            )
            for states in candidates
        ]
        found = self._joint.together(starts, seen)
        return [
            JointState(poses={n: found.poses[first + n] for n in view.numbers}, lens=found.lens)
            for view, first in self._with_places()
        ]


def _start(view: _View, guess: bool, seed: int) -> JointState:
    """Return a view's own state, roughly."""
    start = view.given if guess else None
    return view.joint.estimate(view.places, start, view.points, seed, rough=True)


def _judged(
    view: _View,
    state: JointState,
    without: JointState,
    episodes: Sequence[Episode],
    robot: RobotModel,
    shapes: Sequence[LinkShape],
    tracks: Sequence[JointTrack],
    *,
    guess: bool,
) -> SharedEstimate:
    """Return the better of guess and result by the measure of `check`.

    Its error is that of the state that was fitted without the points that were left out.
    """

    def measured(found: Sequence[CameraModel]) -> tuple[MotionResidual, ...]:
        rows = zip(episodes, found, tracks, strict=True)
        return tuple(
            measure_residual(episode.images[view.name], camera, robot, shapes, joints, _MEASURE)
            for episode, camera, joints in rows
        )

    def placed(found: JointState) -> list[CameraModel]:
        return [
            replace(with_lens(camera, found.lens), T_mount_camera=found.poses[place])
            for camera, place in zip(view.cameras, view.numbers, strict=True)
        ]

    ends = placed(state)
    measures, before = measured(ends), measured(view.cameras) if guess else ()
    kept = bool(before) and _mean_match(before) > _mean_match(measures)
    tested = view.cameras if kept else placed(without)
    best = view.cameras if kept else ends
    apart_px = np.array([_apart(point, tested[point.recording]) for point in view.left_out])
    return SharedEstimate(
        cameras=tuple(replace(camera, error_px=stated_error(apart_px)) for camera in best),
        places=view.places,
        measures=before if kept else measures,
        guess_measures=before,
        kept_guess=kept,
        focal_px=float(best[0].K[0, 0]),
        bent=bool(state.lens[2]) and not kept,
        fits=view.joint.fits(view.given if kept else state),
        apart_px=apart_px,
        strays=_strays([*view.points, *view.left_out], best),
    )


def _strays(
    points: Sequence[SeenPoint], cameras: Sequence[CameraModel]
) -> tuple[tuple[SeenPoint, float], ...]:
    """Return the points that contradict the others, the worst first."""
    apart = [_apart(point, cameras[point.recording]) for point in points]
    if not apart:
        return ()
    least = max(_OUTLIER_MEDIANS * float(np.median(apart)), _OUTLIER_MIN_ERROR * cameras[0].width)
    found = [(point, away) for point, away in zip(points, apart, strict=True) if not away <= least]
    return tuple(sorted(found, key=lambda pair: -np.nan_to_num(pair[1], nan=np.inf)))


def _apart(point: SeenPoint, camera: CameraModel) -> float:
    """Return the distance of a tool point, as it is drawn, from where it was seen [px]."""
    pixels, _ = project(camera, camera.T_mount_camera[None], point.position[None])
    return float(np.linalg.norm(pixels[0] - point.pixel))


def _mean_match(measures: Sequence[MotionResidual]) -> float:
    found = [measure.match_here for measure in measures if not measure.reason]
    return float(np.mean(found)) if found else -1.0


def _joints(episode: Episode, robot: RobotModel) -> JointTrack:
    if episode.joint_states is None:
        raise CalibrationError(f"'{episode.info.path}' has no joint_states")
    return JointTrack(episode.joint_states, robot)


def _on_base(camera: CameraModel, robot: RobotModel) -> CameraModel:
    if camera.mount_link in moving_links(robot):
        raise CalibrationError(
            f"view '{camera.view}' is on the arm ('{camera.mount_link}'): several recordings "
            'are compared for a camera that stands still; give one recording, and --mount-link'
        )
    rest = robot.link_poses(camera.mount_link, np.zeros((1, len(robot.joint_names))))[0]
    return replace(camera, mount_link=robot.base_link, T_mount_camera=rest @ camera.T_mount_camera)


def _parted(
    points: Mapping[str, Sequence[Any]],
) -> tuple[dict[str, list[Any]], dict[str, list[Any]]]:
    """Return the rows that poses are fitted to, and those that are left out."""
    parts: tuple[dict[str, list[Any]], dict[str, list[Any]]] = ({}, {})
    for name, rows in points.items():
        for number, row in enumerate(rows, start=1):
            parts[number % _LEFT_OUT == 0].setdefault(name, []).append(row)
    return parts


def seen_points(
    points: Mapping[str, Sequence[Any]],
    episodes: Sequence[Episode],
    tracks: Sequence[JointTrack],
    robot: RobotModel,
    shapes: Sequence[LinkShape],
) -> list[SeenPoint]:
    """Return the positions of the seen tool points, by the joint states.

    Args:
        points: points by the name of the episode: (time [s], x, y [px]), or with the arm's number.
        episodes: R recordings; points of others are left out.
        tracks: joint states of each.
        robot: robot of the recordings.
        shapes: shapes of its links.

    Raises:
        ConfigError: a point is of a time without joint states.
    """
    names = [episode.info.path.name for episode in episodes]
    found = []
    for name, rows in points.items():
        if name not in names:
            continue
        number = names.index(name)
        for seconds, x, y, *arm in rows:
            stamp = tracks[number].stamps_ns[:1] + round(seconds * 1e9)
            if not tracks[number].covers(stamp).all():
                raise ConfigError(
                    f"points: '{name}' has no joint states at {seconds:g} s; times are from the "
                    'first joint state on'
                )
            which = int(arm[0]) if arm else 0
            position = tip_middles(robot, shapes, tracks[number].at(stamp), which)[0]
            found.append(
                SeenPoint(
                    recording=number,
                    seconds=float(seconds),
                    position=position,
                    pixel=np.array([x, y], float),
                )
            )
    return found


def load_points(path: Path, view: str, arms: Sequence[str] = ()) -> dict[str, list[FloatArray]]:
    """Read seen tool points: `{<view>: {<episode>: [[seconds, x, y], ...]}}` [s, px].

    Args:
        path: path of the file.
        view: name of the view.
        arms: names of the robot's arms; a row may end with one, whose number is returned. Rows
            without are of the first arm.

    Raises:
        ConfigError: the file is no such table, or has fewer than four points of the view.
    """
    values = read_yaml(path, 'points file', '--points')
    rows = values.get(view) if isinstance(values, dict) else None
    try:
        found = {
            str(name): [_row(row, arms) for row in given]
            for name, given in dict(rows or {}).items()
        }
    except (TypeError, ValueError) as error:
        form = '[seconds, x, y, arm]' if len(arms) > 1 else '[seconds, x, y]'
        raise ConfigError(f"'{path}', view '{view}': {error}; a row is {form}") from error
    count = sum(map(len, found.values()))
    if count < _LEAST_POINTS:
        raise ConfigError(
            f"'{path}' has {count} points of view '{view}'; {_LEAST_POINTS} or more are needed, "
            'far apart: where the tool point is, seconds from the first joint state on'
        )
    return found


def _row(row: Any, arms: Sequence[str]) -> FloatArray:
    """Return time, x and y, and the number of the arm that a row names."""
    if isinstance(row, list) and len(row) == 4:
        *row, arm = row
        if arm not in arms:
            raise ValueError(f"'{arm}' is no arm{nearest(str(arm), arms)}; arms are {[*arms]}")
        return np.append(_row(row, arms), arms.index(arm))
    numbers = np.asarray(row, float)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise ValueError(f'{row!r} is not three numbers')
    return numbers
