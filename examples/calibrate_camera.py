"""Estimates where a fixed camera is, from a recording in which the arm moves.

    python examples/calibrate_camera.py [EPISODE] [--view low] [--out out/examples/camera.yaml]

Begins with the recorded pose as a guess; `guess=False` searches everywhere. The same as
`mtv-world fit camera`, which also finds cameras on the arm.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mtv_world_ros import (
    check_free,
    FixedCamera,
    JointTrack,
    load_robot,
    load_shape,
    pose_difference,
    read_episode,
    robot_path,
    save_calibration,
    share_path,
)

parser = argparse.ArgumentParser()
parser.add_argument(
    'episode', type=Path, nargs='?', default=share_path('resource', 'demo_episode')
)
parser.add_argument('--view', default='low')
parser.add_argument('--robot', default='yam_bimanual')
parser.add_argument('--out', type=Path, default=Path('out/examples/camera.yaml'))
parser.add_argument('--overwrite', action='store_true', help='replace what is there')
options = parser.parse_args()

check_free(options.out, options.overwrite)
robot = load_robot(robot_path(options.robot))
episode = read_episode(options.episode, views=(options.view,))
recorded = episode.cameras[options.view]
assert episode.joint_states is not None
joints = JointTrack(episode.joint_states, robot)
fixed = FixedCamera(episode.images[options.view], recorded, robot, load_shape(robot).parts, joints)
found = fixed.estimate(guess=True, seed=0)
mm, degrees = pose_difference(recorded.T_mount_camera, found.camera.T_mount_camera)
print(f'{options.view}: {mm:.1f} mm and {degrees:.2f} degrees from the recorded pose')
save_calibration(options.out, {options.view: found.camera})
print(f'written: {options.out}')
