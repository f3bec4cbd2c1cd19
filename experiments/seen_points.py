"""How far are tools drawn from where somebody saw them, and do the stated errors hold that?

    python experiments/seen_points.py EPISODES POINTS [--ways points,same-focal] [--fitted 2]

POINTS is what `mtv-world fit camera --click` saves. Cameras are estimated from the first
points of each recording, in different ways; the others judge them. The error that a way states
from the others of all recordings but one is compared with those of that one. `recorded` judges
the calibrations of the episodes as they are. Last but one comes by how much later the joint
states are at which points that move are nearest to the pictures. --bend estimates k1 however near
the middle of the image the points are.

The points of a Franka with a Robotiq (`seen_points_droid_lab.json`) were read by eye from enlarged
frames of 320x192 with a grid, 2026-11-27: the middle between the ends of the finger tips; rows are
of 5 Hz.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
import time
from typing import Any

import numpy as np
from page import table
from scipy.stats import binomtest

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.cli.fits.several_cameras import recorded_robot
from mtv_world_ros.core.config import read_yaml
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.data.episode import Episode
from mtv_world_ros.data.episode_reader import list_episodes, read_episode, read_info
from mtv_world_ros.inspection.cameras import camera_set
from mtv_world_ros.inspection.cameras.seen_points import seen_points
from mtv_world_ros.inspection.cameras.shared_camera import estimate_shared
from mtv_world_ros.inspection.cameras.shared_estimate import expected_within, SharedEstimate
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import load_shape, RobotShape

WAYS = ('recorded', 'search', 'points', 'same-focal')
HEAD = (
    'way of starting',
    'view',
    'places',
    'fitted points: n, median [px]',
    'others: n, median, three largest [px]',
    'fx [px], fy / fx, k1',
    "the doctor's match",
    'doubted',
    'others within the 95 % that those of other recordings state',
    'joint states late by [s], standard error, moving points',
    'time [s]',
)

#: time after which points are drawn anew [s], and speed from which on they move [px/s]
_STEP_S, _MOVES = 0.05, 10.0

Points = dict[str, dict[str, list[Any]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Recordings:
    """The recordings of a folder.

    Attributes:
        episodes: R recordings.
        tracks: their joint states.
        robot: of all.
        shape: of the robot.
    """

    episodes: Sequence[Episode]
    tracks: Sequence[JointTrack]
    robot: RobotModel
    shape: RobotShape

    def beside(
        self, cameras: Sequence[CameraModel], points: Mapping[str, Any], late_s: float = 0.0
    ) -> list[FloatArray]:
        """Of each recording, (N, 2) from where its points are drawn to where they were seen [px].

        They are drawn as they are by the joint states `late_s` after they were seen.
        """
        ends = {
            episode.info.path.name: 1e-9 * float(track.stamps_ns[-1] - track.stamps_ns[0])
            for episode, track in zip(self.episodes, self.tracks, strict=True)
        }
        moved = {
            name: [(min(seconds + late_s, max(seconds, ends[name])), *place)
                   for seconds, *place in rows]
            for name, rows in points.items() if name in ends
        }  # fmt: skip
        seen = seen_points(moved, self.episodes, self.tracks, self.robot, self.shape.parts)
        found: list[list[FloatArray]] = [[] for _ in cameras]
        for point in seen:
            camera = cameras[point.recording]
            pixel, _ = project(camera, camera.T_mount_camera[None], point.position[None])
            found[point.recording].append(point.pixel - pixel[0])
        return [np.array(one).reshape(-1, 2) for one in found]

    def apart(self, cameras: Sequence[CameraModel], points: Mapping[str, Any]) -> list[FloatArray]:
        """Of each recording, how far its points are drawn from where they were seen [px]."""
        return [np.linalg.norm(one, axis=1) for one in self.beside(cameras, points)]

    def delay(self, cameras: Sequence[CameraModel], points: Mapping[str, Any]) -> str:
        """By how much later the joint states fit the pictures, by points that move."""
        here, later = (
            np.concatenate(self.beside(cameras, points, late_s)) for late_s in (0.0, _STEP_S)
        )
        speed = (here - later) / _STEP_S  # of what is drawn [px/s]
        moves = np.linalg.norm(speed, axis=1) > _MOVES
        if moves.sum() < 3:
            return f'{int(moves.sum())} points move'
        square = float((speed[moves] ** 2).sum())
        delay = float((here[moves] * speed[moves]).sum()) / square
        rest = here[moves] - delay * speed[moves]
        return f'{delay:+.3f}, {np.sqrt((rest**2).mean() / square):.3f}, {int(moves.sum())}'


def main() -> None:
    """Print a row for each way and view."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('episodes', type=Path)
    parser.add_argument('points', type=Path)
    parser.add_argument('--ways', default='points,same-focal', help=', '.join(WAYS))
    parser.add_argument('--fitted', type=int, default=2, help='points of each recording')
    parser.add_argument('--robot', help='default: that of the episodes')
    parser.add_argument('--bend', action='store_true', help='estimate k1 in any case')
    parser.add_argument('--seed', type=int, default=0)
    options = parser.parse_args()
    if options.bend:
        camera_set.LEAST_REACH = 0.0
    points: Points = read_yaml(options.points, 'points file', 'POINTS')
    fitted, others = (
        {view: {name: rows[part] for name, rows in of.items()} for view, of in points.items()}
        for part in (slice(None, options.fitted), slice(options.fitted, None))
    )
    read = recordings(options, list(points))
    rows = [
        row
        for way in options.ways.split(',')
        for row in judged(way, read, fitted, others, options.seed)
    ]
    print(table(HEAD, rows))


