"""How long does forward kinematics of an 81-step trajectory of two arms take?

    python benchmark/forward_kinematics.py [--out benchmark/results/]

From joint positions (81, 14) to poses, against matrix products in plain numpy: one step after
the other, and vectorised over the steps. All give the same tool poses to 1e-9.
"""

from __future__ import annotations

import os

os.environ.setdefault('OMP_NUM_THREADS', '1')

import numpy as np
from page import measure, parse_arguments, publish, table
import pinocchio as pin

from mtv_world_ros.files import share_path
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.geometry.robot.model import RobotModel

STEPS = 81


def joint_frames(robot: RobotModel) -> list[tuple[list[np.ndarray], np.ndarray]]:
    """Per arm: the fixed pose before each joint, and the tool's after the last one."""
    chains = []
    for tool in robot.tools:
        model = robot.pinocchio_model
        frame = model.frames[model.getFrameId(tool.link)]
        joint, placements = frame.parentJoint, []
        while joint:
            placements.insert(0, model.jointPlacements[joint].homogeneous)
            joint = model.parents[joint]
        chains.append((placements, frame.placement.homogeneous @ tool.T_link_tool))
    return chains


def turns(angles: np.ndarray) -> np.ndarray:
    """(..., 4, 4) rotations about z."""
    T = np.zeros((*np.shape(angles), 4, 4))
    T[..., 0, 0] = T[..., 1, 1] = np.cos(angles)
    T[..., 1, 0] = np.sin(angles)
    T[..., 0, 1] = -T[..., 1, 0]
    T[..., 2, 2] = T[..., 3, 3] = 1
    return T


def products(chains: list, positions: np.ndarray) -> np.ndarray:
    """(A, ..., 4, 4) tool poses; `positions` (..., 14) as many steps at once as it has."""
    poses = []
    for arm, (placements, tool) in enumerate(chains):
        T = np.eye(4)
        for joint, placement in enumerate(placements):
            T = T @ placement @ turns(positions[..., 7 * arm + joint])
        poses.append(T @ tool)
    return np.stack(poses)


def main() -> None:
    """Measures all and prints the table."""
    options = parse_arguments(__doc__, repeats=101)
    robot = load_robot(share_path('config', 'robots', 'yam_bimanual.yaml'))
    generator = np.random.default_rng(options.seed)
    positions = generator.uniform(robot.lower, robot.upper, (STEPS, len(robot.joint_names)))
    chains = joint_frames(robot)
    candidates = {
        'plain numpy, step by step': lambda: np.stack([products(chains, q) for q in positions], 1),
        'plain numpy, all steps at once': lambda: products(chains, positions),
        '`tool_poses` (Pinocchio)': lambda: robot.tool_poses(positions),
        '`forward_kinematics` (Pinocchio), all links': lambda: robot.forward_kinematics(positions),
    }
    expected = robot.tool_poses(positions)
    for candidate in list(candidates.values())[:2]:
        np.testing.assert_allclose(candidate(), expected, atol=1e-9)
    found = measure(candidates, options.repeats)
    slow = found['plain numpy, step by step'][0]
    rows = [
        [name, f'{median:.2f}', f'{low:.2f} .. {high:.2f}', f'{slow / median:.1f}']
        for name, (median, low, high) in found.items()
    ]
    header = ['method', 'CPU-ms, median', '5 .. 95 %', 'times as fast']
    links = len(robot.link_names)
    publish(
        'forward_kinematics',
        f'Forward kinematics: {STEPS} steps, two arms of 6 joints, {links} links',
        'python benchmark/forward_kinematics.py',
        f'{table(header, rows)}\n\nOne thread; all take turns in one run.',
        options,
        f'numpy {np.__version__}, Pinocchio {pin.__version__}',
    )


if __name__ == '__main__':
    main()
