"""Which faults of a recording does `mtv-world doctor` find, and which right ones does it pass?

    python benchmark/doctor_faults.py DATASET [DATASET ...] [--repeats 20] [--minutes 60]

Views of cameras that stand still are judged as they are and with one thing wrong at a time: the
camera turned about each axis, moved, with a scaled K or another view's calibration, or its clock
late or early. The episodes' own calibration is taken to be right. The sign of each fault is drawn.
Data sets take turns, a view each; --minutes ends a run early, with the n it got to. --right-only
judges views as they are alone, which takes a tenth of the time.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
import time

import cv2
import numpy as np
from page import parse_arguments, publish, table

from mtv_world_ros.assembly import recorded_robot
from mtv_world_ros.data.episode import Episode
from mtv_world_ros.data.episode_reader import list_episodes, read_episode, read_info
from mtv_world_ros.data_types import CameraModel
from mtv_world_ros.geometry.camera import scaled
from mtv_world_ros.geometry.robot.shape import moving_links
from mtv_world_ros.lab.inspection.inspect import Inspector, load_inspector

#: (episode, view, sign) -> the same with something wrong
Fault = Callable[[Episode, str, float], Episode]


def turned(axis: int, degrees: float) -> Fault:
    """The camera turned about an axis of its own (0 right, 1 down, 2 ahead)."""

    def change(episode: Episode, view: str, sign: float) -> Episode:
        turn = np.eye(4)
        a, b = [k for k in range(3) if k != axis]
        angle = sign * np.radians(degrees)
        c, s = np.cos(angle), np.sin(angle)
        turn[[a, b, a, b], [a, b, b, a]] = c, c, -s, s
        camera = episode.cameras[view]
        return with_camera(episode, replace(camera, T_mount_camera=camera.T_mount_camera @ turn))

    return change


def moved(metres: float) -> Fault:
    """The camera moved sideways."""

    def change(episode: Episode, view: str, sign: float) -> Episode:
        camera = episode.cameras[view]
        T = camera.T_mount_camera.copy()
        T[:3, 3] += sign * metres * T[:3, 0]
        return with_camera(episode, replace(camera, T_mount_camera=T))

    return change


def zoomed(factor: float) -> Fault:
    """K for images of another size."""

    def change(episode: Episode, view: str, sign: float) -> Episode:
        camera = episode.cameras[view]
        by = factor**sign
        scale = np.diag([by, by, 1.0])
        return with_camera(episode, replace(camera, K=scale @ camera.K))

    return change


def swapped(episode: Episode, view: str, sign: float) -> Episode:
    """The next view's calibration."""
    del sign
    names = list(episode.views)
    other = episode.cameras[names[(names.index(view) + 1) % len(names)]]
    return with_camera(episode, replace(other, view=view))


def late(seconds: float) -> Fault:
    """The images' clock late against the joint states'."""

    def change(episode: Episode, view: str, sign: float) -> Episode:
        track = episode.images[view]
        stamps = track.stamps_ns + round(sign * seconds * 1e9)
        return replace(episode, images={**episode.images, view: track._replace(stamps_ns=stamps)})

    return change


def with_camera(episode: Episode, camera: CameraModel) -> Episode:
    """The episode with another camera of a view."""
    return replace(episode, cameras={**episode.cameras, camera.view: camera})


FAULTS: dict[str, Fault | None] = {
    'as it is': None,
    'rolled by 10 degrees': turned(2, 10),
    'rolled by 40 degrees': turned(2, 40),
    'turned sideways by 3 degrees': turned(1, 3),
    'tilted by 3 degrees': turned(0, 3),
    'moved by 5 cm': moved(0.05),
    'K scaled by 1.15 or its inverse': zoomed(1.15),
    'K scaled by 2 or 0.5': zoomed(2),
    'views swapped': swapped,
    'images 0.2 s late or early': late(0.2),
    'images 1 s late or early': late(1.0),
}