def recordings(options: argparse.Namespace, views: Sequence[str]) -> Recordings:
    """Read the episodes; cameras may be unknown."""
    paths = list_episodes(options.episodes)
    file = recorded_robot(paths[0], read_info(paths[0]).robot)
    robot = load_robot(robot_path(options.robot) if options.robot else file)
    episodes = [
        read_episode(
            path, views=views, with_masks=False, robot=robot, unknown_mount=robot.base_link
        )
        for path in paths
    ]
    tracks = [
        JointTrack(states, robot)
        for states in (episode.joint_states for episode in episodes)
        if states is not None
    ]
    return Recordings(episodes=episodes, tracks=tracks, robot=robot, shape=load_shape(robot))


def judged(
    way: str, read: Recordings, fitted: Points, others: Points, seed: int
) -> Iterator[list[str]]:
    """Yield the row of each view."""
    views = list(fitted)
    if way == 'recorded':
        for view in views:
            cameras = [episode.cameras[view] for episode in read.episodes]
            yield [way, view, '–', *_distances(read, view, cameras, fitted, others), '–', '–',
                   _covered(read.apart(cameras, others[view])),
                   _delay(read, cameras, view, fitted, others), '–']  # fmt: skip
        return
    unknown = [e.unknown.get(view, '') for e in read.episodes for view in views]
    for group in [views] if way == 'same-focal' else [[view] for view in views]:
        begun = time.monotonic()
        found = estimate_shared(
            read.episodes,
            group,
            read.robot,
            read.shape.parts,
            guess=False,
            points=None if way == 'search' else {view: fitted[view] for view in group},
            focal_known=not any('intrinsics' in what for what in unknown),
            seed=seed,
        )
        seconds = time.monotonic() - begun
        for view, one in zip(group, found, strict=True):
            yield [way, view, str(len(set(one.places.place.tolist()))),
                   *_distances(read, view, one.cameras, fitted, others),
                   *_matches(one), _covered(read.apart(one.cameras, others[view])),
                   _delay(read, one.cameras, view, fitted, others), f'{seconds:.0f}']  # fmt: skip


def _delay(
    read: Recordings, cameras: Sequence[CameraModel], view: str, fitted: Points, others: Points
) -> str:
    rows = {name: [*fitted[view][name], *others[view][name]] for name in fitted[view]}
    return read.delay(cameras, rows)


def _distances(
    read: Recordings, view: str, cameras: Sequence[CameraModel], fitted: Points, others: Points
) -> list[str]:
    near = np.concatenate(read.apart(cameras, fitted[view]))
    each = read.apart(cameras, others[view])
    far = np.concatenate(each)
    names = [episode.info.path.name for episode in read.episodes]
    where = [
        f'{name} at {row[0]:g} s'
        for name, here in zip(names, each, strict=True)
        for row, _ in zip(others[view].get(name, []), here, strict=True)
    ]
    largest = [f'{far[n]:.1f} ({where[n]})' for n in np.argsort(-far)[:3]]
    K, bend = cameras[0].K, cameras[0].distortion
    return [
        f'{len(near)}, {np.median(near):.1f}',
        f'{len(far)}, {np.median(far):.1f}, {", ".join(largest)}',
        f'{K[0, 0]:.1f}, {K[1, 1] / K[0, 0]:.3f}, {bend[0] if len(bend) else 0:.3f}',
    ]


def _matches(found: SharedEstimate) -> list[str]:
    matches = [measure.match_here for measure in found.measures]
    doubted = sum(bool(found.doubts(number)) for number in range(len(matches)))
    return [f'{min(matches):.2f} to {max(matches):.2f}', f'{doubted} of {len(matches)}']


def _covered(apart: Sequence[FloatArray]) -> str:
    """How many points are within what the points of the other recordings state."""
    held, count = 0, 0
    for number, here in enumerate(apart):
        elsewhere = np.concatenate([*apart[:number], *apart[number + 1 :]])
        held += int((here <= expected_within(elsewhere)).sum())
        count += len(here)
    low, high = binomtest(held, count).proportion_ci(method='wilson')
    stated = expected_within(np.concatenate(apart))
    return f'{held} of {count} ({low:.0%} to {high:.0%}); {stated:.1f} px by all'


if __name__ == '__main__':
    main()
