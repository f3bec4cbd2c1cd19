"""Which faults of a recording does `mtv-world doctor` find, and which right ones does it pass?

    python benchmark/doctor_faults.py DATASET [--views low,high] [--episodes 10] [--robot YAML]

Every episode is judged as it is and with one thing wrong at a time: the camera turned about each
axis, moved, with a scaled K or another view's calibration, or its clock late. The episodes' own
calibration is taken to be right.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from mtv_world_ros.assembly import robot_path
from mtv_world_ros.data.episode import Episode
from mtv_world_ros.data.episode_reader import list_episodes, read_episode
from mtv_world_ros.data_types import CameraModel
from mtv_world_ros.inspection.inspect import load_inspector

Fault = Callable[[Episode, str], Episode]


def turned(axis: int, degrees: float) -> Fault:
    """The camera turned about an axis of its own (0 right, 1 down, 2 ahead)."""

    def change(episode: Episode, view: str) -> Episode:
        turn = np.eye(4)
        a, b = [k for k in range(3) if k != axis]
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turn[[a, b, a, b], [a, b, b, a]] = c, c, -s, s
        camera = episode.cameras[view]
        return with_camera(episode, replace(camera, T_mount_camera=camera.T_mount_camera @ turn))

    return change


def moved(metres: float) -> Fault:
    """The camera moved sideways."""

    def change(episode: Episode, view: str) -> Episode:
        camera = episode.cameras[view]
        T = camera.T_mount_camera.copy()
        T[:3, 3] += metres * T[:3, 0]
        return with_camera(episode, replace(camera, T_mount_camera=T))

    return change


def zoomed(factor: float) -> Fault:
    """K for images of another size."""

    def change(episode: Episode, view: str) -> Episode:
        camera = episode.cameras[view]
        scale = np.diag([factor, factor, 1.0])
        return with_camera(episode, replace(camera, K=scale @ camera.K))

    return change


def swapped(episode: Episode, view: str) -> Episode:
    """The next view's calibration."""
    names = list(episode.cameras)
    other = episode.cameras[names[(names.index(view) + 1) % len(names)]]
    return with_camera(episode, replace(other, view=view))


def late(seconds: float) -> Fault:
    """The images' clock late against the joint states'."""

    def change(episode: Episode, view: str) -> Episode:
        track = episode.images[view]
        stamps = track.stamps_ns + round(seconds * 1e9)
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
    'tilted by 3 degrees': turned(0, -3),
    'moved by 5 cm': moved(0.05),
    'K scaled by 0.5': zoomed(0.5),
    'K scaled by 1.15': zoomed(1.15),
    'K scaled by 2': zoomed(2),
    'views swapped': swapped,
    'images 0.2 s late': late(0.2),
    'images 1 s late': late(1.0),
}


def main() -> None:
    """Prints a row a fault: views judged, and how many got each verdict."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('dataset', type=Path)
    parser.add_argument('--views')
    parser.add_argument('--episodes', type=int, default=10)
    parser.add_argument('--robot', default='yam_bimanual')
    options = parser.parse_args()
    inspector = load_inspector(robot_path(options.robot))
    views = options.views.split(',') if options.views else None
    paths = list_episodes(options.dataset)
    paths = [paths[i * len(paths) // options.episodes] for i in range(options.episodes)]
    counts: dict[str, Counter[str]] = {name: Counter() for name in FAULTS}
    for path in paths:
        read = read_episode(path, views=views, with_masks=False)
        decoded = {v: t._replace(frames=np.asarray(t.frames)) for v, t in read.images.items()}
        episode = replace(read, images=decoded)
        for name, fault in FAULTS.items():
            for view in episode.views:
                judged = fault(episode, view) if fault else episode
                section = inspector.inspect(replace(judged, views=(view,))).views[0]
                counts[name][section.verdict] += 1
                if fault is None and section.verdict != 'ok':
                    print(path.name, view, [finding.text for finding in section.findings])
    print(f'{inspector.robot.name}, {len(paths)} episodes, {inspector.shape.source}')
    for name, count in counts.items():
        total = sum(count.values())
        good = count['ok'] if name == 'as it is' else count['suspicious'] + count['broken']
        print(f'| {name} | {good} of {total} | {dict(count)} |', flush=True)


if __name__ == '__main__':
    main()
