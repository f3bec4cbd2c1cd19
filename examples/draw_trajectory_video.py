"""Draws a joint motion into the calibrated cameras; needs no model and no recording.

    python examples/draw_trajectory_video.py [--out out/examples]

This is what the world model is shown of the commands.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mtv_world_ros import (
    load_calibration,
    load_robot,
    Motion,
    render_trajectory_video,
    share_path,
    TrajectoryVideoConfig,
    write_video,
)

parser = argparse.ArgumentParser()
parser.add_argument('--out', type=Path, default=Path('out/examples'))
options = parser.parse_args()

robot = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
cameras = load_calibration(share_path('config', 'robots', 'yam_bimanual', 'cameras.yaml'))

# both arms swing about their bases while the grippers open and close
times = np.arange(40) / 10.0
arm = np.array([0.0, 1.05, 1.05, 0.0, 0.0, 0.0, 0.02])
positions = np.tile(arm, (len(times), 2))
positions[:, [0, 7]] = 0.5 * np.sin(2 * times)[:, None]
positions[:, [6, 13]] += 0.015 * np.sin(6 * times)[:, None]

video = render_trajectory_video(
    motion=Motion.of(robot, cameras.values(), positions),
    times=times,
    object_masks=None,
    config=TrajectoryVideoConfig(link_width_m=0.02),
)

options.out.mkdir(parents=True, exist_ok=True)
for view, frames in zip(video.views, video.frames, strict=True):
    write_video(options.out / f'trajectory_{view}.mp4', frames, fps=10.0)
print(f'written: {options.out}/trajectory_*.mp4, {video.frames.shape[1]} frames per view')
