"""Estimates the cameras of the views of several recordings, compared with a guess."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.data.episode import Episode
from mtv_world_ros.inspection.cameras.camera_set import (
    CALIBRATED_LENS_STD,
    CameraSet,
    GUESSED_LENS_STD,
    PointsOfViews,
)
from mtv_world_ros.inspection.cameras.lens import with_lens
from mtv_world_ros.inspection.cameras.outlines import ImageStage, Outlines
from mtv_world_ros.inspection.cameras.seen_points import seen_points, SeenPoint
from mtv_world_ros.inspection.cameras.shared_estimate import SharedEstimate, stated_error
from mtv_world_ros.inspection.cameras.solver import CameraState
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.inspection.motion_residual import (
    measure_residual,
    MotionResidual,
    ResidualSearch,
)
from mtv_world_ros.inspection.places import background, find_places
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import LinkShape, moving_links

#: number of frames of a recording that are compared
_NUM_FRAMES = 10
#: number of directions in which the outermost mesh points of a link are drawn
_NUM_CORNERS = 20
#: image sizes of the fits, from coarse to fine
STAGES = (ImageStage(80, 3.0), ImageStage(120, 2.0), ImageStage(160, 1.2))
#: search without a guess: number of best candidates that all recordings are fitted from
_NUM_STARTS = 2
#: settings of the motion residual of `mtv-world check` without a search for better settings
_MEASURE = ResidualSearch(max_pairs=24, lags_s=(0.0,), rolls_deg=(), zooms=())
#: of the points of a recording each third is left out of a first fit, and tells how good it is: on
#: ten real recordings points that poses were fitted to are .5 and .9 px away, others 1.3 and 3.2
_LEFT_OUT = 3
#: outlier threshold of clicked points, as a factor of the median error; of 80 hasty clicks on real
#: video two are outliers (4 and 10 px of 320: a finger was hidden), of 87 careful ones none
_OUTLIER_MEDIANS = 3.5
#: clicked points with a smaller error are never outliers [fraction of image width]
_OUTLIER_MIN_ERROR = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class _View:
    """A view in several recordings, before it is estimated."""

    number: int
    name: str
    cameras: list[CameraModel]
    points: list[SeenPoint]
    left_out: list[SeenPoint]


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
        _view(number, episodes, view, robot, shapes, tracks, (points or {}).get(view, {}))
        for number, view in enumerate(views)
    ]
    cameras = CameraSet(
        [
            Outlines(
                episode.images[view.name], camera, robot, shapes, joints,
                num_frames=_NUM_FRAMES, num_corners=_NUM_CORNERS,
            )
            for view in each
            for episode, camera, joints in zip(episodes, view.cameras, tracks, strict=True)
        ],
        [find_places([background(e.images[view.name]) for e in episodes]) for view in each],
        CALIBRATED_LENS_STD if focal_known else GUESSED_LENS_STD,
    )  # fmt: skip
    tested = _found(cameras, each, guess=guess, focal_known=focal_known, seed=seed)
    state = tested
    if any(view.left_out for view in each):
        everything = {view.number: [*view.points, *view.left_out] for view in each}
        state, _ = cameras.refined(tested, STAGES, 14, points=everything)
    return tuple(
        _judged(cameras, view, state, tested, episodes, robot, shapes, tracks, guess=guess)
        for view in each
    )


def _view(
    number: int,
    episodes: Sequence[Episode],
    view: str,
    robot: RobotModel,
    shapes: Sequence[LinkShape],
    tracks: Sequence[JointTrack],
    points: Mapping[str, Sequence[Any]],
) -> _View:
    cameras = [_on_base(episode.cameras[view], robot) for episode in episodes]
    focal = float(np.median([camera.K[0, 0] for camera in cameras]))
    fitted, left_out = (
        seen_points(part, episodes, tracks, robot, shapes) for part in _parted(points)
    )
    return _View(
        number=number,
        name=view,
        cameras=[
            with_lens(camera, np.array([np.log(focal / camera.K[0, 0]), 0.0, 0.0]))
            for camera in cameras
        ],
        points=fitted,
        left_out=left_out,
    )


def _found(
    cameras: CameraSet, each: Sequence[_View], *, guess: bool, focal_known: bool, seed: int
) -> CameraState:
    """Return the state of all views, by the points that are not left out.

    Several views are fitted one by one first: a camera farther away with a longer lens looks much
    alike, so that one start does not lead to all focal lengths.
    """
    points = {view.number: view.points for view in each if view.points}
    own = [_alone(cameras, view, guess=guess, seed=seed) for view in each]
    state = own[0]
    if len(each) > 1:
        lenses = [one.lens for one in own]
        lenses = [*lenses, np.mean(lenses, axis=0)][: 1 if focal_known else None]
        starts = []
        for lens in lenses:
            states = [
                cameras.from_points(view.number, view.points, seed, lens)
                if view.points and not guess
                else one
                for view, one in zip(each, own, strict=True)
            ]
            poses = {place: T for one in states for place, T in one.poses.items()}
            starts.append(CameraState(poses=poses, lens=lens))
        state = _best(cameras, starts, points)
    return cameras.refined(state, STAGES[1:], 14, points=points)[0]


def _alone(cameras: CameraSet, view: _View, *, guess: bool, seed: int) -> CameraState:
    """Return a rough state of a view by itself."""
    rows = cameras.views[view.number].rows
    points = {view.number: view.points} if view.points else {}
    if guess:
        return _best(cameras, [_given(cameras, view)], points, rows)
    if points:
        starts = [cameras.from_points(view.number, view.points, seed)]
    else:
        starts = cameras.around(view.number, seed)[:_NUM_STARTS]
    return cameras.respread(view.number, _best(cameras, starts, points, rows))


def _best(
    cameras: CameraSet,
    starts: Sequence[CameraState],
    points: PointsOfViews,
    rows: Sequence[int] | None = None,
) -> CameraState:
    """Return the best of the states near some starts, on coarse images."""
    ends = [cameras.refined(start, STAGES[:1], 14, rows=rows, points=points) for start in starts]
    return min(ends, key=lambda end: end[1])[0]


def _given(cameras: CameraSet, view: _View) -> CameraState:
    """Return the poses that the recordings have; the first of a place counts."""
    places = cameras.views[view.number]
    rows = reversed(list(enumerate(view.cameras)))
    return CameraState(poses={places.place(n): camera.T_mount_camera for n, camera in rows})


def _judged(
    cameras: CameraSet,
    view: _View,
    state: CameraState,
    without: CameraState,
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

    places = cameras.views[view.number]

    def placed(found: CameraState) -> list[CameraModel]:
        return [
            replace(with_lens(camera, found.lens), T_mount_camera=found.poses[places.place(n)])
            for n, camera in enumerate(view.cameras)
        ]

    ends = placed(state)
    measures, before = measured(ends), measured(view.cameras) if guess else ()
    kept = bool(before) and _mean_match(before) > _mean_match(measures)
    tested = view.cameras if kept else placed(without)
    best = view.cameras if kept else ends
    apart_px = np.array([_apart(point, tested[point.recording]) for point in view.left_out])
    return SharedEstimate(
        cameras=tuple(replace(camera, error_px=stated_error(apart_px)) for camera in best),
        places=places.places,
        measures=before if kept else measures,
        guess_measures=before,
        kept_guess=kept,
        focal_px=float(best[0].K[0, 0]),
        bent=bool(state.lens[2]) and not kept,
        fits=cameras.fits(_given(cameras, view) if kept else state, STAGES[1], places.rows),
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
