"""How far the tool point is drawn from where somebody saw it: episodes' cameras against points.

python benchmark/seen_points.py EPISODES benchmark/seen_points_droid_lab.json
"""

from __future__ import annotations

import argparse
from dataclasses import replace
import json
from pathlib import Path

import numpy as np

from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import CalibrationError
from mtv_world_ros.geometry.camera import camera_poses, project
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.lab.inspection.clocks import JointTrack


def main() -> None:
    """Prints a row for each view and episode, and all of a view."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('episodes', type=Path)
    parser.add_argument('points', type=Path)
    parser.add_argument('--robot', type=Path, help='default: robot/robot.yaml of the episodes')
    arguments = parser.parse_args()
    robot = load_robot(arguments.robot or arguments.episodes / 'robot' / 'robot.yaml')
    given = json.loads(arguments.points.read_text(encoding='utf-8'))
    print('| view | episode | points | median [px of 320] | largest | focal length [px of 320] |')
    print('|---|---|---|---|---|---|')
    for view, episodes in given['views'].items():
        every: list[float] = []
        for name, rows in episodes.items():
            try:
                found, focal = _errors(
                    arguments.episodes / name, view, np.array(rows), robot,
                    given['beyond_tool_point_m'],
                )  # fmt: skip
            except CalibrationError:
                print(f'| {view} | {name} | {len(rows)} | no calibration | | |')
                continue
            every += found.tolist()
            print(f'| {view} | {name} | {len(rows)} | {np.median(found):.1f} | {found.max():.1f} '
                  f'| {focal:.1f} |')  # fmt: skip
        if every:
            print(f'| {view} | all | {len(every)} | {np.median(every):.1f} | {max(every):.1f} | |')


def _errors(
    path: Path, view: str, rows: FloatArray, robot: RobotModel, beyond_m: float
) -> tuple[FloatArray, float]:
    """Distances [px of a width of 320] and focal length at that width."""
    episode = read_episode(path, views=[view], with_masks=False, robot=robot)
    assert episode.joint_states is not None
    joints = JointTrack(episode.joint_states, robot)
    stamps = joints.stamps_ns[0] + np.round(rows[:, 0] * 1e9).astype(np.int64)
    positions = joints.at(stamps)
    tools = robot.tool_poses(positions)[0]
    points = tools[:, :3, 3] + beyond_m * tools[:, :3, 2]
    camera = replace(episode.cameras[view])
    pixels, _ = project(camera, camera_poses(camera, robot, positions), points)
    scale = 320 / camera.width
    apart = np.linalg.norm(pixels - rows[:, 1:], axis=1) * scale
    return np.asarray(apart), float(camera.K[0, 0]) * scale


if __name__ == '__main__':
    main()
