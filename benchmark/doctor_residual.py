"""Does `mtv-world doctor` pass right calibrations and find ones that are 10 px off?

    python benchmark/doctor_residual.py DATASET [--pixels 10]

Every view of every episode in DATASET is judged as it is, then with its principal point moved
right, left, down and up. The episodes' own calibration is taken to be right.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from mtv_world_ros.data.episode_reader import list_episodes, read_episode
from mtv_world_ros.files import share_path
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.geometry.robot.shape import load_shape, rods
from mtv_world_ros.lab.inspection.clocks import JointTrack
from mtv_world_ros.lab.inspection.inspect import Inspector
from mtv_world_ros.lab.inspection.motion_residual import measure_residual, ResidualSearch

SEARCH = ResidualSearch(lags_s=(0.0,))


def main() -> None:
    """Prints distances and verdicts, with the robot's shape and with rods."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('dataset', type=Path)
    parser.add_argument('--pixels', type=float, default=10.0)
    options = parser.parse_args()
    file = share_path('config', 'robots', 'yam_bimanual.yaml')
    robot = load_robot(file)
    episodes = list_episodes(options.dataset)
    if not episodes:
        parser.error(f"'{options.dataset}' holds no episodes")
    for shape in (load_shape(robot), rods(robot, 'for comparison')):
        inspector = Inspector(robot, shape, SEARCH)
        distances, passed, found = [], [], []
        for path in episodes:
            for distance, right, wrong in _judge(path, inspector, options.pixels):
                distances.append(distance)
                passed.append(right)
                found += wrong
        quantiles = np.quantile(distances, (0.5, 0.9, 1.0))
        print(f'{shape.source}: {len(episodes)} episodes, {len(distances)} views')
        print(
            '  distance as it is: median {:.1f}, 90 % {:.1f}, at most {:.1f} px'.format(*quantiles)
        )
        print(f'  passed as it is: {sum(passed)} of {len(passed)}')
        print(f'  found {options.pixels:g} px off: {sum(found)} of {len(found)}', flush=True)


def _judge(
    path: Path, inspector: Inspector, pixels: float
) -> list[tuple[float, bool, list[bool]]]:
    episode = read_episode(path, with_masks=False)
    joints = JointTrack(episode.joint_states, inspector.robot)  # type: ignore[arg-type]
    judged = []
    for view, camera in episode.cameras.items():
        track = episode.images[view]
        track = track._replace(frames=np.asarray(track.frames))
        one = replace(episode, views=(view,), images={view: track})
        x, y = measure_residual(
            track, camera, inspector.robot, inspector.shape.parts, joints, SEARCH
        ).shift_px
        verdicts = []
        for shift in ((0, 0), (pixels, 0), (-pixels, 0), (0, pixels), (0, -pixels)):
            K = camera.K.copy()
            K[:2, 2] += shift
            moved = replace(one, cameras={view: replace(camera, K=K)})
            verdicts.append(inspector.inspect(moved).views[0].verdict)
        wrong = [verdict != 'ok' for verdict in verdicts[1:]]
        judged.append((float(np.hypot(x, y)), verdicts[0] == 'ok', wrong))
    return judged


if __name__ == '__main__':
    main()
