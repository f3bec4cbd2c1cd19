"""Tool points that somebody saw in frames: files of them, and their residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.core.config import read_yaml
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import ConfigError, UnknownNameError
from mtv_world_ros.core.transforms import inverse
from mtv_world_ros.data.episode import Episode
from mtv_world_ros.inspection.cameras.finger_tips import tip_middles
from mtv_world_ros.inspection.cameras.lens import with_lens
from mtv_world_ros.inspection.cameras.solver import Residual
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import LinkShape

#: minimum number of clicked points of a view
_LEAST_POINTS = 4
#: depth of a point that is behind the camera or nearer, so that its error still has a slope [m]
_LEAST_DEPTH_M = 0.05
#: error of a point that the lens does not show [standard deviations]
_NOT_SHOWN = 30.0


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


def points_residual(
    place: int,
    points: Sequence[SeenPoint],
    camera: CameraModel,
    *,
    std_px: float,
    outlier: float,
    weight: float = 1.0,
    turns: FloatArray | None = None,
) -> Residual:
    """Return how far points are drawn from where they were seen, as a residual of a pose.

    Args:
        place: number of the pose.
        points: N points.
        camera: camera whose lens the estimated one differs from.
        std_px: standard deviation of a seen point [px].
        outlier: threshold of errors that count less [standard deviations].
        weight: weight of the sum of the squared errors.
        turns: (N, 3, 3) rotation from the camera's frame at the place to that at the place where
            the point was seen; None = it is the same.
    """
    positions = np.stack([point.position for point in points])
    seen = np.stack([point.pixel for point in points])

    def errors(T: FloatArray, lens: FloatArray) -> FloatArray:
        to_camera = inverse(T)
        local = positions @ to_camera[:3, :3].T + to_camera[:3, 3]
        if turns is not None:
            local = np.einsum('nij,nj->ni', turns, local)
        local[:, 2] = np.maximum(local[:, 2], _LEAST_DEPTH_M)
        pixels, _ = project(with_lens(camera, lens), np.eye(4), local)
        return np.nan_to_num((pixels - seen) / std_px, nan=_NOT_SHOWN).ravel()

    return Residual(
        place=place, errors=errors, outlier=outlier, weight=weight * outlier**2 * seen.size
    )


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
            raise UnknownNameError('', arm, arms, is_not=' is no arm', listed='; arms are')
        return np.append(_row(row, arms), arms.index(arm))
    numbers = np.asarray(row, float)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise ValueError(f'{row!r} is not three numbers')
    return numbers