def judge(
    inspector: Inspector,
    episode: Episode,
    view: str,
    rng: np.random.Generator,
    faults: Mapping[str, Fault | None],
) -> Iterator[tuple[str, str]]:
    """Yields the name and the verdict of each fault in one view."""
    for name, fault in faults.items():
        sign = float(rng.choice((-1.0, 1.0)))
        judged = fault(episode, view, sign) if fault else episode
        section = inspector.inspect(replace(judged, views=(view,))).views[0]
        if fault is None and section.verdict != 'ok':
            print(
                episode.info.path, view, [finding.text for finding in section.findings], flush=True
            )
        yield name, section.verdict


def fixed_views(inspector: Inspector, path: Path, width: int) -> Episode:
    """Returns an episode with the views that stand still, decoded and shrunk to a width [px]."""
    episode = read_episode(path, with_masks=False)
    moving = moving_links(inspector.robot)
    views = tuple(v for v in episode.views if episode.cameras[v].mount_link not in moving)
    cameras = {v: episode.cameras[v] for v in views}
    small = {v: scaled(c, width, round(width * c.height / c.width)) for v, c in cameras.items()}
    images = {
        v: episode.images[v]._replace(
            frames=np.stack(
                [
                    cv2.resize(frame, (c.width, c.height), interpolation=cv2.INTER_AREA)
                    for frame in np.asarray(episode.images[v].frames)
                ]
            )
        )
        for v, c in small.items()
    }
    return replace(episode, views=views, images=images, cameras=small)


def count(
    dataset: Path, repeats: int, seed: int, width: int, faults: Mapping[str, Fault | None]
) -> Iterator[tuple[str, dict[str, Counter[str]]]]:
    """Yields a data set's robot and the verdicts of each fault, after each of `repeats` views."""
    rng, paths = np.random.default_rng(seed), list_episodes(dataset)
    inspector = load_inspector(recorded_robot(paths[0], read_info(paths[0]).robot))
    counts: dict[str, Counter[str]] = {name: Counter() for name in faults}
    for path in rng.permutation(np.array(paths, dtype=object)):
        episode = fixed_views(inspector, path, width)
        for view in episode.views:
            if counts['as it is'].total() == repeats:
                return
            for name, verdict in judge(inspector, episode, view, rng, faults):
                counts[name][verdict] += 1
            yield inspector.robot.name, counts


def count_all(options: argparse.Namespace) -> dict[str, dict[str, Counter[str]]]:
    """Returns the counts by robot."""
    ends = time.monotonic() + 60 * options.minutes
    faults = {name: f for name, f in FAULTS.items() if f is None or not options.right_only}
    left = [
        count(d, options.repeats, options.seed, options.width, faults) for d in options.datasets
    ]
    found = {}
    while left and time.monotonic() < ends:
        views = [(one, next(one, None)) for one in left]
        left = [one for one, view in views if view is not None]
        found.update(view for _, view in views if view is not None)
        print(
            {robot: {k: dict(v) for k, v in c.items()} for robot, c in found.items()}, flush=True
        )
    return found


def main() -> None:
    """Publishes a row a fault and a column a robot."""

    def more(parser: argparse.ArgumentParser) -> None:
        parser.add_argument('datasets', type=Path, nargs='+')
        parser.add_argument('--width', type=int, default=384, help='of the images [px]')
        parser.add_argument('--minutes', type=float, default=1e9, help='stop starting after that')
        parser.add_argument('--right-only', action='store_true')

    options = parse_arguments(__doc__, 20, more)
    found = count_all(options)
    rows = [
        [name, *(_cell(name, counts[name]) for counts in found.values())]
        for name in next(iter(found.values()))
    ]
    body = (
        'Views as they are that passed (`ok`), and views with a fault that were found '
        '(`suspicious` or `broken`), of each robot. Images are '
        f'{options.width} px wide; each sign of a fault is as likely.\n\n'
        + table(['the view', *(f'`{name}`' for name in found)], rows)
    )
    title = 'Which faults does the doctor find, and which right views does it pass?'
    command = f'python benchmark/doctor_faults.py {" ".join(p.name for p in options.datasets)}'
    publish('doctor_faults', title, command, body, options, 'simulated episodes')


def _cell(name: str, verdicts: Counter[str]) -> str:
    wanted = ('ok',) if FAULTS[name] is None else ('suspicious', 'broken')
    return f'{sum(verdicts[one] for one in wanted)} of {verdicts.total()}'


if __name__ == '__main__':
    main()
