"""Servers of policies as processes, and what a robot with two arms sees, for tests of clients."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
import subprocess
import sys

import numpy as np
import yaml

from mtv_world_ros.core.data_types import CameraModel, Observation
from mtv_world_ros.core.files import share_path
from mtv_world_ros.policies.policy import EpisodeOrigin
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.rollout.assembly import assemble_policy

ROBOT = load_robot(robot_path('yam_bimanual'))
HOME = np.array([0.0, 1.047, 1.047, 0.0, 0.0, 0.0, 0.03] * 2)


@contextmanager
def running(name: str, *options: str) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A server of this folder and its port, killed at the end."""
    line = [sys.executable, str(Path(__file__).with_name(f'{name}.py')), *options]
    process = subprocess.Popen(line, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield process, int(process.stdout.readline())
    finally:
        process.kill()
        process.wait()


def policy_values(name: str) -> dict:
    """The values of a bundled policy file."""
    return yaml.safe_load(share_path('config', 'policies', f'{name}.yaml').read_text())


def make_policy(tmp_path: Path, values: dict):
    """The policy of a file with these values."""
    path = tmp_path / 'policy.yaml'
    path.write_text(yaml.safe_dump(values))
    return assemble_policy(path, ROBOT)(EpisodeOrigin())


def observe(positions: np.ndarray = HOME, frames: np.ndarray | None = None) -> Observation:
    """By default black frames, 72 x 96."""
    cameras = tuple(
        CameraModel(view=view, width=96, height=72, K=np.diag([90.0, 90.0, 1.0]),
                    mount_link='base', T_mount_camera=np.eye(4))
        for view in ('low', 'high')
    )  # fmt: skip
    frames = np.zeros((2, 72, 96, 3), np.uint8) if frames is None else frames
    return Observation(cameras=cameras, frames=frames, positions=positions, stamp_ns=10**9)
