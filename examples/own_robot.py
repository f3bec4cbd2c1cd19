"""Makes the robot file of a URDF, and draws the robot.

    python examples/own_robot.py [URDF] [--out out/examples/robot]

Arms, tools and fingers are guessed; read the notes and correct the YAML. The same as
`mtv-world robot`.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import shutil

import numpy as np
import yaml

from mtv_world_ros import check_free, guess_robot, load_robot, share_path

parser = argparse.ArgumentParser()
parser.add_argument(
    'urdf', type=Path, nargs='?', default=share_path('config', 'robots', 'franka', 'franka.urdf')
)
parser.add_argument('--out', type=Path, default=Path('out/examples/robot'))
parser.add_argument('--overwrite', action='store_true', help='replace what is there')
options = parser.parse_args()

check_free(options.out, options.overwrite)
guessed = guess_robot(options.urdf)
print(*(f'guessed: {note}' for note in guessed.notes), sep='\n')
options.out.mkdir(parents=True, exist_ok=True)
shutil.copy(options.urdf, options.out)
file = options.out / 'robot.yaml'
file.write_text(yaml.safe_dump(guessed.values, sort_keys=False))

robot = load_robot(file)
middle = (robot.lower + robot.upper) / 2
for tool, poses in zip(robot.tools, robot.tool_poses(middle[None]), strict=True):
    print(f'tool of {tool.arm} in the middle of all limits: {np.round(poses[0, :3, 3], 3)} m')
print(f'written: {file}; {len(robot.joint_names)} joints')
