"""Writes an episode as a rosbag2 MCAP folder, and reads it again.

    python examples/episode_on_disk.py [--out out/examples/episode]

Use the writer to convert data of your own. The folder is like one that `ros2 bag record` makes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mtv_world_ros import (
    EpisodeWriter,
    JointTrajectory,
    load_calibration,
    load_robot,
    read_episode,
    share_path,
)

parser = argparse.ArgumentParser()
parser.add_argument('--out', type=Path, default=Path('out/examples/episode'))
parser.add_argument('--overwrite', action='store_true', help='replace what is there')
options = parser.parse_args()

robot = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
cameras = load_calibration(share_path('config', 'robots', 'yam_bimanual', 'cameras.yaml'))
home = np.tile([0.0, 1.05, 1.05, 0.0, 0.0, 0.0, 0.02], 2)
trajectory = JointTrajectory(
    joint_names=robot.joint_names,
    times=np.linspace(0.1, 2.0, 20),
    positions=np.tile(home, (20, 1)),
)

with EpisodeWriter(
    options.out,
    task='stack_blocks_two',
    instruction='stack the red block on the blue block',
    robot=robot.name,
    cameras=tuple(cameras.values()),
    objects=('red block', 'blue block'),
    overwrite=options.overwrite,
) as writer:
    start_ns = 1_700_000_000_000_000_000
    writer.write_instruction(start_ns)
    writer.write_trajectory(start_ns, trajectory)
    for frame in range(20):
        stamp_ns = start_ns + frame * 100_000_000
        writer.write_joint_states(stamp_ns, robot.joint_names, home)
        for view, camera in cameras.items():
            image = np.full((camera.height, camera.width, 3), 10 * frame, np.uint8)
            writer.write_image(view, stamp_ns, image)
            writer.write_camera_info(view, stamp_ns, camera)
    writer.outcome = 'failure'

episode = read_episode(options.out)
print(f'{options.out}: {episode.info.instruction} ({episode.info.outcome})')
for view in episode.views:
    stamps_ns, frames = episode.images[view]
    print(f'  {view}: {len(stamps_ns)} frames of {frames[0].shape}')  # decoded when asked for
